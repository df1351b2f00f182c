"""Which keys of a terminal may have waited before they were read."""

import pytest

from snakesim_operator.robot_commands.teleop.keyboard import (
    MAX_KEYS_PER_READ,
    MAX_UNREAD_DURATION_S,
    KeyTiming,
)

PERIOD_S = 0.05  # of teleop


def held_keys(keys_a_look: list[int], period_s: float = PERIOD_S) -> list[bool]:
    """Whether the keys of each look are late; before the first one nothing was typed."""
    timing = KeyTiming()
    timing.record_read(0, 0.0)
    return [
        timing.record_read(count, (look + 1) * period_s) for look, count in enumerate(keys_a_look)
    ]


@pytest.mark.parametrize(("hz", "period_s"), [(30, 0.05), (30, 0.01), (50, 0.05), (20, 0.01)])
def test_a_key_that_repeats_is_never_late(hz: int, period_s: float) -> None:
    looks = round(3.0 / period_s)
    came = [int((look + 1) * period_s * hz) - int(look * period_s * hz) for look in range(looks)]
    assert sum(came) >= 3 * hz - 1
    assert not any(held_keys(came, period_s))


@pytest.mark.parametrize("flushed", [[270], [20] * 14, [8] * 34])
@pytest.mark.parametrize("period_s", [0.05, 0.01])
def test_what_a_network_held_back_for_14_seconds_is_late(
    flushed: list[int], period_s: float
) -> None:
    late = held_keys([0] * 280 + flushed, period_s)[280:]
    taken = sum(count for count, is_late in zip(flushed, late, strict=True) if not is_late)
    assert taken <= 30, "no more than are pressed in half a second"
    assert late[-1]
    assert all(late[4:])


def test_keys_that_nobody_has_read_for_a_while_are_late() -> None:
    timing = KeyTiming()
    assert timing.record_read(1, 0.0), "typed before the first look"
    assert not timing.record_read(1, 0.05)
    assert timing.record_read(1, 0.05 + MAX_UNREAD_DURATION_S + 0.01), (
        "a program that was stopped meanwhile"
    )
    assert not timing.record_read(MAX_KEYS_PER_READ, 0.7)
    assert timing.record_read(MAX_KEYS_PER_READ + 1, 0.8)
