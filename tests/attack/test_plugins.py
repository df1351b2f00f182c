"""Controllers and backends that misbehave: the robot stops, the run names what is known, and nothing is left of it."""

import json
from pathlib import Path

import pytest

from tests.attack.command import snakesim
from tests.attack.effort import FULL
from tests.harness.endpoint import free_endpoint
from tests.harness.processes import nothing_left

BAD = """
import ctypes
import os
import signal
import sys
import time

from snakesim_gnc.control.hold import Hold
from snakesim_sim_backend.backend import SimBackend

DEEDS = {
    "raises": lambda: 1 / 0,
    "exits": lambda: sys.exit(0),
    "dies": lambda: os._exit(0),
    "hangs": lambda: time.sleep(1e6),
    "spins": lambda: [None for _ in iter(int, 1)],
    "holds the interpreter": lambda: ctypes.PyDLL(None).sleep(1000),
    "spams": lambda: [print("x" * 100_000) for _ in iter(int, 1)],
    "stops": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "closes": lambda: os.closerange(3, 4096),
    "interrupts": lambda: os.kill(os.getpid(), signal.SIGINT),
}


class Controller(Hold):
    calls = 0

    def update(self, observation):
        Controller.calls += 1
        if Controller.calls == 30:
            DEEDS["%s"]()
        return super().update(observation)


class Backend(SimBackend):
    def sample(self, tick, timestamp_ns):
        if tick == 30:
            DEEDS["%s"]()
        return super().sample(tick, timestamp_ns)
"""
GONE, LATE = "control is gone", "lease of control expired"
BY_CONTROLLER = {
    "raises": "update() raised ZeroDivisionError",
    "exits": "update() raised SystemExit",
    "dies": GONE,
    "hangs": LATE,
    "spins": LATE,
    "spams": LATE,
    "stops": LATE,
    "closes": GONE,
    "interrupts": GONE,
}
BY_BACKEND = {
    "raises": "Backend.sample failed: ZeroDivisionError",
    "exits": "Backend.sample failed: SystemExit",
    "dies": "host ended with exit code 0",
    "hangs": "the host has said nothing for 10 s",
    "spins": "its process computes",
    "stops": "its process was stopped by a signal",
    "interrupts": "by ",  # SIGINT, or its handler in the host if that comes first
}
QUICK = {("controller", "hangs"), ("controller", "closes"), ("backend", "exits")}
# What `hangs` does is in make test, too: tests/e2e/test_faults.py, test_beside.py.
SLOW = {("controller", "hangs")}
DEEDS = [
    pytest.param(who, deed, words, id=f"{who}-{deed}", marks=[pytest.mark.slow] * ((who, deed) in SLOW))
    for who, deeds in (("controller", BY_CONTROLLER), ("backend", BY_BACKEND))
    for deed, words in deeds.items()
    if FULL or (who, deed) in QUICK
]


@pytest.mark.parametrize(("who", "deed", "words"), DEEDS)
def test_a_plugin_that_misbehaves_stops_its_robot_only(tmp_path: Path, who: str, deed: str, words: str) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", deed))
    chosen = {"controller": "hold", "backend": "sim"} | {who: f"./bad.py:{who.capitalize()}"}
    out = tmp_path / "out"
    ended = snakesim(
        tmp_path,
        *("run", "triplet", "--controller", chosen["controller"], "--backend", chosen["backend"]),
        *("--clock-mode", "realtime", "--set", "rate_hz=50", "--duration", "60"),
        *("--out", str(out), "--endpoint", free_endpoint()),
    )
    summary = json.loads((out / "summary.json").read_bytes())
    assert ended.code == 1 and words in summary["ended"], ended.said
    assert summary["duration_s"] < 60
    nothing_left(out, 20.0)
    assert sum(file.stat().st_size for file in out.iterdir()) < 200 * 2**20
