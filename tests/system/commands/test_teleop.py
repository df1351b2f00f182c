"""`snakesim teleop` in a pseudo-terminal drives the robot of a run, which stops when the operator is lost."""

import contextlib
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, LocomotionIntent, RobotStatus, Trajectory
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import RunningCommand, running_snakesim
from snakesim_testing.runs.teleop_terminal import LEFT, UP, TeleopTerminal, running_teleop

pytestmark = pytest.mark.e2e
STEER = Path(__file__).parents[3] / "examples" / "steer.py"
INTENT_WITHOUT_DIRECTION = LocomotionIntent(timestamp_ns=0, requester="placeholder of the test")


class PathFollower:
    """The newest speed along the path that navigation plans, with its reason."""

    def __init__(self, session: Session) -> None:
        self._reader = session.declare_reader(keys.TRAJECTORY, Trajectory)
        self.speed_m_s = math.nan
        self.reason = ""

    def has_speed(self, speed_m_s: float, reason: str) -> bool:
        """Return whether the newest path has a speed, and a reason that contains a text."""
        for newest in self._reader.drain()[-1:]:
            self.speed_m_s = newest.speed_m_s
            self.reason = newest.reason
        return self.speed_m_s == speed_m_s and reason in self.reason


def read_lifecycle(session: Session) -> str:
    """Return the lifecycle state of the robot, or an empty text if it sends no status."""
    status = session.wait_for_latched(keys.STATUS, RobotStatus, 5.0)
    return "" if status is None else status.lifecycle


@pytest.mark.heavy
def test_teleop_keys_drive_robot_and_lost_operator_stops_it(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with running_snakesim(out, "peg_row", "--clock-mode", "realtime", "--duration", "300") as run:
        run.wait_for("Locomoting")
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            intents = session.declare_reader(keys.INTENT, LocomotionIntent)
            path = PathFollower(session)
            with running_teleop(run, tmp_path) as lost_operator:
                assert intents.drain() == []
                assert lost_operator.wait_for_text("nothing requested yet") is None
                lost_operator.type(2 * UP)
                wait_until(lambda: path.has_speed(0.1, "teleop"), "navigation to go at 0.1 m/s")
                lost_operator.type(LEFT)
                wait_until(
                    lambda: (
                        (intents.drain() or [INTENT_WITHOUT_DIRECTION])[-1].heading_w_rad
                        is not None
                    ),
                    "a direction",
                )
                lost_operator.wait_for_text("requested: +0.10 m/s")
                lost_operator.process.send_signal(signal.SIGKILL)
                wait_until(lambda: path.has_speed(0.0, "expired"), "navigation to stop", 5.0)
            with running_teleop(run, tmp_path) as leaving_operator:
                leaving_operator.type(UP)
                wait_until(lambda: path.has_speed(0.05, "teleop"), "navigation to go at 0.05 m/s")
                leaving_operator.type(b"q")
                assert leaving_operator.process.wait(10) == 0
                assert leaving_operator.is_restored
                wait_until(
                    lambda: path.speed_m_s == 0.0 or path.has_speed(0.0, "wants it to stop"),
                    "navigation to stop",
                    5.0,
                )
            with subprocess.Popen(
                [sys.executable, str(STEER), run.endpoint, "planar13"], stderr=subprocess.PIPE
            ) as program:
                wait_until(
                    lambda: path.has_speed(0.1, "as steer.py wants it"),
                    "navigation to follow the documented client",
                )
                program.terminate()
                assert program.stderr is not None
                assert program.stderr.read() == b""
            with running_teleop(run, tmp_path) as stopping_operator:
                stopping_operator.type(b" ")
                wait_until(lambda: read_lifecycle(session) == "estop", "the emergency stop", 5.0)
                stopping_operator.process.send_signal(signal.SIGTERM)
                assert stopping_operator.process.wait(10) == 0
                assert stopping_operator.is_restored


@pytest.fixture(scope="module")
def lockstep_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCommand]:
    """Run a moving robot in lockstep, whose processes wait for each other."""
    out = tmp_path_factory.mktemp("lockstep") / "run"
    # In lockstep, a robot may be many times faster than real time. It must not end before the last test.
    duration = ("--duration", "3600")
    with running_snakesim(out, "peg_row", *duration, "--set", "stall_limit_s=60") as run:
        run.wait_for("Locomoting")
        yield run


@contextlib.contextmanager
def suspended_process(pid: int) -> Iterator[None]:
    """Suspend a process while the context is open."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@contextlib.contextmanager
def teleop_of_robot_waiting_for_navigation(
    run: RunningCommand, home: Path
) -> Iterator[TeleopTerminal]:
    """Request a speed by teleop, and then suspend navigation, so that a host in lockstep pauses the clock."""
    with running_teleop(run, home) as operator:
        operator.type(UP)
        operator.wait_for_text("requested: +0.05 m/s")
        with suspended_process(run.part("navigation")):
            yield operator


WAITS_FOR_NAVIGATION = " waits for navigation's answer to tick "


def test_teleop_of_paused_robot_shows_what_host_waits_for(
    lockstep_run: RunningCommand, tmp_path: Path
) -> None:
    with teleop_of_robot_waiting_for_navigation(lockstep_run, tmp_path) as operator:
        operator.wait_for_text(WAITS_FOR_NAVIGATION)


def test_control_of_paused_robot_reports_what_host_waits_for(
    lockstep_run: RunningCommand, tmp_path: Path
) -> None:
    """The robot does not move while the clock is paused, but its power is on and its connection is not lost."""
    with open_session(ConnectionSettings(lockstep_run.endpoint, "planar13")) as session:
        reader = session.declare_reader(keys.CONTROL_STATE, ControlState)
        states: list[ControlState] = []

        def has_reported_pause() -> bool:
            states.extend(reader.drain())
            return any(
                state.state == "NotLocomoting" and WAITS_FOR_NAVIGATION in state.reason
                for state in states
            )

        with teleop_of_robot_waiting_for_navigation(lockstep_run, tmp_path):
            wait_until(has_reported_pause, "control reports the pause and its reason")
    assert "PowerOff" not in {state.state for state in states}


@pytest.mark.heavy
def test_teleop_with_silent_host_shows_missing_clock(
    lockstep_run: RunningCommand, tmp_path: Path
) -> None:
    with running_teleop(lockstep_run, tmp_path) as operator:
        operator.wait_for_text("armed: ")
        with suspended_process(lockstep_run.part("host")):
            operator.wait_for_text("the robot has sent no clock for ")
            operator.wait_for_text("s ago): ")  # The terminal may cut off the rest of the line.
