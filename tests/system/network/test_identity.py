"""A process knows which robot it talks to: run key, private channel, and the list of this computer's robots."""

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


def test_description_proof_is_valid_for_its_run_key_only() -> None:
    description = make_description()
    run_key = new_run_key()
    proven = add_proof(description, run_key)
    changed = msgspec.structs.replace(proven, emulated=not proven.emulated)
    assert has_valid_proof(proven, run_key)
    assert has_valid_proof(description, None)
    assert not has_valid_proof(description, run_key)
    assert not has_valid_proof(proven, new_run_key())
    assert not has_valid_proof(changed, run_key)


def test_service_of_a_run_ignores_forged_description(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(RUN_KEY, new_run_key())
    with (
        running_host(make_run_config()) as run,
        open_session(run.link) as other_session,
        open_session(run.link) as own,
    ):
        forged = msgspec.structs.replace(run.host.description, emulated=True, lease_ns=10**9)
        other_session.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(forged)
        assert HostClient(own, "control").wait_for_description() == run.host.description
        monkeypatch.setenv(RUN_KEY, new_run_key())  # a service of another run, on the wrong network
        with pytest.raises(NotConnectedError):
            HostClient(own, "control").wait_for_description(timeout_s=0.3)


def test_host_arms_on_request_over_private_channel() -> None:
    starter_socket, host_socket = socket_pair()
    starter = StarterEnd(starter_socket)
    with (
        running_host(make_run_config(), starter_channel=HostEnd(host_socket)) as run,
        running_follower(run.link, SineFollower()),
    ):

        def is_ready_to_arm() -> bool:
            starter.receive()
            return starter.status is not None and starter.status.ready_to_arm

        wait_until(is_ready_to_arm, "the host is ready to arm")
        robot = starter.description
        assert robot == run.host.description
        assert robot is not None
        arm_request = make_arm_request(robot, "the run")
        starter.send_request(msgspec.structs.replace(arm_request, host="another"))
        wait_until(lambda: starter.receive() or starter.answers, "an answer")
        refusal = starter.answers.pop()
        assert not refusal.ok
        assert refusal.refusal == "wrong_host"

        starter.send_request(arm_request)
        wait_until(lambda: starter.receive() or starter.answers, "an answer")
        assert starter.answers.pop().ok
        run.wait_for_lifecycle("armed")
        assert run.status.reason.startswith("armed by the run")
        _, logged_request = run.host.request_log[-1].split(": ", 1)
        assert logged_request == "arm by 'the run', done"
    starter.close()


@pytest.mark.heavy
def test_private_channel_whose_starter_does_not_read_blocks_nothing() -> None:
    starter_socket, host_socket = socket_pair()
    with starter_socket, host_socket:
        host = HostEnd(host_socket)
        for _ in range(5000):
            host.send(HostMessage(description=make_description()))


def make_local_robot() -> LocalRobot:
    """Describe a robot whose host is this process."""
    address = {"endpoint": "tcp/127.0.0.1:7447", "stop_host": "127.0.0.1", "stop_port": 7447}
    return LocalRobot(namespace="worm", robot="worm", backend="sim", **address, pid=os.getpid())


def test_local_robots_are_listed_while_registered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert list_local_robots() == []
    with register_robot(make_local_robot()) as failure:
        assert failure is None
        assert list_local_robots() == [make_local_robot()]
    assert list_local_robots() == []


def test_local_robot_whose_process_was_killed_is_not_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    script = """
        import os, time
        from snakesim_hal.network.local_registry import LocalRobot, register_robot
        values = {"namespace": "worm", "robot": "worm", "backend": "sim", "endpoint": "tcp/127.0.0.1:7447"}
        with register_robot(LocalRobot(**values, stop_host="127.0.0.1", stop_port=7447, pid=os.getpid())):
            print("registered", flush=True)
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


def test_register_robot_in_unwritable_folder_returns_the_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "snakesim").write_text("a file where the folder belongs")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with register_robot(make_local_robot()) as failure:
        assert failure is not None
        assert "--endpoint" in failure
    assert list_local_robots() == []


def test_robot_state_folder_contains_no_path_from_robot_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    robots = tmp_path / "snakesim" / "robots"
    assert get_robot_state_folder("mamba", "can", "can0+can1") == robots / "mamba-can-can0+can1"
    assert get_robot_state_folder("../../etc", "sim", "").parent == robots


def test_runs_started_together_reserve_separate_endpoints() -> None:
    from snakesim_operator.run.run_endpoint import reserve_endpoint

    first, first_port_lock = reserve_endpoint(None, None, "worm")
    second, second_port_lock = reserve_endpoint(None, None, "worm")
    with first_port_lock, second_port_lock:
        assert first != second
        with raises_error(NotConnectedError, code="network/port-in-use"):
            reserve_endpoint(first.endpoint, None, "worm")
    port = int(first.endpoint.rpartition(":")[2])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as next_program:
        next_program.bind(("127.0.0.1", port))  # raises an error if the port is still in use
