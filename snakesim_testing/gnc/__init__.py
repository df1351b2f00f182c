"""Robots, paths and truth for tests of guidance, navigation and control."""
