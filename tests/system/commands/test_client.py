"""Clients control a running robot: the examples of docs/how-to/client.md, and `snakesim.Robot`."""

import ast
import re
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
from snakesim_testing.hal.local_network import wait_for_tick
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

CLIENT = REPOSITORY / "examples" / "client.py"
STEER = REPOSITORY / "examples" / "steer.py"
STOP = REPOSITORY / "examples" / "stop.py"
MAX_CLIENT_LINES = 100
STOP_CODE_LINES = 9
READER_DEPTH = 8192  # joint states of the whole motion
LATENCY_TICKS = 2  # of control in this scenario: the number of commands that may be in transit
ROBOT = ("triplet", "--set", "rate_hz=50", "--duration", "600", "--stay", "--clock-mode")
EXTERNAL = ("--set", "services.control.external=true")


@pytest.fixture(
    scope="module", params=["lockstep", pytest.param("realtime", marks=pytest.mark.quiet)]
)
def waiting_run(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RunningCommand]:
    """Run a robot that waits for its controller."""
    with running_snakesim(
        tmp_path_factory.mktemp("robot") / "run", *ROBOT, request.param, *EXTERNAL
    ) as started:
        started.wait_for("a client that takes the lease")
        yield started


@pytest.fixture(scope="module")
def controlled_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCommand]:
    """Run a robot that has a controller already."""
    with running_armed_snakesim(
        tmp_path_factory.mktemp("driven") / "run", *ROBOT, "realtime"
    ) as started:
        yield started


@pytest.mark.parametrize(
    ("client", "packages"),
    [(CLIENT, {"msgpack", "zenoh"}), (STEER, {"msgpack", "zenoh"}), (STOP, set[str]())],
)
def test_example_client_imports_only_documented_packages(client: Path, packages: set[str]) -> None:
    tree = ast.parse(client.read_text(encoding="utf-8"))
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported = {
        name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names
    }
    assert imported - sys.stdlib_module_names == packages


def test_example_clients_are_as_short_as_documented() -> None:
    assert len(CLIENT.read_text(encoding="utf-8").splitlines()) < MAX_CLIENT_LINES
    lines = STOP.read_text(encoding="utf-8").split("import sys\n")[1].split("\n")
    assert len([line for line in lines if line]) == STOP_CODE_LINES


def read_status(session: Session) -> RobotStatus:
    """Return the status of the robot."""
    status = session.wait_for_latched(keys.STATUS, RobotStatus, 10.0)
    assert status is not None
    return status


def raise_priority() -> None:
    """Give a client the priority of control where that is allowed, because a busy computer would delay it."""
    set_realtime_priority(SERVICE_PRIORITY)


def test_example_client_arms_moves_one_joint_and_disarms(waiting_run: RunningCommand) -> None:
    """The test is the first that uses this robot, so that all counted commands are those of the client."""
    with open_session(ConnectionSettings(waiting_run.endpoint, "planar13")) as session:
        wait_until(
            lambda: read_status(session).waiting_for == ["control"],
            "a run that waits only for control",
        )
        joints = session.declare_reader(keys.JOINTS, JointState, depth=READER_DEPTH)
        completed = run_program(
            [sys.executable, CLIENT, waiting_run.endpoint, "planar13"],
            waiting_run.home,
            preexec_fn=raise_priority,
        )
        assert completed.code == 0, completed.out + completed.err
        turned = re.search(r"joint_3 turned by ([+-]\d\.\d+) rad", completed.out)
        assert turned is not None, completed.out
        assert 0.09 < float(turned[1]) < 0.11, completed.out
        end_status = read_status(session)
        states = wait_for_tick(joints, end_status.tick, "the last joint state")
        angles = [state.angle_rad for state in states]
        motions_rad = [
            max(abs(angle - joint_angles[0]) for angle in joint_angles)
            for joint_angles in zip(*angles, strict=True)
        ]
        assert 0.09 < motions_rad[2] < 0.11, motions_rad
        assert max(motions_rad[:2] + motions_rad[3:]) < 0.03, motions_rad
        assert end_status.lifecycle == "disarmed"
        assert set(end_status.commands_rejected) <= {"no_lease"}
        # The last commands are rejected if the host first notices that the client has left.
        assert end_status.commands_rejected.get("no_lease", 0) <= LATENCY_TICKS
        assert end_status.commands_accepted > 50
        assert {fault.what for fault in end_status.faults} <= {"service_lost"}


