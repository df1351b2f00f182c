"""Runs real processes, networks and pages for every test suite."""
