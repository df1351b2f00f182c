"""The driver alone, armed and holding the pose, until somebody kills it: `python -m tests.vcan.driver CONFIG`.

The real CAN backend in a process of its own, without Zenoh. On an emulated machine, which stumbles now and then, it
clears what that brings about and arms again.
"""

import argparse
import time
from pathlib import Path

from snakesim_can_backend.backend import CanBackend
from snakesim_can_backend.settings import Settings
from snakesim_hal.backend import SetPoints
from snakesim_hal.files import Table, decode
from snakesim_hal.messages import LifecycleState, Mode
from snakesim_hal.process import die_with_parent, settle_for_timing
from snakesim_hal.scenario import read

TICKS_BEFORE_ARMING = 25


def main() -> None:
    """Tick by absolute deadlines; a fault is printed, and disarms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", type=Path)
    parser.add_argument("--parent", type=int, required=True)
    given = parser.parse_args()
    die_with_parent(given.parent)
    config = read(given.config)
    backend = CanBackend(config, decode(Table(config.backend_settings, str(given.config)), Settings, "backends.can"))
    count = config.robot.chain.modules
    settle_for_timing()
    lifecycle: LifecycleState = "disarmed"
    wanted: SetPoints | None = None
    tick, arm_at, due = 0, TICKS_BEFORE_ARMING, time.monotonic()
    while True:
        joints = backend.sample(tick, tick * config.period_ns).joints
        if lifecycle == "fault" and tick == arm_at - TICKS_BEFORE_ARMING // 2:
            lifecycle = "disarmed"  # which clears
        if lifecycle == "disarmed" and tick >= arm_at and all(joints.valid):
            lifecycle = "armed"
            wanted = SetPoints([Mode.POSITION] * count, list(joints.angle_rad), [1.0] * count)
        backend.enact(wanted or SetPoints([Mode.PASSIVE] * count, [0.0] * count, [0.0] * count), lifecycle)
        backend.advance()
        for fault in backend.faults():
            print(f"tick {tick}: {fault.what}: {fault.cause}", flush=True)
            lifecycle, arm_at = "fault", tick + TICKS_BEFORE_ARMING
        tick += 1
        due = max(due + config.period_ns * 1e-9, time.monotonic() - config.period_ns * 1e-9)
        time.sleep(max(due - time.monotonic(), 0.0))


if __name__ == "__main__":
    main()
