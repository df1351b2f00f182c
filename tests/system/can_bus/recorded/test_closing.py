"""The complete driver disables its modules when it is closed, publishes poses, and logs its bus."""

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.protocol.definitions import (
    FROM_HOST,
    CanFrame,
    CommandAction,
    LastStop,
    Opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Pose
from snakesim_testing.can.driver_loop import (
    DriverLoop,
    arm_and_wave,
    make_can_config,
    open_driver_loop,
)
from snakesim_testing.can.recording_bus import (
    DISARMED,
    WIRES,
    describe_host_frames,
    find_module,
    is_action,
)
from snakesim_testing.messages import raises_error

# --- closing -----------------------------------------------------------------------------------------------------


def test_closing_disarms_modules_and_may_be_repeated() -> None:
    with open_driver_loop() as run:
        run.arm()
        module = find_module(run, 3)
        (wire,) = WIRES
        run.backend.close()
        assert describe_host_frames(wire.sent)[-1] == "disarm"
        assert wire.close_count == 1
        assert module.state == DISARMED
        assert module.last_stop == LastStop.DISARM
        sent_count = len(wire.sent)
        run.backend.close()
        assert wire.close_count == 1
        for call in (lambda: run.backend.sample(99, 0), run.backend.advance):
            with raises_error(BackendError, code="backend/closed"):
                call()
        run.backend.enact(run.hold_angles(run.samples[-1]), "armed")
        assert run.backend.faults() == []
        assert len(wire.sent) == sent_count


@contextlib.contextmanager
def open_loop_with_mocap() -> Iterator[tuple[DriverLoop, str]]:
    """Open a driver that receives poses. Yields its loop, and the address of the socket for poses."""
    with open_driver_loop(
        make_can_config(robot__sensors__pose__rate_hz=100.0), pose_listen="127.0.0.1:0"
    ) as run:
        mocap = run.backend._mocap
        assert mocap is not None
        yield run, mocap.address


def check_port_is_free(address: str) -> None:
    """Open a socket at an address, as the next program would; this raises an error if the port is still in use."""
    host, _, port = address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as next_program:
        next_program.bind((host, int(port)))


def test_closing_with_broken_bus_closes_everything_else(monkeypatch: pytest.MonkeyPatch) -> None:
    with open_loop_with_mocap() as (run, mocap_address):

        def raise_send_error(_frame: CanFrame) -> bool:
            raise BackendError("the bus is broken")

        def raise_shutdown_error() -> None:
            raise can.CanOperationError("the bus is gone")

        WIRES[0].should_refuse = raise_send_error
        with monkeypatch.context() as patched:
            patched.setattr(WIRES[0]._bus, "shutdown", raise_shutdown_error)
            run.backend.close()
        assert WIRES[0].close_count == 1
        check_port_is_free(mocap_address)


def test_closing_error_of_drives_is_raised_after_mocap_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with open_loop_with_mocap() as (run, mocap_address):
        close_drives = run.backend._drives.close

        def close_and_raise() -> None:
            close_drives()
            raise BackendError("a drive was not switched off")

        monkeypatch.setattr(run.backend._drives, "close", close_and_raise)
        with pytest.raises(BackendError, match="a drive was not switched off"):
            run.backend.close()
        check_port_is_free(mocap_address)


def test_check_requires_delay_of_the_pose_in_robot_file() -> None:
    with raises_error(ConfigError, code="config/missing-key"):
        CanBackend.check(make_can_config(), CanSettings(pose_listen="127.0.0.1:0"))
    CanBackend.check(
        make_can_config(robot__sensors__pose__delay_s=0.02), CanSettings(pose_listen="127.0.0.1:0")
    )


@pytest.mark.parametrize("delay_s", [0.0, 0.03])
def test_closing_pose_of_emulators_has_age_of_robot_file(delay_s: float) -> None:
    """In lockstep the age is exact, and the description contains it."""
    with open_driver_loop(
        make_can_config(robot__sensors__pose__delay_s=delay_s), physics_model="mujoco"
    ) as run:
        sensors = run.backend.describe().sensors
        (pose_sensor,) = [sensor for sensor in sensors if sensor.key == keys.POSE]
        assert pose_sensor.delay_s == delay_s
        run.run(20)
        ages_ns = [
            samples.joints.timestamp_ns - pose.timestamp_ns
            for samples in run.samples
            if isinstance(pose := samples.by_key.get(keys.POSE), Pose)
        ]
        assert set(ages_ns) == {round(delay_s * 1e9)}
        assert len(ages_ns) == 20 - round(delay_s / 0.01)


def test_closing_reports_errors_even_when_stop_cannot_be_sent() -> None:
    """The error of the bus does not hide the fault that caused the stop."""
    with open_driver_loop() as run:
        arm_and_wave(run)
        find_module(run, 2).health.leak = True
        wire = WIRES[0]

        def raise_error_for_stop(frame: CanFrame) -> bool:
            if is_action(frame, CommandAction.STOP):
                raise BackendError("the bus is broken")
            return False

        wire.should_refuse = raise_error_for_stop
        # The next tick sends the stop again and fails.
        with raises_error(BackendError, code="backend/failed"):
            run.run(3, run.wave_joints)
        causes = {fault.what: fault.cause for fault in run.faults}
        assert "leak" in causes["module_leak"]
        assert causes["stop_not_sent"] == "the bus is broken"


def test_closing_leaves_log_of_all_frames_of_the_bus(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    with open_driver_loop(log=str(path)) as run:
        backend = run.backend
        for tick in range(30):
            samples = backend.sample(tick, tick * 10**7)
            backend.enact(run.hold_angles(samples), "armed")
            backend.advance()
        assert backend.faults() == []
    lines = [line.split() for line in path.read_text().splitlines()]
    assert [line[2] for line in lines] == [
        f"{frame.id:03X}#{frame.data.hex().upper()}" for frame in WIRES[0].all_frames
    ]
    assert {line[1] for line in lines} == {WIRES[0].channel}
    opcodes = {int(line[2][:3], 16) >> 6 for line in lines}
    assert opcodes > {*FROM_HOST} - {Opcode.EMERGENCY}
    assert Opcode.JOINT_STATE in opcodes
    host_frames = [line[2] for line in lines if int(line[2][:3], 16) >> 6 in FROM_HOST]
    assert host_frames[-1].startswith("040#02"), "the last command is not disarm"
