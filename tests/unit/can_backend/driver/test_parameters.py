"""Parameters of joint modules follow the robot file, within the ranges of the protocol and the ratings."""

from typing import Any

import msgspec
import pytest

from snakesim_can_backend.bus.load import ReportSchedule
from snakesim_can_backend.driver.parameters import (
    SPEED_RANGE_FACTOR,
    plan_parameters,
    validate_joint_drives,
    validate_ratings,
)
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    PARAMETERS,
    ModuleParameter,
    Opcode,
    SafeMotion,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.mounted import MountedDrive, validate_mounting_overrides
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.files import decode_table, list_shipped_names, read_table_with_base
from snakesim_hal.model.robot_file.joints import JointExceptions
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import load_scenario
from snakesim_testing.messages import raises_error

ROBOT = load_scenario("triplet").config.robot
RATINGS = (ModuleParameter.RATED_TORQUE, ModuleParameter.RATED_SPEED)


def change_robot(section: str, **values: Any) -> RobotFile:
    """Return the robot with changed values in one section."""
    part = msgspec.structs.replace(getattr(ROBOT, section), **values)
    return msgspec.structs.replace(ROBOT, **{section: part})


def make_ratings(torque_nm: float, speed_rad_s: float) -> dict[int, dict[ModuleParameter, float]]:
    """Return the parameters of node 4, which contain only its ratings."""
    return {4: {ModuleParameter.RATED_TORQUE: torque_nm, ModuleParameter.RATED_SPEED: speed_rad_s}}


@pytest.mark.parametrize("name", list_shipped_names("robots"))
def test_parameters_of_every_module_exclude_ratings_and_stay_in_range(name: str) -> None:
    robot = decode_table(read_table_with_base(name, "robots"), RobotFile)
    planned = plan_parameters(robot, CanSettings(), ReportSchedule(100.0))
    assert list(planned) == list(range(1, robot.chain.modules + 1))
    for values in planned.values():
        assert set(values) == set(ModuleParameter) - set(RATINGS)
        for parameter, value in values.items():
            allowed = PARAMETERS[parameter]
            assert allowed.writable and allowed.low <= value <= allowed.high, parameter.name


def test_parameters_of_a_geared_module_describe_its_own_shaft() -> None:
    geared_joint = JointExceptions(
        sign=-1, gear=2.0, zero_rad=0.5, angle_min_rad=-0.4, angle_max_rad=1.2, torque_nm=6.0
    )
    robot = msgspec.structs.replace(ROBOT, joints={"joint_2": geared_joint})
    first, second = (
        plan_parameters(robot, CanSettings(), ReportSchedule(100.0))[node] for node in (1, 2)
    )
    assert first[ModuleParameter.TORQUE_LIMIT] == 7.0
    assert first[ModuleParameter.ANGLE_LIMIT] == 1.5708
    assert second[ModuleParameter.STIFFNESS] == first[ModuleParameter.STIFFNESS] / 4
    assert second[ModuleParameter.TORQUE_LIMIT] == 3.0
    assert second[ModuleParameter.SPEED_LIMIT] == 15.0
    assert second[ModuleParameter.ANGLE_LIMIT] == pytest.approx(1.9), (
        "from 0.5 - 2.4 to 0.5 + 0.8 rad"
    )
    validate_ratings(
        robot, {2: {ModuleParameter.RATED_TORQUE: 3.0, ModuleParameter.RATED_SPEED: 15.0}}
    )


INVALID_DRIVES = {
    "an id": (JointExceptions(id=25), {}),
    "a port": (JointExceptions(port="can3"), {}),
    "a zero": (JointExceptions(zero_rad=2.5), {}),
    "a joint": (JointExceptions(), {"mounted": {"joint_99": MountedDrive(sign=-1)}}),
    "no emulators": (
        JointExceptions(),
        {"mounted": {"joint_2": MountedDrive(sign=-1)}, "emulators": "none", "channels": ["can0"]},
    ),
}


@pytest.mark.parametrize("case", INVALID_DRIVES)
def test_drive_settings_that_the_bus_cannot_have_are_refused(case: str) -> None:
    joint, settings_values = INVALID_DRIVES[case]
    settings = CanSettings(**settings_values)
    robot = msgspec.structs.replace(ROBOT, joints={"joint_2": joint})
    with raises_error(
        ConfigError, code=("bus/invalid-channel", "config/conflict", "drive/unsupported-setting")
    ):
        validate_joint_drives(robot, settings)
        validate_mounting_overrides(
            robot, "backends.can", settings.mounted, are_emulated=settings.emulators_run != "none"
        )
        validate_ratings(robot)


@pytest.mark.parametrize("tail", [True, False])
def test_parameters_let_only_first_module_report_tail_link(tail: bool) -> None:
    planned = plan_parameters(ROBOT, CanSettings(), ReportSchedule(100.0, tail=tail))
    assert [values[ModuleParameter.TAIL] for values in planned.values()] == [float(tail)] + [
        0.0
    ] * 12


@pytest.mark.parametrize(
    ("action", "stop_mode"), [("damp", SafeMotion.DAMP), ("passive", SafeMotion.PASSIVE)]
)
def test_parameters_take_stop_mode_from_robot_and_watchdog_from_settings(
    action: str, stop_mode: SafeMotion
) -> None:
    robot = change_robot("safety", action=action)
    values = plan_parameters(robot, CanSettings(watchdog_s=0.05), ReportSchedule(100.0, 3, 17))[1]
    parameters = (
        ModuleParameter.STOP_MODE,
        ModuleParameter.WATCHDOG,
        ModuleParameter.CONTACT_EVERY,
        ModuleParameter.IMU_EVERY,
    )
    assert [values[name] for name in parameters] == [stop_mode, 0.05, 3.0, 17.0]
    validate_ratings(robot)


def test_stop_mode_hold_is_refused_for_joint_modules() -> None:
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        validate_ratings(change_robot("safety", action="hold"))


@pytest.mark.parametrize(
    ("field", "opcode", "signal", "range_factor"),
    [
        ("angle_rad", Opcode.JOINT_STATE, "angle", 1.0),
        ("speed_rad_s", Opcode.JOINT_STATE, "velocity", SPEED_RANGE_FACTOR),
        ("torque_nm", Opcode.JOINT_STATE, "torque", 1.0),
        ("stop_at_c", Opcode.HEALTH, "motor_temperature", 1.0),
    ],
)
def test_limit_beyond_range_of_bus_signal_is_refused(
    field: str, opcode: Opcode, signal: str, range_factor: float
) -> None:
    max_value = load_layouts()[opcode].signals[signal].high / range_factor
    if field != "angle_rad" or max_value <= 3.1:
        validate_ratings(change_robot("limits", **{field: max_value * 0.999}))
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        validate_ratings(change_robot("limits", **{field: max_value * 1.001}))


@pytest.mark.parametrize(
    ("torque_nm", "speed_rad_s"),
    [
        (6.9, 7.5),
        (7.0, 7.0),
        (float("nan"), 7.5),
    ],
)
def test_module_with_lower_ratings_is_refused_by_joint_name(
    torque_nm: float, speed_rad_s: float
) -> None:
    with raises_error(BackendError, code="drive/unsupported-setting", field="joint_4"):
        validate_ratings(ROBOT, make_ratings(torque_nm, speed_rad_s))
