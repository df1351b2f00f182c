"""Robots, hosts and networks of the HAL, small enough for tests."""
