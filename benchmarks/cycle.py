"""The control cycle on the bus, in real time: how soon a command is on it, and how regular Sync is.

The measurement is a whole run as a user starts it, with emulated drives on a virtual bus in the driver's process. The
candump log of the run has the time of each frame, and the controller writes down when it had each command ready.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.whole import run
from snakesim_can_backend.bus.load import MAX_LOAD, ReportSchedule, compute_bus_load
from snakesim_can_backend.protocol.definitions import Opcode, parse_opcode
from snakesim_hal.base.arrays import Floats
from snakesim_testing.can.module_rig import measure_bus_traffic

WARM_UP_CYCLES = 100  # left out at both ends of the run
RATE_HZ = 100
LOAD_JOINTS = (13, 18, 30)
LOAD_RATES_HZ = (50, 100, 200)
LOAD_HEADER = [
    "| joints | rate | computed, worst case | measured | apart | the driver |",
    "|---|---|---|---|---|---|",
]


@dataclass(frozen=True)
class CycleTimes:
    """Times of the control cycle in ms, each as (median, 99th percentile)."""

    command_to_first_setpoint_ms: tuple[float, float]
    command_to_last_setpoint_ms: tuple[float, float]
    sync_jitter_ms: tuple[float, float]  # deviation of the time between two Syncs from the period


def measure_cycle() -> CycleTimes:
    """Do one run, and measure its control cycles."""
    with tempfile.TemporaryDirectory() as folder:
        bus_log = Path(folder, "bus.log")
        command_log = Path(folder, "commands.txt")
        run(
            *("--backend", "can", "--clock-mode", "realtime", "--duration", "10"),
            *("--set", f"rate_hz={RATE_HZ}", "--set", f"backend.log={bus_log}"),
            *(
                "--controller",
                "benchmarks/stamped.py:Stamped",
                "--set",
                f"control.path={command_log}",
            ),
        )
        ready_s = np.loadtxt(command_log)
        sync_s, bursts_s = _read_frame_times(bus_log)
    sync_spacing_ms = np.diff(sync_s)[WARM_UP_CYCLES:-WARM_UP_CYCLES] * 1000
    first_s, last_s = np.array(bursts_s[WARM_UP_CYCLES:-WARM_UP_CYCLES]).T
    command_s = ready_s[np.searchsorted(ready_s, first_s) - 1]
    return CycleTimes(
        command_to_first_setpoint_ms=_median_and_p99((first_s - command_s) * 1000),
        command_to_last_setpoint_ms=_median_and_p99((last_s - command_s) * 1000),
        sync_jitter_ms=_median_and_p99(np.abs(sync_spacing_ms - 1000 / RATE_HZ)),
    )


def _median_and_p99(times_ms: Floats) -> tuple[float, float]:
    median_ms, p99_ms = np.percentile(times_ms, (50, 99)).tolist()
    return median_ms, p99_ms


def _read_frame_times(bus_log: Path) -> tuple[Floats, list[tuple[float, float]]]:
    """Read a candump log.

    Returns:
        The times of all Syncs, and the times of the first and the last setpoint after each Sync, in s.
    """
    sync_s: list[float] = []
    bursts_s: list[tuple[float, float]] = []
    first_s: float | None = None  # of the setpoints since the last Sync
    last_s = 0.0
    for line in bus_log.read_text(encoding="ascii").splitlines():
        timestamp, _channel, frame, *_ = line.split()
        opcode = parse_opcode(int(frame[:3], 16))
        frame_s = float(timestamp[1:-1])  # without its parentheses
        if opcode == Opcode.SYNC:
            sync_s.append(frame_s)
            if first_s is not None:
                bursts_s.append((first_s, last_s))
            first_s = None
        elif opcode == Opcode.SET_POINT:
            if first_s is None:
                first_s = frame_s
            last_s = frame_s
    return np.array(sync_s), bursts_s


def make_load_table() -> list[str]:
    """Return the rows of a Markdown table with the load of one bus: computed, and measured by the emulated drives."""
    rows = list(LOAD_HEADER)
    for joints in LOAD_JOINTS:
        for rate_hz in LOAD_RATES_HZ:
            _, before, after, _ = measure_bus_traffic(joints, rate_hz)
            computed = compute_bus_load(joints, ReportSchedule(rate_hz))
            measured = after.load_since(before)
            difference = "bus is full"
            if computed < 1:
                difference = f"{100 * (measured / computed - 1):+.1f} %"
            decision = "accepts it" if computed <= MAX_LOAD else "refuses it"
            rows.append(
                f"| {joints} | {rate_hz} Hz | {computed:.1%} | {measured:.1%} | {difference} | {decision} |"
            )
    return rows
