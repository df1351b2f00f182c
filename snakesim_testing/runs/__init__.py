"""Runs the `snakesim` command and whole runs for tests, in processes of their own or in the test's process."""
