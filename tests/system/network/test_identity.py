"""Who is who: host ids, the run key, the private channel, and the list of this computer's robots."""

import os
import signal
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import msgspec
import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.client import HostClient
from snakesim_hal.network.local_registry import (
    LocalRobot,
    get_robot_state_folder,
    list_local_robots,
    register_robot,
)
from snakesim_hal.network.private_channel import HostEnd, HostMessage, StarterEnd, socket_pair
from snakesim_hal.network.run_key import RUN_KEY, add_proof, has_valid_proof, new_run_key
from snakesim_hal.network.session import open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import RobotDescription, make_arm_request
from snakesim_testing.hal.local_network import SineFollower, running_follower, running_host
from snakesim_testing.hal.small_robots import make_description, make_run_config
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error


def test_a_description_is_proven_by_the_runs_key_alone() -> None:
    described, key = make_description(), new_run_key()
    ours = add_proof(described, key)
    assert has_valid_proof(ours, key)
    assert has_valid_proof(described, None)
    assert not has_valid_proof(described, key)
    assert not has_valid_proof(ours, new_run_key())
    assert not has_valid_proof(msgspec.structs.replace(ours, emulated=not ours.emulated), key)


def test_identity_service_of_a_run_ignores_forged_description(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(RUN_KEY, new_run_key())
    with (
        running_host(make_run_config()) as run,
        open_session(run.link) as stranger,
        open_session(run.link) as own,
    ):
        forged = msgspec.structs.replace(run.host.description, emulated=True, lease_ns=10**9)
        stranger.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(forged)
        assert HostClient(own, "control").wait_for_description() == run.host.description
        monkeypatch.setenv(RUN_KEY, new_run_key())  # a service of another run, on the wrong network
        with pytest.raises(NotConnectedError):
            HostClient(own, "control").wait_for_description(timeout_s=0.3)


def test_a_run_is_armed_over_its_private_channel() -> None:
    ours, its = socket_pair()
    starter = StarterEnd(ours)
    with (
        running_host(make_run_config(clock_mode="realtime"), starter_channel=HostEnd(its)) as run,
        running_follower(run.link, SineFollower()),
    ):

        def ready() -> bool:
            starter.receive()
            return starter.status is not None and starter.status.ready_to_arm

        wait_until(ready, "a status that is ready")
        robot = starter.description
        assert robot == run.host.description
        assert robot is not None
        arm = make_arm_request(robot, "the run")
        starter.send_request(msgspec.structs.replace(arm, host="another"))
        wait_until(lambda: starter.receive() or starter.answers, "an answer")
        refused = starter.answers.pop()
        assert not refused.ok
        assert refused.refusal == "wrong_host"
        starter.send_request(arm)
        wait_until(lambda: starter.receive() or starter.answers, "an answer")
        assert starter.answers.pop().ok
        run.wait_for_lifecycle("armed")
        assert run.status.reason.startswith("armed by the run")
        assert [text.split(": ", 1)[1] for text in run.host.request_log][
            -1
        ] == "arm by 'the run', done"
    starter.close()


def test_a_starter_that_does_not_read_holds_up_nothing() -> None:
    ours, its = socket_pair()
    with ours, its:
        host = HostEnd(its)
        for _ in range(5000):
            host.send(HostMessage(description=make_description()))


def a_robot() -> LocalRobot:
    where = {"endpoint": "tcp/127.0.0.1:7447", "stop_host": "127.0.0.1", "stop_port": 7447}
    return LocalRobot(namespace="worm", robot="worm", backend="sim", **where, pid=os.getpid())


def test_identity_robots_of_this_computer_are_listed_while_alive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert list_local_robots() == []
    with register_robot(a_robot()) as failure:
        assert failure is None
        assert list_local_robots() == [a_robot()]
    assert list_local_robots() == []


def test_a_run_that_was_killed_is_not_found_any_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    script = """
        import os, time
        from snakesim_hal.network.local_registry import LocalRobot, register_robot
        values = {"namespace": "worm", "robot": "worm", "backend": "sim", "endpoint": "tcp/127.0.0.1:7447"}
        with register_robot(LocalRobot(**values, stop_host="127.0.0.1", stop_port=7447, pid=os.getpid())):
            print("there", flush=True)
            time.sleep(60)
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)], stdout=subprocess.PIPE
    ) as run:
        assert run.stdout is not None
        assert run.stdout.readline()
        assert [robot.pid for robot in list_local_robots()] == [run.pid]
        os.kill(run.pid, signal.SIGKILL)
        run.wait()
        assert list_local_robots() == []
        assert not list((tmp_path / "snakesim" / "live").iterdir())


def test_a_folder_that_cannot_be_written_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "snakesim").write_text("a file where the folder belongs")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with register_robot(a_robot()) as failure:
        assert failure is not None
        assert "--endpoint" in failure
    assert list_local_robots() == []


def test_one_robot_is_one_folder_whatever_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    robots = tmp_path / "snakesim" / "robots"
    assert get_robot_state_folder("mamba", "can", "can0+can1") == robots / "mamba-can-can0+can1"
    assert get_robot_state_folder("../../etc", "sim", "").parent == robots


def test_identity_runs_started_together_have_separate_endpoints() -> None:
    from snakesim_operator.run.run_endpoint import reserve_endpoint

    first, its_port = reserve_endpoint(None, None, "worm")
    second, other_port = reserve_endpoint(None, None, "worm")
    with its_port, other_port:
        assert first != second
        with raises_error(NotConnectedError, code="network/port-in-use"):
            reserve_endpoint(first.endpoint, None, "worm")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", int(first.endpoint.rpartition(":")[2])))