def test_example_stop_by_udp_stops_the_robot(waiting_run: RunningCommand) -> None:
    host, _, port = waiting_run.endpoint.removeprefix("tcp/").partition(":")
    completed = run_program([sys.executable, STOP, host, port], waiting_run.home)
    assert completed.code == 0, completed.out + completed.err
    assert completed.out.startswith("planar13\n"), completed.out
    assert "anna" in completed.out
    with open_session(ConnectionSettings(waiting_run.endpoint, "planar13")) as session:
        assert read_status(session).lifecycle == "estop"
    reset_robot(waiting_run)


def run_script(text: str, run: RunningCommand, folder: Path) -> CompletedRun:
    """Run a Python script to its end, with a robot that waits for a controller."""
    reset_robot(run)
    (folder / "script.py").write_text(textwrap.dedent(text))
    env = make_environment(folder, PYTHONPATH=str(REPOSITORY))
    return run_program(
        [sys.executable, "script.py", run.endpoint], folder, env, 60.0, raise_priority
    )


def reset_robot(run: RunningCommand) -> None:
    """Wait until the robot waits for a controller, and reset its fault or emergency stop."""
    with snakesim.Robot.connect(run.endpoint) as robot:
        wait_until(
            lambda: "control" in robot.status.waiting_for, "a run that waits for its controller"
        )
        if robot.status.lifecycle != "disarmed":
            robot.reset_fault()


def test_documented_python_script_turns_joint_and_records(
    waiting_run: RunningCommand, tmp_path: Path
) -> None:
    sections = parse_sections(REPOSITORY / "docs" / "how-to" / "python.md")
    section = next(section for section in sections if "nod.py" in section.files)
    completed = run_script(section.files["nod.py"], waiting_run, tmp_path)
    assert completed.code == 0, completed.err
    assert (
        "planar13, sim: disarmed\njoint_3 turned by +0.0" in completed.out
        or "turned by +0.1" in completed.out
    )
    assert completed.out.endswith("the robot is disarmed\n")
    with snakesim.Robot.connect(waiting_run.endpoint) as robot:
        assert robot.status.lifecycle == "disarmed"
    recorded_keys = inspect_recording(tmp_path / "nod.mcap").keys
    assert recorded_keys["actuator/joints"]["count"] > 50
    assert "hal/description" in recorded_keys


def test_python_client_with_exception_disarms_the_robot(
    waiting_run: RunningCommand, tmp_path: Path
) -> None:
    program = """
        import sys, snakesim
        with snakesim.Robot.connect(sys.argv[1]) as robot:
            robot.arm()
            print(robot.status.lifecycle, flush=True)
            raise ValueError("no idea")
    """
    completed = run_script(program, waiting_run, tmp_path)
    assert completed.out == "armed\n", completed.err
    assert "no idea" in completed.err
    with snakesim.Robot.connect(waiting_run.endpoint) as robot:
        assert robot.status.lifecycle == "disarmed", robot.status.reason


def test_python_client_stopped_by_another_client_gets_error(
    waiting_run: RunningCommand, tmp_path: Path
) -> None:
    program = """
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
    completed = run_script(program, waiting_run, tmp_path)
    assert completed.out.startswith("planar13 is no longer armed, but estop: "), completed.printed
    reset_robot(waiting_run)


@pytest.mark.heavy
def test_python_client_invalid_command_or_key_is_refused(waiting_run: RunningCommand) -> None:
    with snakesim.Robot.connect(waiting_run.endpoint) as robot:
        with raises_error(snakesim.ConfigError, code="python/invalid-argument"):
            robot.command([0.0])
        with raises_error(snakesim.ConfigError, code="network/unknown-key", field="sensor/joint"):
            robot.read("sensor/joint")


@pytest.mark.quiet
def test_python_client_of_controlled_robot_reads_tunes_and_records(
    controlled_run: RunningCommand, tmp_path: Path
) -> None:
    with snakesim.Robot.connect(controlled_run.endpoint, name="planar13") as robot:
        first_tick = robot.wait()
        assert robot.wait() > first_tick
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
def test_python_client_without_robot_is_refused() -> None:
    with raises_error(snakesim.NotConnectedError, code="network/no-robot"):
        snakesim.Robot.connect("tcp/127.0.0.1:9")
    with raises_error(snakesim.ConfigError, code="network/invalid-address"):
        snakesim.Robot.connect("127.0.0.1")
