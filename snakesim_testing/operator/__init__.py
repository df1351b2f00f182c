"""Recorded runs, browsers and viewers for tests of the operator package."""
