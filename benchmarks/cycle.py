"""The control cycle on the bus, in real time: how soon a command is on it, and how regular Sync is.

A whole run as a user starts it, with emulators on a virtual bus in the driver's process. Its candump log says when each
frame went out, and the controller writes down when it had each command ready.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.whole import run
from snakesim_can_backend.bus.load import MAX_LOAD, ReportSchedule, bus_load
from snakesim_can_backend.protocol.definitions import Opcode, parse_opcode
from snakesim_testing.can.module_rig import run_at

WARM_UP = 100  # cycles
RATE_HZ = 100
JOINTS, RATES_HZ = (13, 18, 30), (50, 100, 200)


@dataclass(frozen=True)
class Cycle:
    """Median and 99th percentile of each."""

    command_to_first_ms: tuple[float, float]
    command_to_last_ms: tuple[float, float]
    sync_jitter_ms: tuple[float, float]


def cycle() -> Cycle:
    """Measure one run."""
    with tempfile.TemporaryDirectory() as folder:
        log, stamps = Path(folder, "bus.log"), Path(folder, "commands.txt")
        run(
            *("--backend", "can", "--clock-mode", "realtime", "--duration", "10"),
            *("--set", f"rate_hz={RATE_HZ}", "--set", f"backend.log={log}"),
            *("--controller", "benchmarks/stamped.py:Stamped", "--set", f"control.path={stamps}"),
        )
        ready = np.loadtxt(stamps)
        syncs, bursts = _frames(log)
    spacing = np.diff(syncs)[WARM_UP:-WARM_UP] * 1000
    first, last = np.array(bursts[WARM_UP:-WARM_UP]).T
    commands = ready[np.searchsorted(ready, first) - 1]
    waits_and_jitter = ((first - commands) * 1000, (last - commands) * 1000, np.abs(spacing - 1000 / RATE_HZ))
    return Cycle(*(tuple(np.percentile(times_ms, (50, 99)).tolist()) for times_ms in waits_and_jitter))


def _frames(log: Path) -> tuple[np.ndarray, list[tuple[float, float]]]:
    """When each Sync went out, and first and last setpoint between two Syncs."""
    syncs: list[float] = []
    bursts: list[tuple[float, float]] = []
    first = last = 0.0
    for line in log.read_text(encoding="ascii").splitlines():
        stamp, _channel, frame, *_ = line.split()
        opcode, at = parse_opcode(int(frame[:3], 16)), float(stamp[1:-1])
        if opcode == Opcode.SYNC:
            syncs.append(at)
            if first:
                bursts.append((first, last))
            first = 0.0
        elif opcode == Opcode.SET_POINT:
            first, last = first or at, at
    return np.array(syncs), bursts


def load_table() -> list[str]:
    """Load of one bus, computed and measured by the emulators' model of bus time, as rows of a Markdown table."""
    rows = [
        "| joints | rate | computed, worst case | measured | apart | the driver |",
        "|---|---|---|---|---|---|",
    ]
    for joints in JOINTS:
        for rate_hz in RATES_HZ:
            _, before, after, _ = run_at(joints, rate_hz)
            computed, measured = bus_load(joints, ReportSchedule(rate_hz)), after.load_since(before)
            apart = f"{100 * (measured / computed - 1):+.1f} %" if computed < 1 else "bus is full"
            says = "takes it" if computed <= MAX_LOAD else "refuses it"
            rows.append(f"| {joints} | {rate_hz} Hz | {computed:.1%} | {measured:.1%} | {apart} | {says} |")
    return rows
