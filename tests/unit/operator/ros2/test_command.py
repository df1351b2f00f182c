"""The time of messages to ROS. The refusals of `snakesim start ros2` are in tests/system/runs/refusals.toml."""

import time

from snakesim_operator.features.ros2.relay import RosTime

MAX_ERROR_NS = 30_000_000  # less than the smallest delay of a late clock sample


def test_ros_time_without_wall_time_is_robot_time() -> None:
    ros_time = RosTime(wall_time=False)
    ros_time.add_clock(5)
    assert ros_time.convert(7) == 7


def test_ros_wall_time_follows_the_clock_sample_with_least_delay() -> None:
    ros_time = RosTime(wall_time=True)
    start_ns = time.time_ns()
    for delay_ns in (80_000_000, 0, 50_000_000):
        ros_time.add_clock(time.time_ns() - start_ns - delay_ns)
    assert abs(ros_time.convert(10_000_000) - start_ns - 10_000_000) < MAX_ERROR_NS
    ros_time.reset()
    ros_time.add_clock(0)
    assert abs(ros_time.convert(0) - time.time_ns()) < MAX_ERROR_NS
