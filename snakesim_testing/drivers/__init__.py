"""Runs drivers with emulated drives tick by tick for tests."""
