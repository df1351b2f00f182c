"""`python -m benchmarks.slow_bus`: two buses in real time, one of which takes 20 ms a reading in a loop of 10 ms.

Emulated drives: a body of ODrive axes, a head of four servos. The delay is the injected fault `slow:bus_2`, which comes
in two steps: of 20 ms at once the first reading would be so late that the robot stops, as it should.
"""

import tempfile
from pathlib import Path

import numpy as np

import snakesim
from snakesim_hal.arrays import Floats
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import JointState
from snakesim_operator.recording.reader import RecordingReader

DURATION_S = 8.0
FIXED = {"robot": "planar13_mixed", "pace": "realtime", "backends.dynamixel.every_ticks": 2}
SLOW = ["slow:bus_2@0=0.01", "slow:bus_2@0.2=0.02"]
JOINTS = {"body": slice(0, 9), "head": slice(9, 13)}


def main() -> None:
    """Without the delay, and with it."""
    for faults in ([], SLOW):
        changed = {**FIXED, "faults": faults}
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run"
            run = snakesim.run("triplet", backend="mixed", duration=DURATION_S, set=changed, out=out, processes=True)
            ages_ms = read_ages_ms(out / "recording.mcap")[-run.summary.ticks :]
        ages = ", ".join(f"{name} {within(ages_ms[:, joints])}" for name, joints in JOINTS.items())
        print(
            f"{faults[-1] if faults else 'no delay':20} {run.ended}, moved {run.metrics['path_distance_m']:.3f} m; "
            f"{run.summary.overruns} of {run.summary.ticks} ticks overran; age of joint states: {ages}"
        )


def within(ages_ms: Floats) -> str:
    """Median, and what 99 of 100 are below."""
    return f"{np.median(ages_ms):.1f} ms (99 %: {np.percentile(ages_ms, 99):.1f} ms)"


def read_ages_ms(path: Path) -> Floats:
    """Of every joint state of a recording, (ticks, n_joints)."""
    states, decoder = RecordingReader(path).messages([keys.JOINTS]), Decoder(JointState)
    return np.array([decoder.decode(state.payload, state.encoding).age_ns for state in states]) * 1e-6


if __name__ == "__main__":
    main()
