"""The whole driver: how it ends, its poses and its log."""

import socket
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
from snakesim_testing.can.driver_loop import arm_and_wave, make_can_config, open_driver_loop
from snakesim_testing.can.recording_bus import (
    DISARMED,
    WIRES,
    describe_host_frames,
    find_module,
    is_action,
)
from snakesim_testing.messages import raises_error

# --- closing -----------------------------------------------------------------------------------------------


def test_closing_disarms_and_twice_is_harmless() -> None:
    with open_driver_loop() as run:
        run.arm()
        module = find_module(run, 3)
        (wire,) = WIRES
        run.backend.close()
        assert describe_host_frames(wire.sent)[-1] == "disarm"
        assert wire.close_count == 1
        assert module.state == DISARMED and module.last_stop == LastStop.DISARM, (
            "and they have heard it"
        )
        sent = len(wire.sent)
        run.backend.close()
        assert wire.close_count == 1
        for call in (lambda: run.backend.sample(99, 0), run.backend.advance):
            with raises_error(BackendError, code="backend/closed"):
                call()
        run.backend.enact(run.hold_angles(run.samples[-1]), "armed")
        assert run.backend.faults() == []
        assert len(wire.sent) == sent


def test_closing_goes_on_when_a_bus_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    with open_driver_loop(
        make_can_config(robot__sensors__pose__rate_hz=100.0), pose_listen="127.0.0.1:0"
    ) as run:
        mocap = run.backend._mocap
        assert mocap is not None
        host, _, port = mocap.address.rpartition(":")

        def broken(_frame: CanFrame) -> bool:
            raise BackendError("the bus is broken")

        def gone() -> None:
            raise can.CanOperationError("the bus is gone")

        WIRES[0].should_refuse = broken
        with monkeypatch.context() as patched:
            patched.setattr(WIRES[0]._bus, "shutdown", gone)
            run.backend.close()
        assert WIRES[0].close_count == 1
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind((host, int(port)))


def test_poses_need_a_delay_that_somebody_has_stated() -> None:
    with raises_error(ConfigError, code="config/missing-key"):
        CanBackend.check(make_can_config(), CanSettings(pose_listen="127.0.0.1:0"))
    CanBackend.check(
        make_can_config(robot__sensors__pose__delay_s=0.02), CanSettings(pose_listen="127.0.0.1:0")
    )


@pytest.mark.parametrize("delay_s", [0.0, 0.03])
def test_closing_pose_of_emulators_has_age_of_robot_file(delay_s: float) -> None:
    """To the bit, in lockstep; and the description says so."""
    with open_driver_loop(
        make_can_config(robot__sensors__pose__delay_s=delay_s), physics_model="mujoco"
    ) as run:
        (sensor,) = [s for s in run.backend.describe().sensors if s.key == keys.POSE]
        assert sensor.delay_s == delay_s
        run.run(20)
        late = [
            (s.joints.timestamp_ns, pose.timestamp_ns)
            for s in run.samples
            if isinstance(pose := s.by_key.get(keys.POSE), Pose)
        ]
        assert {now_ns - captured_ns for now_ns, captured_ns in late} == {round(delay_s * 1e9)}
        assert len(late) == 20 - round(delay_s / 0.01)


def test_closing_reports_errors_even_when_stop_cannot_be_sent() -> None:
    """The cause is not lost to the error of the bus."""
    with open_driver_loop() as run:
        arm_and_wave(run)
        find_module(run, 2).health.leak = True
        wire = WIRES[0]

        def breaks(frame: CanFrame) -> bool:
            if is_action(frame, CommandAction.STOP):
                raise BackendError("the bus is broken")
            return False

        wire.should_refuse = breaks
        with raises_error(
            BackendError, code="backend/failed"
        ):  # by the next tick, which tries again
            run.run(3, run.wave_joints)
        reported = {fault.what: fault.cause for fault in run.faults}
        assert "leak" in reported["module_leak"]
        assert reported["stop_not_sent"] == "the bus is broken"


def test_the_log_holds_everything_that_went_over_the_bus(tmp_path: Path) -> None:
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
        f"{f.id:03X}#{f.data.hex().upper()}" for f in WIRES[0].all_frames
    ]
    assert {line[1] for line in lines} == {WIRES[0].channel}
    opcodes = {int(line[2][:3], 16) >> 6 for line in lines}
    assert opcodes > {*FROM_HOST} - {Opcode.EMERGENCY}
    assert Opcode.JOINT_STATE in opcodes
    last = [line[2] for line in lines if int(line[2][:3], 16) >> 6 in FROM_HOST][-1]
    assert last.startswith("040#02"), "which is disarm"
