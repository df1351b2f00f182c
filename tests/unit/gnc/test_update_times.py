"""A controller is too slow when updates would stop a robot, and not when a busy computer delayed some."""

import pytest

from snakesim_gnc.control.service.update_times import UpdateTimes
from snakesim_testing.gnc.stage import make_stage

ROBOT = make_stage(3).robot
PERIOD_S, LEASE_S = ROBOT.period_ns * 1e-9, ROBOT.lease_ns * 1e-9


@pytest.mark.parametrize(
    ("times_s", "words"),
    [
        ([], ""),
        ([0.9 * PERIOD_S] * 50, ""),
        ([1.5 * PERIOD_S] * 2, ""),
        ([0.1 * PERIOD_S] * 45 + [1.5 * PERIOD_S] * 5, ""),
        ([10 * PERIOD_S], "update() took 100 ms of 10 ms"),
        ([0.1 * PERIOD_S] * 999 + [1.1 * LEASE_S], "1 of 1000 updates took longer than a period"),
        (
            [0.1 * PERIOD_S] * 30 + [1.5 * PERIOD_S] * 5,
            "update() took 15 ms of 10 ms; 5 of 35 updates",
        ),
    ],
    ids=["none", "quick", "few", "a busy computer", "one", "a stop", "often"],
)
def test_what_shows_that_a_controller_is_too_slow(times_s: list[float], words: str) -> None:
    times = UpdateTimes(ROBOT)
    for took_s in times_s:
        times.add_duration(took_s)
    assert times.too_slow_reason == "" if not words else words in times.too_slow_reason
