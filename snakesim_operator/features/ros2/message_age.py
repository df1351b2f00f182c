"""Measures how old a message from ROS is, so that a message that the network held back moves nothing.

A message that moves a robot counts for half a second from when its sender sent it, not from when it arrived: after a
stall, a network delivers all that it has queued at once. If a message has a header, its timestamp gives the time of
sending. Every message of rmw_zenoh also carries its sender's wall-clock time as an attachment. That clock need not
agree with ours, so only differences count: the fastest message of a sender within two minutes is taken to have no
delay, and every other message is as old as it is slower than that one. No session of rmw_zenoh survives a stall of
two minutes, so there is always a message without such a delay to compare with.
"""

from collections import OrderedDict, deque

from snakesim_hal.network.foreign_network import RawSample
from snakesim_operator.features.ros2.graph import ATTACHMENT, GID_BYTES

MAX_AGE_NS = 500_000_000  # of a message that moves a robot
MAX_FUTURE_NS = 100_000_000  # of a header's timestamp: two clocks are not read at the same time
MAX_REQUEST_AGE_NS = 5_000_000_000  # of a service request that allows a robot to move
MAX_SENDERS = 64  # bounds the memory that a flood of senders can take
WINDOW_PART_NS = 10_000_000_000
WINDOW_PARTS = 12  # times WINDOW_PART_NS: the two minutes in which the fastest message is searched


class _SlidingMinimumOffset:
    """The smallest difference between our wall clock and a sender's, for each part of the last two minutes.

    Each difference is clock offset plus latency, so the smallest one belongs to the fastest message.
    """

    def __init__(self) -> None:
        # Number of the part, smallest offset in ns.
        self._parts: deque[tuple[int, int]] = deque(maxlen=WINDOW_PARTS)

    def update_and_get_delay(self, offset_ns: int, monotonic_ns: int) -> int:
        """Record the offset of a message, and return by how many ns it exceeds the minimum of the last two minutes."""
        part = monotonic_ns // WINDOW_PART_NS
        while self._parts and self._parts[0][0] <= part - WINDOW_PARTS:
            self._parts.popleft()
        if self._parts and self._parts[-1][0] == part:
            _, previous_ns = self._parts.pop()
            self._parts.append((part, min(previous_ns, offset_ns)))
        else:
            self._parts.append((part, offset_ns))
        smallest_ns = min(part_ns for _, part_ns in self._parts)
        return offset_ns - smallest_ns


class SenderClocks:
    """Measures the delay of each message by comparison with the fastest message of its sender."""

    def __init__(self) -> None:
        # By sender, longest silent first.
        self._min_offset_by_sender: OrderedDict[bytes, _SlidingMinimumOffset] = OrderedDict()

    def estimate_age_ns(self, sample: RawSample, wall_ns: int, monotonic_ns: int) -> int:
        """Estimate the age of a message in ns: its delay relative to the minimum observed clock offset of its sender.

        The offset between the clocks is unknown, so the message with the smallest offset is taken to have no delay. The
        age is never below the time that the message has waited in this process.

        Args:
            sample: The message with its attachment and its arrival time.
            wall_ns: Current time of this computer's wall clock.
            monotonic_ns: Current monotonic time, of the clock of `sample.arrived_ns`.

        Returns:
            The estimated age. Without an attachment that names the sender, only the time in this process.
        """
        waiting_ns = monotonic_ns - sample.arrived_ns
        sender_and_time = parse_attachment(sample.attachment)
        if sender_and_time is None:
            return waiting_ns
        sender, sent_ns = sender_and_time
        min_offset = self._min_offset_by_sender.setdefault(sender, _SlidingMinimumOffset())
        # Forget the senders that have been silent longest.
        self._min_offset_by_sender.move_to_end(sender)
        while len(self._min_offset_by_sender) > MAX_SENDERS:
            self._min_offset_by_sender.popitem(last=False)
        delay_ns = min_offset.update_and_get_delay(wall_ns - sent_ns, monotonic_ns)
        return max(delay_ns, waiting_ns)


def parse_attachment(attachment: bytes) -> tuple[bytes, int] | None:
    """Return the sender of a message and its wall-clock time of sending in ns; None without such an attachment."""
    if len(attachment) != ATTACHMENT.size:
        return None
    _, sent_ns, gid_bytes, sender = ATTACHMENT.unpack(attachment)
    if gid_bytes != GID_BYTES:
        return None
    return sender, sent_ns


def explain_stale_message(age_ns: float, source: str) -> str:
    """Explain why a message is too old, or too far in the future, to move the robot.

    Args:
        age_ns: Age of the message; negative for a timestamp in the future.
        source: How the age was measured, as a text for the reason.

    Returns:
        The reason to refuse the message; an empty text if the message may move the robot.
    """
    if age_ns > MAX_AGE_NS:
        return f"is older than {MAX_AGE_NS * 1e-9:g} s by {source}"
    if age_ns < -MAX_FUTURE_NS:
        return (
            f"is ahead of the time in ROS by {source}; give robot time (use_sim_time) when the bridge publishes "
            "/clock, synchronised wall-clock time otherwise, or no stamp"
        )
    return ""


def explain_stale_request(attachment: bytes, wall_ns: int) -> str:
    """Explain why a service request is too old, or too far in the future, to let the robot move.

    A client sends a single request, so there is no faster message to compare with: its clock must agree with ours to
    within MAX_REQUEST_AGE_NS.

    Args:
        attachment: Attachment of the request, with the time at which it was sent.
        wall_ns: Current time of this computer's wall clock.

    Returns:
        The reason to refuse the request; an empty text if the request is recent.
    """
    sender_and_time = parse_attachment(attachment)
    if sender_and_time is None:
        return "the request has no time attached"
    _, sent_ns = sender_and_time
    age_ns = wall_ns - sent_ns
    if abs(age_ns) <= MAX_REQUEST_AGE_NS:
        return ""
    past_or_future = "ago" if age_ns > 0 else "in the future"
    return (
        f"the request was sent {abs(age_ns) * 1e-9:.0f} s {past_or_future}, by the clock of its sender; "
        f"{MAX_REQUEST_AGE_NS * 1e-9:g} s are allowed. "
        "Ask again; if it is refused again, synchronise the clocks of both computers"
    )
