"""What axes are configured for: read at the start by RxSdo and TxSdo, held against the robot file, never raised."""

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
TORQUE_NM, CONSTANT = 7.0, 0.03
NEEDED_A = TORQUE_NM / CONSTANT  # 233 A
REAL = ["slcan:/dev/none"]  # a bus that may have real axes


class Robot(DriveRig):
    """A robot on emulated axes, and every frame that its driver sends after the start."""

    def __init__(self, **settings: Any) -> None:
        config = self.configuration()
        fixed: dict[str, Any] = {"physics_model": "inertia", "bring_up_limit_s": 3.0}
        super().__init__(config, OdriveBackend(config, OdriveSettings(**fixed | settings)))
        self.sent: list[CanFrame] = []
        send = self.drives.wire.send
        self.drives.wire.send = lambda frame: self.sent.append(frame) or send(frame)

    @staticmethod
    def configuration() -> RunConfig:
        return make_run_config(
            backend="odrive",
            rate_hz=100,
            robot__chain__modules=JOINTS,
            robot__limits__torque_nm=TORQUE_NM,
            robot__motor__torque_constant_nm_per_a=CONSTANT,
        )

    @property
    def drives(self) -> Any:
        return drives_of(self.backend)

    def currents_a(self, joint: int) -> list[float]:
        """Current limits that the driver has sent to an axis."""
        limits = [
            frame for frame in self.sent if split_id(frame) == (joint + 1, MessageId.SET_LIMITS)
        ]
        return [struct.unpack("<ff", frame.data)[1] for frame in limits]


@pytest.fixture
def robot() -> Iterator[Robot]:
    one = Robot()
    yield one
    one.backend.close()


def endpoints_file(path: Path, **changed: Any) -> str:
    """A file as ODrive publishes one, of the emulated axes' firmware, with ids of its own."""
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


def test_odrive_arming_never_raises_configured_current_limit(robot: Robot) -> None:
    axis = robot.drives._emulator.axes[1]
    assert axis.current_soft_max_a == pytest.approx(NEEDED_A)
    robot.run(5, "disarmed")
    robot.run(30, "armed")
    assert robot.currents_a(1) and max(robot.currents_a(1)) == pytest.approx(1.0 / CONSTANT), (
        "the setpoint's 1 N·m"
    )
    # Configured anew, behind the driver's back: the next start reads it.
    axis.current_soft_max_a = 10.0
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        robot.backend._drives.bring_up()


@pytest.mark.parametrize("configured_a", [10.0, 0.5 * NEEDED_A])
def test_odrive_joint_torque_above_configured_current_is_refused(configured_a: float) -> None:
    with raises_error(BackendError, code="drive/not-complete"):
        Robot(mounted={"joint_2": MountedAxis(current_soft_max_a=configured_a)})


def test_odrive_lowered_limit_is_restored_when_idle_or_named(
    robot: Robot,
) -> None:
    """The next start reads it, and cannot know who has set it."""
    robot.run(5, "disarmed")
    robot.run(30, "armed")
    axes = robot.drives._emulator.axes
    assert axes[0].current_soft_max_a == pytest.approx(1.0 / CONSTANT)
    robot.run(30, "disarmed")
    assert axes[0].current_soft_max_a == pytest.approx(NEEDED_A)
    robot.run(30, "armed")
    # The driver is gone, and the watchdogs stop the axes.
    robot.backend._clock.robot_time_ns += 190_000_000
    with raises_error(BackendError, code="drive/not-complete", field="joint_1"):
        robot.backend._drives.bring_up()
    for i in range(JOINTS):
        robot.drives._emulator.restart(i)
    robot.backend._drives.bring_up()


def test_odrive_joint_torque_above_driver_limit_is_refused_before_start() -> None:
    """Of real axes without a file of endpoints that is 1 A: whatever the motor is, it stands it."""
    config = Robot.configuration()
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        OdriveBackend.check(config, OdriveSettings(channels=REAL))
    with raises_error(
        ConfigError, code="drive/unsupported-setting", field="backends.odrive.max_current_a"
    ):
        OdriveBackend.check(config, OdriveSettings(max_current_a=200.0))
    OdriveBackend.check(config, OdriveSettings(channels=REAL, max_current_a=240.0))


@pytest.mark.parametrize(("max_current_a", "max_a"), [(None, 1.0), (200.0, 200.0)])
def test_odrive_unread_axis_is_capped_and_logged_as_unknown(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    max_current_a: float | None,
    max_a: float,
) -> None:
    made = CanDrives.__init__

    def as_if_real(drives: Any, context: CanDrivesContext) -> None:
        made(drives, replace(context, emulated=False))

    monkeypatch.setattr(CanDrives, "__init__", as_if_real)
    monkeypatch.setattr(OdriveBackend, "validate_current_limit", lambda *_: None)
    robot = Robot(max_current_a=max_current_a)
    robot.limit_nm = TORQUE_NM
    robot.run(20, "armed")
    robot.backend.close()
    assert max(robot.currents_a(0)) == pytest.approx(max_a)
    assert (
        f"limits of these axes are unknown: the driver sets no more than {max_a:g} A" in caplog.text
    )


# --- watchdog and speed --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mounted",
    [
        MountedAxis(watchdog_timeout_s=0.0),
        MountedAxis(watchdog_timeout_s=1.0),
        MountedAxis(vel_limit_turns_s=0.5),
    ],
    ids=["no watchdog", "another watchdog", "slower"],
)
def test_odrive_unsuitable_watchdog_or_speed_of_an_axis_is_refused(mounted: MountedAxis) -> None:
    with raises_error(BackendError, code="drive/not-complete", field="joint_3"):
        Robot(mounted={"joint_3": mounted})


# --- endpoints -----------------------------------------------------------------------------------------------


def test_ids_come_from_the_file_of_the_firmware(tmp_path: Path) -> None:
    path = endpoints_file(tmp_path / "flat_endpoints.json")
    assert read_endpoints(path).ids[AxisSetting.CURRENT] != EMULATED.ids[AxisSetting.CURRENT]
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        Robot(endpoints=[path], mounted={"joint_2": MountedAxis(current_soft_max_a=10.0)})
    Robot(endpoints=[path]).backend.close()


def test_a_file_of_another_firmware_is_refused(tmp_path: Path) -> None:
    path = endpoints_file(tmp_path / "flat_endpoints.json", fw_version="0.6.10")
    with raises_error(BackendError, code="drive/not-complete"):
        Robot(endpoints=[path])


@pytest.mark.parametrize(
    "changed",
    [
        {"endpoints": {}},
        {"endpoints": {s: {"id": 1, "type": "uint8"} for s in AxisSetting}},
        {"endpoints": []},
        {"fw_version": 6},
    ],
)
def test_odrive_file_of_another_kind_is_refused_before_start(
    tmp_path: Path, changed: dict[str, Any]
) -> None:
    path = endpoints_file(tmp_path / "flat_endpoints.json", **changed)
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
        Robot(bring_up_limit_s=0.3)


def test_questions_and_answers_are_those_of_odrives_examples() -> None:
    """Their form is `<BHB` and the value: opcode, endpoint, reserved; `can_param_access.py` of ODriveResources."""
    assert encode_setting_request(3, 271) == CanFrame(3 << 5 | 0x04, struct.pack("<BHB", 0, 271, 0))
    assert decode_setting_answer(struct.pack("<BHBf", 0, 271, 0, 12.5)) == (
        271,
        struct.pack("<f", 12.5),
    )
    with pytest.raises(struct.error):
        decode_setting_answer(b"\0\1")
