"""The CiA 402 driver reacts to faults, restarts and stops, and refuses unsafe drives at the start."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from snakesim_can_backend.bus.bus import VirtualWire, make_virtual_channel
from snakesim_can_backend.cia402.backend import Cia402Backend
from snakesim_can_backend.cia402.eds import BUNDLED
from snakesim_can_backend.cia402.frames import (
    EmergencyMessage,
    FunctionCode,
    NmtCommand,
    NmtState,
    encode_emergency,
)
from snakesim_can_backend.cia402.objects import MODE_PDO, POSITION_PDO, TORQUE_PDO
from snakesim_can_backend.cia402.scan import make_scan_row, read_nodes
from snakesim_can_backend.cia402.settings import MountedCia402
from snakesim_can_backend.cia402.state_machine import ControlwordCommand, PowerState
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.messages import raises_error

JOINTS = 2
EDS_HEARTBEAT_TIME = (
    "ParameterName=Producer heartbeat time\nObjectType=0x7\nDataType=0x0006\nAccessType="
)
CONFIG = make_can_config(JOINTS, backend="cia402")


class DriveRobot(DriveRig):
    """A robot with emulated drives. It records every frame that its driver sends after the start."""

    def __init__(self, **settings: Any) -> None:
        fixed: dict[str, Any] = {"physics_model": "inertia", "bring_up_limit_s": 2.0}
        super().__init__(CONFIG, Cia402Backend(CONFIG, Cia402Backend.Settings(**fixed | settings)))
        self.sent: list[CanFrame] = []
        send = self.driver.wire.send
        self.driver.wire.send = lambda frame: self.sent.append(frame) or send(frame)

    @property
    def driver(self) -> Any:
        return drives_of(self.backend)

    @property
    def drives(self) -> Any:
        return self.driver._emulator.drives

    def list_controlwords(self, joint: int) -> list[int]:
        """Return the controlwords that the driver has sent to a drive in PDOs."""
        ids = [pdo.base | joint + 1 for pdo in (POSITION_PDO, TORQUE_PDO)]
        return [int.from_bytes(frame.data[:2], "little") for frame in self.sent if frame.id in ids]


@pytest.fixture
def robot() -> Iterator[DriveRobot]:
    opened = DriveRobot()
    yield opened
    opened.backend.close()


def test_drive_is_enabled_step_by_step_in_its_mode(robot: DriveRobot) -> None:
    assert robot.run(5, "disarmed") == []
    assert robot.sent and FunctionCode.HEARTBEAT | 127 not in {frame.id for frame in robot.sent}
    robot.sent.clear()
    assert robot.run(10, "armed") == []
    controlwords = robot.list_controlwords(0)
    assert controlwords[:4] == [
        ControlwordCommand.DISABLE_VOLTAGE,
        ControlwordCommand.SHUTDOWN,
        ControlwordCommand.SWITCH_ON,
        ControlwordCommand.ENABLE_OPERATION,
    ]
    assert set(controlwords[4:]) == {ControlwordCommand.ENABLE_OPERATION}
    heartbeats = [frame for frame in robot.sent if frame.id == FunctionCode.HEARTBEAT | 127]
    assert len(heartbeats) == 10
    assert heartbeats[0].data == bytes([NmtState.OPERATIONAL])
    assert sum(frame.id == 0x080 for frame in robot.sent) == 10, "one SYNC a tick"
    robot.sent.clear()
    robot.mode = JointMode.TORQUE
    robot.target = 0.0
    assert robot.run(10, "armed") == []
    assert [frame.data for frame in robot.sent if frame.id == MODE_PDO.base | 1][:1] == [
        bytes([10])
    ]
    assert [drive.state for drive in robot.drives] == [PowerState.ENABLED] * JOINTS


def test_drive_that_leaves_operation_enabled_by_itself_stays_off(robot: DriveRobot) -> None:
    robot.run(40, "armed")
    # A drive does this by itself if its safe torque off was requested.
    robot.drives[0].state = PowerState.SWITCH_ON_DISABLED
    robot.sent.clear()
    [fault] = robot.run(30, "armed")
    assert (fault.what, fault.joint) == ("drive_not_armed", "joint_1")
    assert "switch on disabled" in fault.cause
    assert set(robot.list_controlwords(0)) == {ControlwordCommand.DISABLE_VOLTAGE}
    assert robot.drives[0].state == PowerState.SWITCH_ON_DISABLED


def test_drive_that_leaves_operation_enabled_at_once_stays_off(robot: DriveRobot) -> None:
    robot.run(5, "armed")
    assert robot.drives[0].state == PowerState.ENABLED
    robot.drives[0].state = PowerState.SWITCH_ON_DISABLED
    robot.sent.clear()
    faults = robot.run(70, "armed")
    assert [(fault.what, fault.joint) for fault in faults] == [("drive_not_armed", "joint_1")]
    assert ControlwordCommand.SHUTDOWN not in robot.list_controlwords(0)


def test_fault_is_reset_by_the_operator_alone(
    robot: DriveRobot, caplog: pytest.LogCaptureFixture
) -> None:
    robot.run(20, "armed")
    robot.driver._emulator._fail(0, EmergencyMessage(0x3210, 0x05))
    with caplog.at_level(logging.WARNING):
        faults = robot.run(20, "armed")
    assert [fault.what for fault in faults] == ["drive_fault"]
    assert (
        "error 0x3210, voltage: see its manual (error register 0x05: generic, voltage)"
        in faults[0].cause
    )
    assert "0x3210" in caplog.text
    robot.run(20, "fault")
    assert robot.drives[0].state == PowerState.FAULT
    assert not any(
        controlword & ControlwordCommand.FAULT_RESET for controlword in robot.list_controlwords(0)
    )
    assert robot.run(10, "disarmed") == []
    assert robot.drives[0].state == PowerState.SWITCH_ON_DISABLED
    assert robot.run(20, "armed") == []
    assert robot.drives[0].state == PowerState.ENABLED


def test_emergency_stop_is_a_quick_stop_that_ends_in_time() -> None:
    robot = DriveRobot(quick_stop="ramp")
    robot.run(30, "armed")
    # The drive stays in quick stop, whatever the driver has configured.
    robot.drives[0].objects.values[0x605A, 0] = 6
    robot.sent.clear()
    robot.run(3, "estop")
    assert robot.list_controlwords(0)[0] == ControlwordCommand.QUICK_STOP
    assert robot.drives[0].state == PowerState.QUICK_STOP
    robot.run(20, "estop")
    assert [drive.state for drive in robot.drives] == [PowerState.SWITCH_ON_DISABLED] * JOINTS
    robot.backend.close()


def test_drive_in_pre_operational_is_configured_again_and_stays_off(robot: DriveRobot) -> None:
    robot.run(40, "armed")
    robot.drives[0].objects.nmt_state = NmtState.PRE_OPERATIONAL
    faults = robot.run(60, "armed")
    assert {fault.joint for fault in faults} == {"joint_1"}
    assert robot.drives[0].objects.nmt_state == NmtState.OPERATIONAL
    assert robot.drives[0].state != PowerState.ENABLED
    robot.run(10, "disarmed")
    assert robot.run(40, "armed") == []


def test_drive_without_heartbeats_is_reported_although_it_answers_sync(robot: DriveRobot) -> None:
    robot.run(10, "armed")
    robot.drives[1].objects.values[0x1017, 0] = 0
    [fault] = robot.run(80, "armed")
    assert (fault.what, fault.joint) == ("drive_silent", "joint_2")
    assert "answers SYNC, but has sent no heartbeat for" in fault.cause


def test_torque_limit_is_restored_when_idle_and_never_raised(robot: DriveRobot) -> None:
    configured = robot.drives[0].objects.get((0x6072, 0))
    robot.limit_nm = 0.5
    robot.run(10, "armed")
    assert robot.drives[0].objects.get((0x6072, 0)) == configured // 8
    robot.limit_nm = 100.0
    robot.run(10, "armed")
    assert robot.drives[0].objects.get((0x6072, 0)) == configured
    robot.limit_nm = 0.5
    robot.run(10, "armed")
    robot.run(5, "disarmed")
    assert robot.drives[0].objects.get((0x6072, 0)) == configured


def test_drives_stop_watching_the_heartbeat_after_driver_closes() -> None:
    robot = DriveRobot()
    robot.run(10, "armed")
    emulator = robot.driver._emulator
    robot.backend.close()
    emulator._handle_received_frames = lambda: None
    assert robot.sent[-1].data[1:4] == b"\x16\x10\x01"


@pytest.mark.parametrize(
    ("mounted_drive", "field"),
    [
        ({"max_torque_nm": 1.0}, "6072h"),
        ({"max_speed_rad_s": 1.0}, "6080h"),
        ({"max_position": 1000}, "607Dh"),
    ],
)
def test_drive_with_unfitting_limits_is_refused_at_the_start(
    mounted_drive: dict[str, Any], field: str
) -> None:
    with raises_error(BackendError, code="drive/not-complete", field=field):
        DriveRobot(mounted={"joint_2": MountedCia402(**mounted_drive)})


@pytest.mark.parametrize(
    ("old", "new", "settings"),
    [
        ("[6007]\n", "[2007]\n", {}),
        ("[1A00sub2]\n", "[1A00sub9]\n", {}),
        (EDS_HEARTBEAT_TIME + "rw", EDS_HEARTBEAT_TIME + "ro", {}),
    ],
    ids=["no abort connection option", "short mapping", "heartbeat not writable"],
)
def test_drive_that_cannot_be_configured_is_refused_at_the_start(
    tmp_path: Path, old: str, new: str, settings: dict[str, Any]
) -> None:
    path = tmp_path / "drive.eds"
    text = BUNDLED.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with raises_error(BackendError, code="drive/not-complete", field="joint_1"):
        DriveRobot(eds=[str(path)], **settings)


def test_watchdog_that_cannot_be_verified_may_be_allowed(tmp_path: Path) -> None:
    path = tmp_path / "drive.eds"
    path.write_text(
        BUNDLED.read_text(encoding="utf-8").replace("[6007]\n", "[2007]\n", 1), encoding="utf-8"
    )
    robot = DriveRobot(eds=[str(path)], allow_unverified_watchdog=True)
    assert robot.run(20, "armed") == []
    robot.backend.close()


def test_host_id_equal_to_a_joint_id_is_refused() -> None:
    with raises_error(ConfigError, code="drive/unsupported-setting", field="joint_2"):
        Cia402Backend.check(CONFIG, Cia402Backend.Settings(host_id=2))


def test_sender_of_master_or_unknown_node_frames_is_found(robot: DriveRobot) -> None:
    find_sender = robot.driver.find_sender
    assert find_sender(CanFrame(0x000, bytes([NmtCommand.START, 0]))) == -1
    assert find_sender(CanFrame(0x080, b"")) == -1
    assert find_sender(CanFrame(0x201, bytes(8))) == -1
    assert find_sender(CanFrame(0x601, bytes([0x2B, 0x40, 0x60, 0, 6, 0, 0, 0]))) == -1
    assert find_sender(CanFrame(0x77F, b"\x05")) == -1
    assert find_sender(CanFrame(0x601, bytes([0x40, 0x41, 0x60, 0, 0, 0, 0, 0]))) is None, (
        "it only reads"
    )
    assert find_sender(CanFrame(0x100, bytes(6))) is None
    assert find_sender(CanFrame(0x7E5, bytes(8))) is None
    assert find_sender(encode_emergency(9, EmergencyMessage(0x1000, 1))) == 9
    assert find_sender(CanFrame(0x789 & 0x7FF, b"")) is None
    assert find_sender(CanFrame(0x709, b"\x7f")) == 9


def test_scan_lists_identity_modes_and_state_of_every_node() -> None:
    channel = make_virtual_channel()
    settings = Cia402Backend.Settings(physics_model="inertia")
    clock = DriverClock(CONFIG)
    emulator: Any = Cia402Backend.make_emulator(
        CONFIG, settings, [VirtualWire(channel)], clock, None
    )
    wire = VirtualWire(channel, emulator)
    nodes = read_nodes(wire)
    wire.close()
    assert list(nodes) == [1, 2]
    assert make_scan_row("can0", 2, nodes[2]) == {
        "channel": "can0",
        "node": "2",
        "profile": "402",
        "vendor": "00000000",
        "product": "00000402",
        "revision": "1.0",
        "serial": "40200002",
        "modes": "CSP CSV CST",
        "state": "switch on disabled",
        "error": "none",
    }
