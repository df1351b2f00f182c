"""The shipped scenario over the kernel's CAN bus, with every process of a real run.

`pytest -rP tests/system/can/test_triplet.py` prints a row.
"""

import time
from pathlib import Path

import numpy as np
import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.command import snakesim

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

ROBOT_TIME_S = "10"
RUN_TIMEOUT_S = 400.0  # an emulated machine is slow


def test_triplet_over_socketcan_equals_virtual_bus_to_the_bit(tmp_path: Path, channel: str) -> None:
    real_bus_options = (f'backend.channels=["{channel}"]', 'backend.emulators="process"')
    records: dict[str, RunRecord] = {}
    wall_time_s: dict[str, float] = {}
    for name, options in (("virtual", ()), (channel, real_bus_options)):
        start_s = time.monotonic()
        arguments = [
            "triplet",
            "--backend",
            "can",
            "--duration",
            ROBOT_TIME_S,
            "--endpoint",
            find_free_endpoint(),
        ]
        arguments += [
            argument for value in ("stall_limit_s=300", *options) for argument in ("--set", value)
        ]
        result = snakesim("run", *arguments, "--out", name, cwd=tmp_path, timeout_s=RUN_TIMEOUT_S)
        wall_time_s[name] = time.monotonic() - start_s
        assert result.code == 0, result.out + result.err
        records[name] = RunRecord.load(tmp_path / name)
    virtual = records["virtual"]
    real = records[channel]
    expected_ticks = round(float(ROBOT_TIME_S) * 100)
    assert real.host.command_digest == virtual.host.command_digest
    assert virtual.host.armed_ticks == expected_ticks
    assert real.host.armed_ticks == expected_ticks
    for name in ("angle_rad", "mode", "target", "position_w_m"):
        assert np.array_equal(getattr(real, name), getattr(virtual, name)), name
    # The pose of the base arrives by UDP, as from motion capture.
    assert np.isfinite(real.position_w_m).all()
    moved_rad = float(np.abs(real.angle_rad[-1] - real.angle_rad[0]).max())
    assert moved_rad > 0.01, "the robot did not move"
    print(
        f"| triplet, {ROBOT_TIME_S} s of robot time | command digest {real.host.command_digest[:16]} on {channel} and "
        f"on the virtual bus | joint moved most: {moved_rad:.3f} rad, all angles equal to the bit "
        f"| {wall_time_s[channel]:.0f} s on {channel}, {wall_time_s['virtual']:.0f} s on the virtual bus |"
    )
