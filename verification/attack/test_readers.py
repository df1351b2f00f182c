"""A5: a reader that is frozen, and still subscribes to everything, does not stop the robot."""

import itertools
import signal
from pathlib import Path

import pytest

from verification.attack.command import running
from verification.attack.effort import FULL, Record, effort
from verification.attack.means.floods import flood
from verification.attack.robot import joined

FAST = (
    "triplet",
    "--controller",
    "hold",
    "--clock-mode",
    "realtime",
    "--set",
    "rate_hz=200",
    "--duration",
    "600",
    "--stay",
)
WATCHED_S = effort(3, 40)


@pytest.mark.parametrize("readers", [1, 4] if FULL else [2])
@pytest.mark.parametrize("_time", range(effort(1, 5)))
def test_a5_frozen_readers_do_not_stop_the_robot(
    tmp_path: Path, readers: int, _time: int, record_property: Record
) -> None:
    with running(tmp_path, *FAST) as run, joined(run) as operator:
        operator.recover()
        with flood(tmp_path, "everything", run.endpoint, 0, readers) as frozen:
            operator.recover()
            for reader in frozen:
                reader.send_signal(signal.SIGSTOP)
            operator.forget()
            first = operator.next("hal/clock")
            try:
                operator.until(lambda: operator.lifecycle() != "armed", "a stop", WATCHED_S)
            except AssertionError:
                clocks = [heard.at_s for heard in operator.heard("hal/clock")]
                gap_s = max(b - a for a, b in itertools.pairwise(clocks))
                record_property(
                    "armed all the time", f"{WATCHED_S} s; longest silence {1000 * gap_s:.0f} ms"
                )
                return
            last = operator.newest("hal/clock")
            after_s = (last["timestamp_ns"] - first["timestamp_ns"]) * 1e-9
            why = operator.next("hal/status")["reason"]
            pytest.fail(f"{readers} frozen readers stopped the robot after {after_s:.1f} s: {why}")
