"""How old a message from ROS is. Pure except for its own state.

What moves a robot counts for half a second from the moment at which its sender sent it, not from when it came: a
network that stalls delivers all that it has kept at once. Where a message has a header, its stamp says when. Every
message of rmw_zenoh also has the time of its sender's wall clock attached, which need not agree with ours. So the
quickest message of a sender within two minutes counts as one without delay, and the others are as old as they are
slower. No session of rmw_zenoh outlives a stall of two minutes.
"""

from collections import OrderedDict, deque

from snakesim_hal.network.foreign_network import RawSample
from snakesim_operator.features.ros2.graph import ATTACHED, GID_BYTES

MAX_AGE_NS = 500_000_000  # of a message that moves a robot
AHEAD_NS = 100_000_000  # by which a header's stamp may be ahead of our time: clocks are not read at the same instant
MAX_REQUEST_AGE_NS = 5_000_000_000  # of a service request that lets a robot move
SENDERS_KEPT = 64
PART_NS, PARTS_KEPT = 10_000_000_000, 12  # of the time in which the quickest message is sought


class _Quickest:
    """The least offset between our wall clock and a sender's, of each part of the last two minutes."""

    def __init__(self) -> None:
        self._parts: deque[tuple[int, int]] = deque(maxlen=PARTS_KEPT)  # number of the part, least offset in ns

    def put(self, offset_ns: int, monotonic_ns: int) -> int:
        """Take in an offset, and return by how much it is larger than the least one."""
        part = monotonic_ns // PART_NS
        while self._parts and self._parts[0][0] <= part - PARTS_KEPT:
            self._parts.popleft()
        if self._parts and self._parts[-1][0] == part:
            offset_in_part_ns = min(self._parts.pop()[1], offset_ns)
            self._parts.append((part, offset_in_part_ns))
        else:
            self._parts.append((part, offset_ns))
        return offset_ns - min(min_ns for _, min_ns in self._parts)


class SenderClocks:
    """How late each message came, compared with the quickest one of its sender."""

    def __init__(self) -> None:
        self._quickest: OrderedDict[bytes, _Quickest] = OrderedDict()

    def age_ns(self, sample: RawSample, wall_ns: int, monotonic_ns: int) -> int:
        """Return the age of a message at the present times, since it was sent as far as that is known."""
        waited_ns = monotonic_ns - sample.arrived_ns  # in this process
        sent = sent_by(sample.attachment)
        if sent is None:
            return waited_ns
        sender, sent_ns = sent
        quickest = self._quickest.setdefault(sender, _Quickest())
        self._quickest.move_to_end(sender)
        while len(self._quickest) > SENDERS_KEPT:
            self._quickest.popitem(last=False)
        return max(quickest.put(wall_ns - sent_ns, monotonic_ns), waited_ns)


def sent_by(attachment: bytes) -> tuple[bytes, int] | None:
    """Return who sent a message, and when by its wall clock in ns; None: it has no such attachment."""
    if len(attachment) != ATTACHED.size:
        return None
    _, sent_ns, length, sender = ATTACHED.unpack(attachment)
    return (sender, sent_ns) if length == GID_BYTES else None


def why_too_old(age_ns: float, by: str) -> str:
    """Return why a message may move nothing; empty when it may. by: by what its age is known."""
    if age_ns > MAX_AGE_NS:
        return f"is older than {MAX_AGE_NS * 1e-9:g} s by {by}"
    if age_ns < -AHEAD_NS:
        return (
            f"is ahead of the time in ROS by {by}; give robot time (use_sim_time) when the bridge publishes /clock, "
            "synchronised wall-clock time otherwise, or no stamp"
        )
    return ""


def why_request_too_old(attachment: bytes, wall_ns: int) -> str:
    """Return why a request may not let a robot move; empty when it may.

    A client asks once, so that there is no quicker message to compare with: its clock has to agree with ours roughly.
    """
    sent = sent_by(attachment)
    if sent is None:
        return "the request has no time attached"
    late_ns = wall_ns - sent[1]
    if abs(late_ns) <= MAX_REQUEST_AGE_NS:
        return ""
    when = f"{abs(late_ns) * 1e-9:.0f} s {'ago' if late_ns > 0 else 'in the future'}"
    return (
        f"the request was sent {when}, by the clock of its sender; {MAX_REQUEST_AGE_NS * 1e-9:g} s are allowed. Ask "
        "again; if it is refused again, synchronise the clocks of both computers"
    )
