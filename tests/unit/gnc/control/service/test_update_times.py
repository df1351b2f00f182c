"""Tests when durations of updates show that a controller is too slow, and not only delayed by a busy computer."""

import pytest

from snakesim_gnc.control.service.update_times import UpdateTimes
from snakesim_testing.gnc.stage import make_stage

ROBOT = make_stage(3).robot
PERIOD_S = ROBOT.period_ns * 1e-9
LEASE_S = ROBOT.lease_ns * 1e-9


@pytest.mark.parametrize(
    ("durations_s", "expected_reason"),
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
def test_update_times_give_the_reason_of_a_slow_controller(
    durations_s: list[float], expected_reason: str
) -> None:
    times = UpdateTimes(ROBOT)
    for duration_s in durations_s:
        times.add_duration(duration_s)
    if expected_reason:
        assert expected_reason in times.too_slow_reason
    else:
        assert times.too_slow_reason == ""
