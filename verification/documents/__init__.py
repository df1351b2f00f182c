"""Tests that run the commands which the documentation prints, and build the documentation site."""
