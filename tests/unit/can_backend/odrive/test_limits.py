"""The ODrive driver reads the limits of axes at the start, compares them with the robot, and never raises them."""

import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from snakesim_can_backend.can_drives.drives import CanDrives, CanDrivesContext
from snakesim_can_backend.odrive.backend import OdriveBackend
from snakesim_can_backend.odrive.endpoints import EMULATED, AxisSetting, read_endpoints
from snakesim_can_backend.odrive.protocol import (
    MessageId,
    decode_setting_answer,
    encode_setting_request,
    split_id,
)
from snakesim_can_backend.odrive.settings import MountedAxis, OdriveSettings
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.scenario import RunConfig
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

JOINTS = 3
TORQUE_NM = 7.0
TORQUE_CONSTANT_NM_PER_A = 0.03
NEEDED_A = TORQUE_NM / TORQUE_CONSTANT_NM_PER_A  # 233 A
REAL_CHANNELS = ["slcan:/dev/none"]  # such a bus may have real axes


class AxisRobot(DriveRig):
    """A robot with emulated axes. It records every frame that its driver sends after the start."""

    def __init__(self, **settings: Any) -> None:
        config = self.make_configuration()
        fixed: dict[str, Any] = {"physics_model": "inertia", "bring_up_limit_s": 3.0}
        super().__init__(config, OdriveBackend(config, OdriveSettings(**fixed | settings)))
        self.sent: list[CanFrame] = []
        send = self.drives.wire.send
        self.drives.wire.send = lambda frame: self.sent.append(frame) or send(frame)

    @staticmethod
    def make_configuration() -> RunConfig:
        return make_run_config(
            backend="odrive",
            rate_hz=100,
            robot__chain__modules=JOINTS,
            robot__limits__torque_nm=TORQUE_NM,
            robot__motor__torque_constant_nm_per_a=TORQUE_CONSTANT_NM_PER_A,
        )

    @property
    def drives(self) -> Any:
        return drives_of(self.backend)

    def list_current_limits_a(self, joint: int) -> list[float]:
        """Return the current limits in A that the driver has sent to an axis."""
        limits = [
            frame for frame in self.sent if split_id(frame) == (joint + 1, MessageId.SET_LIMITS)
        ]
        return [struct.unpack("<ff", frame.data)[1] for frame in limits]


@pytest.fixture
def robot() -> Iterator[AxisRobot]:
    opened = AxisRobot()
    yield opened
    opened.backend.close()


def write_endpoints_file(path: Path, **changed: Any) -> str:
    """Write an endpoints file in the format of ODrive, with ids that differ from the emulated ones."""
    types = {AxisSetting.WATCHDOG_ENABLED: "bool"}
    endpoints: dict[str, Any] = {
        setting: {"id": 300 + i, "type": types.get(setting, "float")}
        for i, setting in enumerate(AxisSetting)
    }
    content = {
        "fw_version": "0.6.11-1",
        "hw_version": "4.4.58",
        "endpoints": endpoints | {"reboot": {"type": "function"}},
    }
    path.write_text(json.dumps(content | changed), encoding="utf-8")
    return str(path)


# --- current -------------------------------------------------------------------------------------------------


def test_odrive_arming_never_raises_configured_current_limit(robot: AxisRobot) -> None:
    axis = robot.drives._emulator.axes[1]
    assert axis.current_soft_max_a == pytest.approx(NEEDED_A)
    robot.run(5, "disarmed")
    robot.run(30, "armed")
    assert robot.list_current_limits_a(1) and max(robot.list_current_limits_a(1)) == pytest.approx(
        1.0 / TORQUE_CONSTANT_NM_PER_A
    ), "the current of 1 N·m, the torque limit of the setpoint"
    # Another program changes the configuration, and the next start reads it.
    axis.current_soft_max_a = 10.0
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        robot.backend._drives.bring_up()


@pytest.mark.parametrize("configured_a", [10.0, 0.5 * NEEDED_A])
def test_odrive_joint_torque_above_configured_current_is_refused(configured_a: float) -> None:
    with raises_error(BackendError, code="drive/not-complete"):
        AxisRobot(mounted={"joint_2": MountedAxis(current_soft_max_a=configured_a)})


def test_odrive_lowered_limit_is_restored_when_idle_or_named(
    robot: AxisRobot,
) -> None:
    """Restore a lowered limit, because the next start reads it and cannot know its origin."""
    robot.run(5, "disarmed")
    robot.run(30, "armed")
    axes = robot.drives._emulator.axes
    assert axes[0].current_soft_max_a == pytest.approx(1.0 / TORQUE_CONSTANT_NM_PER_A)
    robot.run(30, "disarmed")
    assert axes[0].current_soft_max_a == pytest.approx(NEEDED_A)
    robot.run(30, "armed")
    # The driver sends nothing, and the watchdogs stop the axes.
    robot.backend._clock.robot_time_ns += 190_000_000
    with raises_error(BackendError, code="drive/not-complete", field="joint_1"):
        robot.backend._drives.bring_up()
    for i in range(JOINTS):
        robot.drives._emulator.restart(i)
    robot.backend._drives.bring_up()


