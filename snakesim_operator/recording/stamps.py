"""The clock of a file's log times: the robot's, or the wall clock of the computer that recorded.

An MCAP file has two times for each message. With robot stamps, `log_time` is robot time and `publish_time` the wall
clock. With wall stamps they change places, and each channel has a mark in its metadata: no time is lost.
"""

from typing import Literal, get_args

Stamps = Literal["robot", "wall"]
CHOICES: tuple[Stamps, ...] = get_args(Stamps)
STAMPS = "stamps"  # entry of a channel's metadata; a channel without it has robot stamps
ABOUT_STAMPS = (
    "clock of the times in the file: robot time, or the wall clock of the computer that recorded, to view the file "
    "beside files of other programs"
)


def order_times(robot_ns: int, wall_ns: int, stamps: Stamps) -> tuple[int, int]:
    """Return log time and publish time of a message."""
    if stamps == "wall":
        return wall_ns, robot_ns
    return robot_ns, wall_ns


def read_stamps(metadata: dict[str, str]) -> Stamps:
    """Return the clock of a channel's log times."""
    return "wall" if metadata.get(STAMPS) == "wall" else "robot"


def mark_stamps(metadata: dict[str, str], stamps: Stamps) -> dict[str, str]:
    """Return the metadata of a channel with the clock of its log times."""
    unmarked = {name: value for name, value in metadata.items() if name != STAMPS}
    return {**unmarked, STAMPS: stamps} if stamps == "wall" else unmarked
