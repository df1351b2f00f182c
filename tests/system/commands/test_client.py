"""Clients of a running robot: those of docs/how-to/client.md, and `snakesim.Robot` of docs/how-to/python.md."""

import ast
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

import snakesim
from snakesim_hal.base.process import SERVICE_PRIORITY, set_realtime_priority
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointState, RobotStatus
from snakesim_operator.playback.info import inspect_recording
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.command import (
    CompletedRun,
    RunningCommand,
    make_environment,
    run_program,
    running_armed_snakesim,
    running_snakesim,
)
from snakesim_testing.runs.documents import REPOSITORY, parse_sections

pytestmark = pytest.mark.e2e

CLIENT, STEER, STOP = (
    REPOSITORY / "examples" / name for name in ("client.py", "steer.py", "stop.py")
)
DEPTH = 8192
LATENCY_TICKS = 2  # of control in this scenario: so many commands may be on their way
ROBOT = ("triplet", "--set", "rate_hz=50", "--duration", "600", "--stay", "--clock-mode")
EXTERNAL = ("--set", "services.control.external=true")


@pytest.fixture(
    scope="module", params=["lockstep", pytest.param("realtime", marks=pytest.mark.quiet)]
)
def waiting(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RunningCommand]:
    """A robot that waits for its controller."""
    with running_snakesim(
        tmp_path_factory.mktemp("robot") / "run", *ROBOT, request.param, *EXTERNAL
    ) as started:
        started.wait_for("a client that takes the lease")
        yield started


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCommand]:
    """A robot with a controller of its own."""
    with running_armed_snakesim(
        tmp_path_factory.mktemp("driven") / "run", *ROBOT, "realtime"
    ) as started:
        yield started


@pytest.mark.parametrize(
    ("client", "known"),
    [(CLIENT, {"msgpack", "zenoh"}), (STEER, {"msgpack", "zenoh"}), (STOP, set[str]())],
)
def test_a_client_needs_nothing_of_ours(client: Path, known: set[str]) -> None:
    tree = ast.parse(client.read_text(encoding="utf-8"))
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported = {
        name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names
    }
    assert imported - sys.stdlib_module_names == known


def test_example_clients_are_as_short_as_documented() -> None:
    assert len(CLIENT.read_text(encoding="utf-8").splitlines()) < 100
    lines = STOP.read_text(encoding="utf-8").split("import sys\n")[1].split("\n")
    assert len([line for line in lines if line]) == 9


def status(session: Session) -> RobotStatus:
    found = session.wait_for_latched(keys.STATUS, RobotStatus, 10.0)
    assert found is not None
    return found


def urgently() -> None:
    """As a run's own control, where that is allowed: a busy computer holds it up otherwise."""
    set_realtime_priority(SERVICE_PRIORITY)


def test_a_client_leases_arms_moves_and_disarms(waiting: RunningCommand) -> None:
    """First of those who wait with the robot: what it has counted is of this client."""
    with open_session(ConnectionSettings(waiting.endpoint, "planar13")) as session:
        wait_until(
            lambda: status(session).waiting_for == ["control"], "a run that waits for control alone"
        )
        joints = session.declare_reader(keys.JOINTS, JointState, depth=DEPTH)
        ended = run_program(
            [sys.executable, CLIENT, waiting.endpoint, "planar13"],
            waiting.home,
            preexec_fn=urgently,
        )
        assert ended.code == 0, ended.out + ended.err
        angles = [state.angle_rad for state in joints.drain()]
        furthest = [
            max(abs(angle - joint[0]) for angle in joint) for joint in zip(*angles, strict=True)
        ]
        assert 0.09 < furthest[2] < 0.11, furthest
        assert max(furthest[:2] + furthest[3:]) < 0.03, furthest
        now = status(session)
        assert now.lifecycle == "disarmed"
        assert set(now.commands_rejected) <= {"no_lease"}
        # The last ones, if the host notices first that the client has left.
        assert now.commands_rejected.get("no_lease", 0) <= LATENCY_TICKS
        assert now.commands_accepted > 50
        assert {fault.what for fault in now.faults} <= {"service_lost"}


def test_a_stop_by_udp_stops_the_robot(waiting: RunningCommand) -> None:
    host, _, port = waiting.endpoint.removeprefix("tcp/").partition(":")
    ended = run_program([sys.executable, STOP, host, port], waiting.home)
    assert ended.code == 0 and ended.out.startswith("planar13\n") and "anna" in ended.out, (
        ended.out + ended.err
    )
    with open_session(ConnectionSettings(waiting.endpoint, "planar13")) as session:
        assert status(session).lifecycle == "estop"
    settled(waiting)