def test_odrive_joint_torque_above_driver_limit_is_refused_before_start() -> None:
    """Limit real axes without an endpoints file to 1 A, which every motor withstands."""
    config = AxisRobot.make_configuration()
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        OdriveBackend.check(config, OdriveSettings(channels=REAL_CHANNELS))
    with raises_error(
        ConfigError, code="drive/unsupported-setting", field="backends.odrive.max_current_a"
    ):
        OdriveBackend.check(config, OdriveSettings(max_current_a=200.0))
    OdriveBackend.check(config, OdriveSettings(channels=REAL_CHANNELS, max_current_a=240.0))


@pytest.mark.parametrize(("max_current_a", "max_a"), [(None, 1.0), (200.0, 200.0)])
def test_odrive_unread_axis_is_capped_and_logged_as_unknown(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    max_current_a: float | None,
    max_a: float,
) -> None:
    create_drives = CanDrives.__init__

    def create_real_drives(drives: Any, context: CanDrivesContext) -> None:
        create_drives(drives, replace(context, emulated=False))

    monkeypatch.setattr(CanDrives, "__init__", create_real_drives)
    monkeypatch.setattr(OdriveBackend, "validate_current_limit", lambda *_: None)
    robot = AxisRobot(max_current_a=max_current_a)
    robot.limit_nm = TORQUE_NM
    robot.run(20, "armed")
    robot.backend.close()
    assert max(robot.list_current_limits_a(0)) == pytest.approx(max_a)
    assert (
        f"limits of these axes are unknown: the driver sets no more than {max_a:g} A" in caplog.text
    )


# --- watchdog and speed --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mounted_axis",
    [
        MountedAxis(watchdog_timeout_s=0.0),
        MountedAxis(watchdog_timeout_s=1.0),
        MountedAxis(vel_limit_turns_s=0.5),
    ],
    ids=["no watchdog", "another watchdog", "slower"],
)
def test_odrive_unsuitable_watchdog_or_speed_of_an_axis_is_refused(
    mounted_axis: MountedAxis,
) -> None:
    with raises_error(BackendError, code="drive/not-complete", field="joint_3"):
        AxisRobot(mounted={"joint_3": mounted_axis})


# --- endpoints -----------------------------------------------------------------------------------------------


def test_odrive_endpoint_ids_come_from_the_endpoints_file(tmp_path: Path) -> None:
    path = write_endpoints_file(tmp_path / "flat_endpoints.json")
    assert read_endpoints(path).ids[AxisSetting.CURRENT] != EMULATED.ids[AxisSetting.CURRENT]
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        AxisRobot(endpoints=[path], mounted={"joint_2": MountedAxis(current_soft_max_a=10.0)})
    AxisRobot(endpoints=[path]).backend.close()


def test_odrive_endpoints_file_of_another_firmware_is_refused(tmp_path: Path) -> None:
    path = write_endpoints_file(tmp_path / "flat_endpoints.json", fw_version="0.6.10")
    with raises_error(BackendError, code="drive/not-complete"):
        AxisRobot(endpoints=[path])


@pytest.mark.parametrize(
    "changed",
    [
        {"endpoints": {}},
        {"endpoints": {setting: {"id": 1, "type": "uint8"} for setting in AxisSetting}},
        {"endpoints": []},
        {"fw_version": 6},
    ],
)
def test_odrive_file_of_another_kind_is_refused_before_start(
    tmp_path: Path, changed: dict[str, Any]
) -> None:
    path = write_endpoints_file(tmp_path / "flat_endpoints.json", **changed)
    with raises_error(ConfigError, code="file/not-readable"):
        OdriveBackend.check(make_run_config(backend="odrive"), OdriveSettings(endpoints=[path]))
    with raises_error(ConfigError, code="file/not-readable", field="backends.odrive.endpoints"):
        OdriveBackend.check(
            make_run_config(backend="odrive"),
            OdriveSettings(endpoints=[str(tmp_path / "nothing.json")]),
        )


def test_odrive_axis_without_readable_configuration_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "snakesim_can_backend.odrive.emulator.EmulatedOdrive._answer_setting", lambda *_: None
    )
    with raises_error(BackendError, code="drive/not-complete", field="joint_1"):
        AxisRobot(bring_up_limit_s=0.3)


def test_odrive_setting_request_and_answer_equal_published_example() -> None:
    """Check opcode, endpoint, a reserved byte and the value, packed as `<BHB`.

    Source: `can_param_access.py` of ODriveResources.
    """
    assert encode_setting_request(3, 271) == CanFrame(3 << 5 | 0x04, struct.pack("<BHB", 0, 271, 0))
    assert decode_setting_answer(struct.pack("<BHBf", 0, 271, 0, 12.5)) == (
        271,
        struct.pack("<f", 12.5),
    )
    with pytest.raises(struct.error):
        decode_setting_answer(b"\0\1")
