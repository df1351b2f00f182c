"""What time it is in ROS. What `snakesim start ros2` refuses is in tests/system/runs/refusals.toml."""

import time

from snakesim_operator.features.ros2.relay import RosTime


def test_robot_time_is_taken_as_it_is() -> None:
    stamps = RosTime(wall_time=False)
    stamps.add_clock(5)
    assert stamps.convert(7) == 7


def test_wall_time_is_that_of_the_quickest_clock() -> None:
    stamps = RosTime(wall_time=True)
    started_ns = time.time_ns()
    for late_ns in (80_000_000, 0, 50_000_000):
        stamps.add_clock(time.time_ns() - started_ns - late_ns)
    assert abs(stamps.convert(10_000_000) - started_ns - 10_000_000) < 30_000_000
    stamps.reset()
    stamps.add_clock(0)
    assert abs(stamps.convert(0) - time.time_ns()) < 30_000_000
