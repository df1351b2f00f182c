"""A5: frozen processes that subscribe to every key do not stop the robot."""

import itertools
import signal
from pathlib import Path

import pytest

from verification.attack.command import start_run
from verification.attack.effort import FULL_EFFORT, RecordProperty, choose_effort
from verification.attack.robot import connect_operator
from verification.attack.robot_operator import Operator
from verification.attack.tools.floods import run_flooders

HOLD_POSE_AT_200_HZ = (
    *("triplet", "--controller", "hold", "--clock-mode", "realtime"),
    *("--set", "rate_hz=200", "--duration", "600", "--stay"),
)
OBSERVATION_S = choose_effort(3, 40)


@pytest.mark.parametrize("subscriber_count", [1, 4] if FULL_EFFORT else [2])
@pytest.mark.parametrize("_repetition", range(choose_effort(1, 5)))
def test_a5_frozen_subscribers_do_not_stop_the_robot(
    tmp_path: Path, subscriber_count: int, _repetition: int, record_property: RecordProperty
) -> None:
    with (
        start_run(tmp_path, *HOLD_POSE_AT_200_HZ) as run,
        connect_operator(run) as operator,
    ):
        operator.recover_robot()
        with run_flooders(tmp_path, "everything", run.endpoint, 0, subscriber_count) as subscribers:
            operator.recover_robot()
            for subscriber in subscribers:
                subscriber.send_signal(signal.SIGSTOP)
            operator.discard_streams()
            first_clock = operator.wait_for_next("hal/clock")
            try:
                operator.wait_for_stop(OBSERVATION_S)
            except AssertionError:
                gap_ms = 1000 * find_longest_gap(operator)
                record_property(
                    "armed all the time", f"{OBSERVATION_S} s; longest silence {gap_ms:.0f} ms"
                )
                return
            last_clock = operator.read_newest("hal/clock")
            reason = operator.wait_for_next("hal/status")["reason"]
    armed_s = (last_clock["timestamp_ns"] - first_clock["timestamp_ns"]) * 1e-9
    pytest.fail(
        f"{subscriber_count} frozen subscribers stopped the robot after {armed_s:.1f} s: {reason}"
    )


def find_longest_gap(operator: Operator) -> float:
    """Return the longest time in s between two received clocks."""
    times_s = [sample.received_s for sample in operator.list_samples("hal/clock")]
    return max(next_s - previous_s for previous_s, next_s in itertools.pairwise(times_s))
