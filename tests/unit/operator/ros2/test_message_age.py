"""The age of a ROS message, which follows from the time that its sender attached, even if that clock is wrong."""

import pytest

from snakesim_hal.network.foreign_network import RawSample
from snakesim_operator.features.ros2.graph import make_attachment
from snakesim_operator.features.ros2.message_age import (
    MAX_AGE_NS,
    SenderClocks,
    explain_stale_message,
    explain_stale_request,
)

SECOND_NS = 10**9
NETWORK_DELAY_S = 0.02
GID = bytes(range(16))
OTHER_GID = bytes(16)


class Sender:
    """A ROS node whose wall clock differs from ours by some seconds."""

    def __init__(self, clocks: SenderClocks, clock_offset_s: float, gid: bytes = GID) -> None:
        self._clocks = clocks
        self._clock_offset_s = clock_offset_s
        self._gid = gid

    def estimate_age_s(self, sent_s: float, received_s: float, read_s: float) -> float:
        """Return the estimated age of a message when it is read; all times are by our clock."""
        attached_ns = round((sent_s + self._clock_offset_s) * SECOND_NS)
        attachment = make_attachment(1, attached_ns, self._gid)
        sample = RawSample(b"", attachment, round(received_s * SECOND_NS))
        read_ns = round(read_s * SECOND_NS)
        return self._clocks.estimate_age_ns(sample, read_ns, read_ns) / SECOND_NS


@pytest.mark.parametrize("clock_offset_s", [0.0, -3600.0, 5.0])
def test_message_age_includes_network_delay(clock_offset_s: float) -> None:
    """The network delays messages by 20 ms, and then holds 270 of them back until 117 s."""
    sender = Sender(SenderClocks(), clock_offset_s)
    for number in range(50):
        sent_s = 100.0 + 0.05 * number
        received_s = sent_s + NETWORK_DELAY_S
        assert sender.estimate_age_s(sent_s, received_s, received_s) < 0.01
    ages_s = [sender.estimate_age_s(103.0 + 0.05 * number, 117.0, 117.0) for number in range(270)]
    assert ages_s[0] == pytest.approx(14.0 - NETWORK_DELAY_S)
    assert ages_s == sorted(ages_s, reverse=True)
    assert sum(age_s * SECOND_NS <= MAX_AGE_NS for age_s in ages_s) <= 1, (
        "only a message that was sent just before 117 s is recent enough"
    )
    assert sender.estimate_age_s(117.1, 117.12, 117.12) == pytest.approx(0.0, abs=0.01)


def test_message_age_recovers_two_minutes_after_clock_set_back() -> None:
    clocks = SenderClocks()
    assert Sender(clocks, 0.0).estimate_age_s(1.0, 1.0, 1.0) == 0.0
    set_back = Sender(clocks, -3600.0)
    assert set_back.estimate_age_s(2.0, 2.0, 2.0) == 3600.0
    assert set_back.estimate_age_s(130.0, 130.0, 130.0) == 0.0


def test_message_age_includes_wait_in_bridge() -> None:
    clocks = SenderClocks()
    without_time = RawSample(b"", b"", SECOND_NS)
    assert clocks.estimate_age_ns(without_time, 0, 4 * SECOND_NS) == 3 * SECOND_NS, (
        "a plain Zenoh client attaches no time"
    )
    assert Sender(clocks, 0.0).estimate_age_s(1.0, 1.0, 4.0) == 3.0, (
        "the clock of a new sender is unknown"
    )


def test_message_age_of_each_sender_follows_its_own_clock() -> None:
    clocks = SenderClocks()
    first = Sender(clocks, -3600.0)
    second = Sender(clocks, 0.0, OTHER_GID)
    assert first.estimate_age_s(1.0, 1.02, 1.02) == 0.0
    assert second.estimate_age_s(2.0, 2.02, 2.02) == 0.0
    assert first.estimate_age_s(3.0, 3.52, 3.52) == pytest.approx(0.5)
    assert second.estimate_age_s(4.0, 4.02, 4.02) == 0.0


def test_stale_arm_request_is_refused_with_its_age() -> None:
    def explain(sent_s: int, received_s: int) -> str:
        """Explain why a request that was sent at this time is refused."""
        attachment = make_attachment(1, sent_s * SECOND_NS, GID)
        return explain_stale_request(attachment, received_s * SECOND_NS)

    assert explain(100, 103) == ""
    assert "was sent 30 s ago, by the clock of its sender" in explain(100, 130)
    assert "was sent 3600 s in the future" in explain(3700, 100)
    assert explain_stale_request(b"", 0) == "the request has no time attached"


def test_stale_message_reason_names_limit_and_remedy() -> None:
    assert explain_stale_message(MAX_AGE_NS, "its stamp") == ""
    assert explain_stale_message(MAX_AGE_NS + 1, "its stamp") == "is older than 0.5 s by its stamp"
    assert "use_sim_time" in explain_stale_message(-SECOND_NS, "its stamp")
