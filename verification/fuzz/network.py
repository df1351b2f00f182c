"""Fuzzes a running robot over its network: real processes, a real network, and an unauthorized client.

The run is first observed alone, and then while the client sends. The two periods are compared: processes, logs, memory,
overruns, accepted commands, the holder of the lease, and every setpoint that went to the motors.
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_testing.harness.processes import find_processes_of_run
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import TIMEOUT_S, RunningCommand, running_snakesim
from verification.fuzz.fuzz_client import ClientReport
from verification.fuzz.network_verdict import NetworkVerdict, judge_run
from verification.fuzz.run_watcher import ObservedPeriod, RunWatcher

ROBOT = "planar13"
SCENARIO = ("triplet", "--controller", "hold", "--clock-mode", "realtime", "--duration", "86400")


@dataclass(frozen=True)
class FuzzRequest:
    """What the client sends, and to which robot."""

    payload_count: int
    rate_hz: float
    seed: int = 1
    backend: str = "sim"
    # How long the robot is first observed alone; None for as long as the sending should take.
    quiet_s: float | None = None
    robot_hz: float = 100.0


def fuzz_network(out: Path, request: FuzzRequest) -> NetworkVerdict:
    """Start a run, observe it alone and while a client sends invalid payloads, and end it.

    Args:
        out: The folder of the run, which must not exist.
        request: What the client sends.
    """
    options = ("--backend", request.backend, "--set", f"rate_hz={request.robot_hz}")
    with start_run_and_join(out, ROBOT, *SCENARIO, *options) as (run, session):
        watcher = RunWatcher(session, out)
        wait_until(watcher.is_commanded, "armed and commanded")
        quiet = _watch_quiet_period(watcher, request)
        fuzzed = quiet
        client_report = ClientReport()
        if not quiet.failures:
            fuzzed, client_report = _watch_fuzzed_period(watcher, run.endpoint, request)
        run.interrupt()
    wait_until(lambda: not find_processes_of_run(out), "all processes of the run gone")
    return judge_run(out, quiet, fuzzed, client_report, request.payload_count)


def _watch_quiet_period(watcher: RunWatcher, request: FuzzRequest) -> ObservedPeriod:
    quiet_s = request.quiet_s
    if quiet_s is None:
        quiet_s = request.payload_count / request.rate_hz
    end_s = time.monotonic() + quiet_s
    return watcher.watch(lambda: time.monotonic() < end_s)


def _watch_fuzzed_period(
    watcher: RunWatcher, endpoint: str, request: FuzzRequest
) -> tuple[ObservedPeriod, ClientReport]:
    """Observe the run while the client sends. The report of a client that fails is empty."""
    with _start_client(endpoint, request) as client:
        period = watcher.watch(lambda: client.poll() is None)
        if period.failures:
            client.kill()
        output, _ = client.communicate(timeout=TIMEOUT_S)
    if client.returncode != 0:
        return period, ClientReport()
    return period, msgspec.json.decode(output, type=ClientReport)


@contextmanager
def start_run_and_join(
    out: Path, robot: str, *arguments: str
) -> Iterator[tuple[RunningCommand, Session]]:
    """Start a run, and open a session on its network. Both end with the `with` block."""
    with running_snakesim(out, *arguments) as run:
        run.wait_for("network:")
        with open_session(ConnectionSettings(run.endpoint, robot)) as session:
            yield run, session


@contextmanager
def _start_client(endpoint: str, request: FuzzRequest) -> Iterator[subprocess.Popen[bytes]]:
    numbers = (request.payload_count, request.rate_hz, request.seed)
    arguments = [endpoint, ROBOT, *map(str, numbers)]
    process = subprocess.Popen(
        [sys.executable, "-m", "verification.fuzz.fuzz_client", *arguments], stdout=subprocess.PIPE
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
