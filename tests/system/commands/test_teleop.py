"""`snakesim teleop` in a pseudo-terminal, with a run: keys move the robot, and whoever loses the operator stops."""

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
from snakesim_testing.runs.teleop_terminal import LEFT, UP, running_teleop

pytestmark = pytest.mark.e2e
STEER = Path(__file__).parents[3] / "examples" / "steer.py"
NOTHING = LocomotionIntent(timestamp_ns=0, requester="nobody")


class Way:
    """What navigation makes of it: the newest speed along the path, and why."""

    def __init__(self, session: Session) -> None:
        self._reader = session.declare_reader(keys.TRAJECTORY, Trajectory)
        self.speed_m_s, self.reason = math.nan, ""

    def is_at(self, speed_m_s: float, why: str) -> bool:
        for newest in self._reader.drain()[-1:]:
            self.speed_m_s, self.reason = newest.speed_m_s, newest.reason
        return self.speed_m_s == speed_m_s and why in self.reason


def lifecycle(session: Session) -> str:
    found = session.wait_for_latched(keys.STATUS, RobotStatus, 5.0)
    return "" if found is None else found.lifecycle


def test_keys_move_it_and_a_lost_operator_stops_it(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with running_snakesim(out, "peg_row", "--clock-mode", "realtime", "--duration", "300") as run:
        run.wait_for("Locomoting")
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            intents, way = session.declare_reader(keys.INTENT, LocomotionIntent), Way(session)
            with running_teleop(run, tmp_path) as lost:
                assert intents.drain() == []
                assert lost.wait_for_text("nothing requested yet") is None
                lost.type(2 * UP)
                wait_until(lambda: way.is_at(0.1, "teleop"), "navigation to go at 0.1 m/s")
                lost.type(LEFT)
                wait_until(
                    lambda: (intents.drain() or [NOTHING])[-1].heading_w_rad is not None,
                    "a direction",
                )
                lost.wait_for_text("requested: +0.10 m/s")
                lost.process.send_signal(signal.SIGKILL)
                wait_until(lambda: way.is_at(0.0, "expired"), "navigation to stop", 5.0)
            with running_teleop(run, tmp_path) as left:
                left.type(UP)
                wait_until(lambda: way.is_at(0.05, "teleop"), "navigation to go at 0.05 m/s")
                left.type(b"q")
                assert left.process.wait(10) == 0
                assert left.is_restored
                wait_until(
                    lambda: way.speed_m_s == 0.0 or way.is_at(0.0, "wants it to stop"),
                    "navigation to stop",
                    5.0,
                )
            with subprocess.Popen(
                [sys.executable, str(STEER), run.endpoint, "planar13"], stderr=subprocess.PIPE
            ) as program:
                wait_until(
                    lambda: way.is_at(0.1, "as steer.py wants it"),
                    "navigation to follow the documented client",
                )
                program.terminate()
                assert program.stderr is not None
                assert program.stderr.read() == b""
            with running_teleop(run, tmp_path) as stops:
                stops.type(b" ")
                wait_until(lambda: lifecycle(session) == "estop", "the emergency stop", 5.0)
                stops.process.send_signal(signal.SIGTERM)
                assert stops.process.wait(10) == 0
                assert stops.is_restored


@pytest.fixture(scope="module")
def in_lockstep(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCommand]:
    """A robot on its way, whose processes wait for one another."""
    out = tmp_path_factory.mktemp("lockstep") / "run"
    with running_snakesim(out, "peg_row", "--duration", "300", "--set", "stall_limit_s=60") as run:
        run.wait_for("Locomoting")
        yield run


@contextlib.contextmanager
def frozen(pid: int) -> Iterator[None]:
    """A process, meanwhile."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def test_teleop_says_what_a_paused_clock_waits_for(
    in_lockstep: RunningCommand, tmp_path: Path
) -> None:
    """By the robot's own account; it has not gone."""
    why, run = " waits for navigation's answer to tick ", in_lockstep
    with (
        open_session(ConnectionSettings(run.endpoint, "planar13")) as session,
        running_teleop(run, tmp_path) as operator,
    ):
        operator.type(UP)
        operator.wait_for_text("requested: +0.05 m/s")
        states, found = (
            session.declare_reader(keys.CONTROL_STATE, ControlState),
            list[ControlState](),
        )

        def told() -> bool:
            found.extend(states.drain())
            return any(one.state == "NotLocomoting" and why in one.reason for one in found)

        with frozen(run.part("navigation")):
            operator.wait_for_text(why)
            wait_until(told, "control to say so, too")
        assert "PowerOff" not in {one.state for one in found}


def test_teleop_says_that_robot_stopped_sending(
    in_lockstep: RunningCommand, tmp_path: Path
) -> None:
    with running_teleop(in_lockstep, tmp_path) as operator:
        operator.wait_for_text("armed: ")
        with frozen(in_lockstep.part("host")):
            operator.wait_for_text("the robot has sent no clock for ")
            operator.wait_for_text("s ago): ")  # before what may be cut off at the edge
