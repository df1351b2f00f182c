"""The robot and its clock for tests that send samples which do not fit this robot."""

from snakesim_testing.hal.small_robots import make_clock, make_description

ROBOT = make_description()  # three joints, four links
CLOCK = make_clock(3, clock_mode="realtime")
