"""Controllers and backends that misbehave: the run stops its robot, reports the cause, and leaves no process behind."""

import json
from pathlib import Path
from typing import Any

import pytest

from snakesim_testing.harness.bad_plugins import BAD
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.processes import assert_no_process_left
from verification.attack.command import run_snakesim
from verification.attack.effort import FULL_EFFORT

PROCESS_ENDED = "control is gone"
LEASE_EXPIRED = "lease of control expired"
MAX_OUTPUT_BYTES = 200 * 2**20  # that a run may write, also if a plugin prints without end
RUN_DURATION_S = 60

# What the run reports for each misbehavior of harness/bad_plugins.py.
CONTROLLER_CAUSES = {
    "raises": "update() raised ZeroDivisionError",
    "exits": "update() raised SystemExit",
    "dies": PROCESS_ENDED,
    "hangs": LEASE_EXPIRED,
    "spins": LEASE_EXPIRED,
    "spams": LEASE_EXPIRED,
    "stops": LEASE_EXPIRED,
    "closes": PROCESS_ENDED,
    "interrupts": PROCESS_ENDED,
}
BACKEND_CAUSES = {
    "raises": "Backend.sample failed: ZeroDivisionError",
    "exits": "Backend.sample failed: SystemExit",
    "dies": "host ended with exit code 0",
    "hangs": "the host has sent no status for 10 s",
    "spins": "its process computes",
    "stops": "its process was stopped by a signal",
    "interrupts": "by ",  # SIGINT, or its handler in the host if that comes first
}
QUICK_CASES = {("controller", "hangs"), ("controller", "closes"), ("backend", "exits")}
# `make test` includes `hangs`, too: tests/system/runs/test_faults_in_processes.py, test_beside.py.
SLOW_CASES = {("controller", "hangs")}


def list_cases() -> list[Any]:
    """Return the parameters of all cases: kind of the plugin, misbehavior, and the cause that the run reports."""
    cases: list[Any] = []
    for kind, causes in (("controller", CONTROLLER_CAUSES), ("backend", BACKEND_CAUSES)):
        for misbehavior, cause in causes.items():
            case = (kind, misbehavior)
            if FULL_EFFORT or case in QUICK_CASES:
                marks = [pytest.mark.slow] if case in SLOW_CASES else []
                name = f"{kind}-{misbehavior}"
                cases.append(pytest.param(kind, misbehavior, cause, id=name, marks=marks))
    return cases


@pytest.mark.parametrize(("kind", "misbehavior", "cause"), list_cases())
def test_a_plugin_that_misbehaves_stops_its_robot_only(
    tmp_path: Path, kind: str, misbehavior: str, cause: str
) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", misbehavior))
    plugins = {"controller": "hold", "backend": "sim"}
    plugins[kind] = f"./bad.py:{kind.capitalize()}"
    out = tmp_path / "out"
    run = run_snakesim(
        tmp_path,
        *("run", "triplet", "--clock-mode", "realtime", "--set", "rate_hz=50"),
        *("--controller", plugins["controller"], "--backend", plugins["backend"]),
        *("--duration", str(RUN_DURATION_S), "--out", str(out)),
        *("--endpoint", find_free_endpoint()),
    )
    summary = json.loads((out / "summary.json").read_bytes())
    assert run.code == 1, run.printed
    assert cause in summary["ended"], run.printed
    assert summary["duration_s"] < RUN_DURATION_S
    assert_no_process_left(out, 20.0)
    assert sum(file.stat().st_size for file in out.iterdir()) < MAX_OUTPUT_BYTES
