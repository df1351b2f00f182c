"""`snakesim.Robot`: scripts on a robot that runs, as docs/python.md has them."""

import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

import snakesim
from snakesim_operator.playback.info import inspect_recording
from tests.e2e.command import Ended, Running, armed_run, call, environment, running
from tests.e2e.documents import REPOSITORY, sections
from tests.harness.wait import wait_until

pytestmark = pytest.mark.e2e

ROBOT = ("triplet", "--set", "rate_hz=50", "--duration", "600", "--stay", "--pace")
EXTERNAL = ("--set", "services.control.external=true")


@pytest.fixture(scope="module", params=["realtime", "lockstep"])
def waiting(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A robot that waits for its controller."""
    with running(tmp_path_factory.mktemp("robot") / "run", *ROBOT, request.param, *EXTERNAL) as started:
        started.wait_for("a client that takes the lease")
        yield started


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A robot with a controller of its own."""
    with armed_run(tmp_path_factory.mktemp("driven") / "run", *ROBOT, "realtime") as started:
        yield started


STUMBLED = "lease of control expired: no accepted command", "nothing commands the robot: the lease is free"
TRIES = 4


def script(text: str, run: Running, folder: Path) -> Ended:
    """Run a script; again, where this machine has held it up for longer than a lease."""
    for _ in range(TRIES - 1):
        settled(run)
        done = called(text, run, folder)
        if not any(words in done.said for words in STUMBLED):
            return done
        for left in folder.glob("*.mcap"):
            left.unlink()
    settled(run)
    return called(text, run, folder)


def called(text: str, run: Running, folder: Path) -> Ended:
    """Run a script once."""
    (folder / "script.py").write_text(textwrap.dedent(text))
    env = environment(folder, PYTHONPATH=str(REPOSITORY))
    return call([sys.executable, "script.py", run.endpoint], folder, env, 60.0, urgent=True)


def settled(run: Running) -> None:
    with snakesim.Robot.connect(run.endpoint) as robot:
        wait_until(lambda: "control" in robot.status.waiting_for, "a run that waits for its controller")
        if robot.status.lifecycle != "disarmed":
            robot.clear()


def test_the_script_of_the_documents_turns_a_joint_and_records(waiting: Running, tmp_path: Path) -> None:
    nod = next(s for s in sections(REPOSITORY / "docs" / "python.md") if "nod.py" in s.files).files["nod.py"]
    ended = script(nod, waiting, tmp_path)
    assert ended.code == 0, ended.err
    assert "planar13, sim: disarmed\njoint_3 turned by +0.0" in ended.out or "turned by +0.1" in ended.out
    assert ended.out.endswith("the robot is disarmed\n")
    with snakesim.Robot.connect(waiting.endpoint) as robot:
        assert robot.status.lifecycle == "disarmed"
    held = inspect_recording(tmp_path / "nod.mcap").keys
    assert held["actuator/joints"]["count"] > 50 and "hal/description" in held


def test_an_exception_disarms_what_was_armed(waiting: Running, tmp_path: Path) -> None:
    failing = """
        import sys, snakesim
        with snakesim.Robot.connect(sys.argv[1]) as robot:
            robot.arm()
            print(robot.status.lifecycle, flush=True)
            raise ValueError("no idea")
    """
    ended = script(failing, waiting, tmp_path)
    assert ended.out == "armed\n" and "no idea" in ended.err
    with snakesim.Robot.connect(waiting.endpoint) as robot:
        assert robot.status.lifecycle == "disarmed", robot.status.why


def test_a_stop_by_somebody_else_ends_the_wait(waiting: Running, tmp_path: Path) -> None:
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
    assert ended.out.startswith("planar13 is no longer armed, but estop: "), ended.said
    settled(waiting)


def test_what_is_no_command_is_refused_before_it_is_sent(waiting: Running) -> None:
    with snakesim.Robot.connect(waiting.endpoint) as robot:
        with pytest.raises(snakesim.ConfigError, match=r"target is \[0.0\], must be 13 finite numbers"):
            robot.command([0.0])
        with pytest.raises(snakesim.ConfigError, match=r"no key 'sensor/joint'.* did you mean `sensor/joints`"):
            robot.read("sensor/joint")


def test_a_robot_with_a_controller_is_watched_tuned_and_recorded(driven: Running, tmp_path: Path) -> None:
    with snakesim.Robot.connect(driven.endpoint, name="planar13") as robot:
        before = robot.wait()
        assert robot.wait() > before
        joints = robot.joints
        assert joints is not None and len(joints.angle_rad) == len(robot.names) == 13
        assert robot.pose is not None and robot.age_s(robot.pose) < 10
        assert robot.parameters["control.stall_s"].unit == "s"
        robot.set({"control.stall_s": 2.0})
        assert robot.parameters["control.stall_s"].value == 2.0
        with robot.record(tmp_path / "live.mcap"):
            robot.wait()
        assert inspect_recording(tmp_path / "live.mcap").robot == "planar13"
        with pytest.raises(snakesim.ConfigError, match=r"live.mcap: File exists"), robot.record(tmp_path / "live.mcap"):
            pass
        with pytest.raises(snakesim.RefusedError, match=r"has a controller already; .*services.control.external=true"):
            robot.arm()
        robot.estop()
        assert robot.wait() and robot.status.lifecycle == "estop"


def test_where_there_is_no_robot_it_says_so() -> None:
    with pytest.raises(snakesim.NotConnectedError, match=r"no robot on tcp/127.0.0.1:9; is its HAL host running"):
        snakesim.Robot.connect("tcp/127.0.0.1:9")
    with pytest.raises(snakesim.ConfigError, match="endpoint"):
        snakesim.Robot.connect("127.0.0.1")
