"""The experiments, by name."""
