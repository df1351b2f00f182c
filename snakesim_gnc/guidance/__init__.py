"""Guidance: what the snake feels and where it is, made into a world model that others can use."""
