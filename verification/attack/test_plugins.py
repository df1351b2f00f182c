"""Controllers and backends that misbehave: the robot stops, the run names what is known, and nothing is left of it."""

import json
from pathlib import Path

import pytest

from snakesim_testing.harness.bad_plugins import BAD
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.processes import assert_no_process_left
from verification.attack.command import snakesim
from verification.attack.effort import FULL

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
# What `hangs` does is in `make test`, too: tests/system/runs/test_faults_in_processes.py, test_beside.py.
SLOW = {("controller", "hangs")}
DEEDS = [
    pytest.param(
        who, deed, words, id=f"{who}-{deed}", marks=[pytest.mark.slow] * ((who, deed) in SLOW)
    )
    for who, deeds in (("controller", BY_CONTROLLER), ("backend", BY_BACKEND))
    for deed, words in deeds.items()
    if FULL or (who, deed) in QUICK
]


@pytest.mark.parametrize(("who", "deed", "words"), DEEDS)
def test_a_plugin_that_misbehaves_stops_its_robot_only(
    tmp_path: Path, who: str, deed: str, words: str
) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", deed))
    chosen = {"controller": "hold", "backend": "sim"} | {who: f"./bad.py:{who.capitalize()}"}
    out = tmp_path / "out"
    ended = snakesim(
        tmp_path,
        *("run", "triplet", "--controller", chosen["controller"], "--backend", chosen["backend"]),
        *("--clock-mode", "realtime", "--set", "rate_hz=50", "--duration", "60"),
        *("--out", str(out), "--endpoint", find_free_endpoint()),
    )
    summary = json.loads((out / "summary.json").read_bytes())
    assert ended.code == 1 and words in summary["ended"], ended.printed
    assert summary["duration_s"] < 60
    assert_no_process_left(out, 20.0)
    assert sum(file.stat().st_size for file in out.iterdir()) < 200 * 2**20
