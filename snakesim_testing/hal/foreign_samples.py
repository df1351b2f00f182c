"""Samples of nodes that do not belong to the robot."""

from snakesim_testing.hal.small_robots import make_clock, make_description

ROBOT = make_description()  # three joints, four links


CLOCK = make_clock(3, clock_mode="realtime")
