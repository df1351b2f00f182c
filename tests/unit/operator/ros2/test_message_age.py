"""How old a message from ROS is, by the time that its sender attached, whatever its clock shows."""

import pytest

from snakesim_hal.network.foreign_network import RawSample
from snakesim_operator.features.ros2.graph import make_attachment
from snakesim_operator.features.ros2.message_age import (
    MAX_AGE_NS,
    SenderClocks,
    explain_stale_message,
    explain_stale_request,
)

SECOND = 10**9
GID, OTHER = bytes(range(16)), bytes(16)


class Sender:
    """A node whose wall clock is off by some seconds, behind a network that takes 20 ms."""

    def __init__(self, clocks: SenderClocks, off_s: float, gid: bytes = GID) -> None:
        self._clocks, self._off_s, self._gid = clocks, off_s, gid

    def age_s(self, sent_s: float, came_s: float, read_s: float) -> float:
        """Age of a message when it is read; all times by our clock."""
        sent_ns = round((sent_s + self._off_s) * SECOND)
        sample = RawSample(b"", make_attachment(1, sent_ns, self._gid), round(came_s * SECOND))
        return (
            self._clocks.estimate_age_ns(sample, round(read_s * SECOND), round(read_s * SECOND))
            / SECOND
        )


@pytest.mark.parametrize("off_s", [0.0, -3600.0, 5.0])
def test_message_age_includes_network_delay(off_s: float) -> None:
    sender = Sender(SenderClocks(), off_s)
    for number in range(50):
        sent_s = 100.0 + 0.05 * number
        assert sender.age_s(sent_s, sent_s + 0.02, sent_s + 0.02) < 0.01
    held_back = [sender.age_s(103.0 + 0.05 * number, 117.0, 117.0) for number in range(270)]
    assert held_back[0] == pytest.approx(14.0 - 0.02)
    assert held_back == sorted(held_back, reverse=True)
    assert sum(age_s * SECOND <= MAX_AGE_NS for age_s in held_back) <= 1, (
        "those that were sent just before"
    )
    assert sender.age_s(117.1, 117.12, 117.12) == pytest.approx(0.0, abs=0.01)


def test_message_age_recovers_two_minutes_after_clock_set_back() -> None:
    clocks = SenderClocks()
    assert Sender(clocks, 0.0).age_s(1.0, 1.0, 1.0) == 0.0
    set_back = Sender(clocks, -3600.0)
    assert set_back.age_s(2.0, 2.0, 2.0) == 3600.0
    assert set_back.age_s(130.0, 130.0, 130.0) == 0.0


def test_message_age_includes_wait_in_bridge() -> None:
    clocks = SenderClocks()
    without = RawSample(b"", b"", SECOND)
    assert clocks.estimate_age_ns(without, 0, 4 * SECOND) == 3 * SECOND, (
        "a plain Zenoh client attaches nothing"
    )
    assert Sender(clocks, 0.0).age_s(1.0, 1.0, 4.0) == 3.0, (
        "and nothing is known of this sender yet"
    )


def test_each_sender_has_a_clock_of_its_own() -> None:
    clocks = SenderClocks()
    first, second = Sender(clocks, -3600.0), Sender(clocks, 0.0, OTHER)
    assert first.age_s(1.0, 1.02, 1.02) == 0.0
    assert second.age_s(2.0, 2.02, 2.02) == 0.0
    assert first.age_s(3.0, 3.52, 3.52) == pytest.approx(0.5)
    assert second.age_s(4.0, 4.02, 4.02) == 0.0


def test_message_age_of_late_arm_request_refuses_with_advice() -> None:
    def request(sent_s: float) -> bytes:
        return make_attachment(1, round(sent_s * SECOND), GID)

    assert explain_stale_request(request(100.0), 103 * SECOND) == ""
    assert "was sent 30 s ago, by the clock of its sender" in explain_stale_request(
        request(100.0), 130 * SECOND
    )
    assert "was sent 3600 s in the future" in explain_stale_request(request(3700.0), 100 * SECOND)
    assert explain_stale_request(b"", 0) == "the request has no time attached"


def test_a_reason_names_the_limit_and_the_way_out() -> None:
    assert explain_stale_message(MAX_AGE_NS, "its stamp") == ""
    assert explain_stale_message(MAX_AGE_NS + 1, "its stamp") == "is older than 0.5 s by its stamp"
    assert "use_sim_time" in explain_stale_message(-SECOND, "its stamp")
