"""Small robots, hosts and networks for tests of the HAL."""
