"""Tests that a run has the same digest on every kind of processor."""
