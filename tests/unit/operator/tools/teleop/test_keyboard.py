"""Detects keys that may have waited in a terminal or on a network before teleop read them."""

import pytest

from snakesim_operator.robot_commands.teleop.keyboard import (
    MAX_KEYS_PER_READ,
    MAX_UNREAD_DURATION_S,
    KeyTiming,
)

PERIOD_S = 0.05  # of teleop


def find_late_reads(key_counts: list[int], period_s: float = PERIOD_S) -> list[bool]:
    """Return for each read whether its keys are late; a first read at 0 s finds no key.

    Args:
        key_counts: number of keys that each read finds.
        period_s: time between two reads.
    """
    timing = KeyTiming()
    timing.record_read(0, 0.0)
    return [
        timing.record_read(count, (read + 1) * period_s) for read, count in enumerate(key_counts)
    ]


@pytest.mark.parametrize(
    ("repeat_hz", "period_s"), [(30, 0.05), (30, 0.01), (50, 0.05), (20, 0.01)]
)
def test_key_that_repeats_is_never_late(repeat_hz: int, period_s: float) -> None:
    read_count = round(3.0 / period_s)
    key_counts = [
        int((read + 1) * period_s * repeat_hz) - int(read * period_s * repeat_hz)
        for read in range(read_count)
    ]
    assert sum(key_counts) >= 3 * repeat_hz - 1
    assert not any(find_late_reads(key_counts, period_s))


@pytest.mark.parametrize("key_counts", [[270], [20] * 14, [8] * 34])
@pytest.mark.parametrize("period_s", [0.05, 0.01])
def test_keys_after_network_delay_of_14_seconds_are_late(
    key_counts: list[int], period_s: float
) -> None:
    empty_reads = 280  # 14 s with the period of teleop
    are_late = find_late_reads([0] * empty_reads + key_counts, period_s)[empty_reads:]
    accepted = sum(
        count for count, is_late in zip(key_counts, are_late, strict=True) if not is_late
    )
    assert accepted <= 30, "no more keys than a person presses in half a second"
    assert are_late[-1]
    assert all(are_late[4:])


def test_keys_after_pause_of_teleop_are_late() -> None:
    timing = KeyTiming()
    assert timing.record_read(1, 0.0), "the key was typed before the first read"
    assert not timing.record_read(1, 0.05)
    assert timing.record_read(1, 0.05 + MAX_UNREAD_DURATION_S + 0.01), "the program was suspended"
    assert not timing.record_read(MAX_KEYS_PER_READ, 0.7)
    assert timing.record_read(MAX_KEYS_PER_READ + 1, 0.8)
