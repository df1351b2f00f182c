"""The clock of a recording's log times: the robot's, or the wall clock of the computer that recorded.

An MCAP file has two times for each message. If the log times are by the robot's clock, `log_time` is robot time and
`publish_time` the wall clock. If they are by the wall clock, the two change places, and each channel has an entry in
its metadata which states that. So no time is lost.
"""

from typing import Literal, get_args

LogTimeClock = Literal["robot", "wall"]
LOG_TIME_CLOCKS: tuple[LogTimeClock, ...] = get_args(LogTimeClock)
# Name of the entry in a channel's metadata; without it, the log times are robot time.
CLOCK_ENTRY = "stamps"
LOG_TIME_CLOCK_HELP = (
    "clock of the times in the file: robot time, or the wall clock of the computer that recorded, to view the file "
    "beside files of other programs"
)


def order_times(
    robot_time_ns: int, wall_time_ns: int, log_time_clock: LogTimeClock
) -> tuple[int, int]:
    """Return the log time and the publish time of a message, by the clock of the file's log times."""
    if log_time_clock == "wall":
        return wall_time_ns, robot_time_ns
    return robot_time_ns, wall_time_ns


def read_log_time_clock(metadata: dict[str, str]) -> LogTimeClock:
    """Return the clock of a channel's log times, as stated in the metadata of the channel."""
    return "wall" if metadata.get(CLOCK_ENTRY) == "wall" else "robot"


def with_log_time_clock(metadata: dict[str, str], log_time_clock: LogTimeClock) -> dict[str, str]:
    """Return a copy of a channel's metadata that states the clock of its log times."""
    unmarked = {name: value for name, value in metadata.items() if name != CLOCK_ENTRY}
    return {**unmarked, CLOCK_ENTRY: log_time_clock} if log_time_clock == "wall" else unmarked