def script(text: str, run: RunningCommand, folder: Path) -> CompletedRun:
    """Run a script to its end, on a robot that waits for a controller."""
    settled(run)
    (folder / "script.py").write_text(textwrap.dedent(text))
    env = make_environment(folder, PYTHONPATH=str(REPOSITORY))
    return run_program([sys.executable, "script.py", run.endpoint], folder, env, 60.0, urgently)


def settled(run: RunningCommand) -> None:
    with snakesim.Robot.connect(run.endpoint) as robot:
        wait_until(
            lambda: "control" in robot.status.waiting_for, "a run that waits for its controller"
        )
        if robot.status.lifecycle != "disarmed":
            robot.reset_fault()


def test_the_script_of_the_documents_turns_a_joint_and_records(
    waiting: RunningCommand, tmp_path: Path
) -> None:
    nod = next(
        s
        for s in parse_sections(REPOSITORY / "docs" / "how-to" / "python.md")
        if "nod.py" in s.files
    ).files["nod.py"]
    ended = script(nod, waiting, tmp_path)
    assert ended.code == 0, ended.err
    assert (
        "planar13, sim: disarmed\njoint_3 turned by +0.0" in ended.out
        or "turned by +0.1" in ended.out
    )
    assert ended.out.endswith("the robot is disarmed\n")
    with snakesim.Robot.connect(waiting.endpoint) as robot:
        assert robot.status.lifecycle == "disarmed"
    held = inspect_recording(tmp_path / "nod.mcap").keys
    assert held["actuator/joints"]["count"] > 50
    assert "hal/description" in held


def test_an_exception_disarms_what_was_armed(waiting: RunningCommand, tmp_path: Path) -> None:
    failing = """
        import sys, snakesim
        with snakesim.Robot.connect(sys.argv[1]) as robot:
            robot.arm()
            print(robot.status.lifecycle, flush=True)
            raise ValueError("no idea")
    """
    ended = script(failing, waiting, tmp_path)
    assert ended.out == "armed\n", ended.err
    assert "no idea" in ended.err
    with snakesim.Robot.connect(waiting.endpoint) as robot:
        assert robot.status.lifecycle == "disarmed", robot.status.reason


def test_a_stop_by_somebody_else_ends_the_wait(waiting: RunningCommand, tmp_path: Path) -> None:
    stopped = """
        import sys, snakesim
        with snakesim.Robot.connect(sys.argv[1]) as robot:
            robot.arm()
            snakesim.Robot.connect(sys.argv[1]).estop()
            try:
                while True:
                    robot.wait()
                    robot.command(robot.joints.angle_rad)
            except snakesim.RefusedError as error:
                print(error)
    """
    ended = script(stopped, waiting, tmp_path)
    assert ended.out.startswith("planar13 is no longer armed, but estop: "), ended.printed
    settled(waiting)


def test_what_is_no_command_is_refused_before_it_is_sent(waiting: RunningCommand) -> None:
    with snakesim.Robot.connect(waiting.endpoint) as robot:
        with raises_error(snakesim.ConfigError, code="python/invalid-argument"):
            robot.command([0.0])
        with raises_error(snakesim.ConfigError, code="network/unknown-key", field="sensor/joint"):
            robot.read("sensor/joint")


@pytest.mark.quiet
def test_a_robot_with_a_controller_is_watched_tuned_and_recorded(
    driven: RunningCommand, tmp_path: Path
) -> None:
    with snakesim.Robot.connect(driven.endpoint, name="planar13") as robot:
        before = robot.wait()
        assert robot.wait() > before
        joints = robot.joints
        assert joints is not None
        assert len(joints.angle_rad) == len(robot.joint_names) == 13
        assert robot.pose is not None
        assert robot.age_s(robot.pose) < 10
        assert robot.parameters["control.stall_s"].unit == "s"
        robot.set({"control.stall_s": 2.0})
        assert robot.parameters["control.stall_s"].value == 2.0
        with robot.record(tmp_path / "live.mcap"):
            robot.wait()
        assert inspect_recording(tmp_path / "live.mcap").robot == "planar13"
        with (
            raises_error(snakesim.ConfigError, code="file/not-writable", field="live.mcap"),
            robot.record(tmp_path / "live.mcap"),
        ):
            pass
        with raises_error(snakesim.RefusedError, code="robot/has-controller"):
            robot.arm()
        robot.estop()
        assert robot.wait()
        assert robot.status.lifecycle == "estop"


@pytest.mark.slow
def test_where_there_is_no_robot_it_says_so() -> None:
    with raises_error(snakesim.NotConnectedError, code="network/no-robot"):
        snakesim.Robot.connect("tcp/127.0.0.1:9")
    with raises_error(snakesim.ConfigError, code="network/invalid-address"):
        snakesim.Robot.connect("127.0.0.1")
