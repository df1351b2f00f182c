"""Samples of nodes that do not belong to the robot."""

from snakesim_testing.hal.small_robots import clock, description

ROBOT = description()  # three joints, four links


CLOCK = clock(3, clock_mode="realtime")
