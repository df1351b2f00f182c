"""A robot file as parameters: what the protocol holds, and what modules can do."""

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
from snakesim_hal.model.joints import JointExceptions
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import load_scenario
from snakesim_testing.messages import raises_error

ROBOT = load_scenario("triplet").config.robot
RATED = (ModuleParameter.RATED_TORQUE, ModuleParameter.RATED_SPEED)


def changed(section: str, **values: Any) -> RobotFile:
    part = msgspec.structs.replace(getattr(ROBOT, section), **values)
    return msgspec.structs.replace(ROBOT, **{section: part})


def rated(torque_nm: float, speed_rad_s: float) -> dict[int, dict[ModuleParameter, float]]:
    return {4: {ModuleParameter.RATED_TORQUE: torque_nm, ModuleParameter.RATED_SPEED: speed_rad_s}}


@pytest.mark.parametrize("name", list_shipped_names("robots"))
def test_parameters_of_every_module_exclude_ratings_and_stay_in_range(name: str) -> None:
    robot = decode_table(read_table_with_base(name, "robots"), RobotFile)
    wanted = plan_parameters(robot, CanSettings(), ReportSchedule(100.0))
    assert list(wanted) == list(range(1, robot.chain.modules + 1))
    for values in wanted.values():
        assert set(values) == set(ModuleParameter) - set(RATED)
        for parameter, value in values.items():
            allowed = PARAMETERS[parameter]
            assert allowed.writable and allowed.low <= value <= allowed.high, parameter.name


def test_parameters_of_a_geared_module_describe_its_own_shaft() -> None:
    own = JointExceptions(
        sign=-1, gear=2.0, zero_rad=0.5, angle_min_rad=-0.4, angle_max_rad=1.2, torque_nm=6.0
    )
    robot = msgspec.structs.replace(ROBOT, joints={"joint_2": own})
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


MISPLACED = {
    "an id": (JointExceptions(id=25), {}),
    "a port": (JointExceptions(port="can3"), {}),
    "a zero": (JointExceptions(zero_rad=2.5), {}),
    "a joint": (JointExceptions(), {"mounted": {"joint_99": MountedDrive(sign=-1)}}),
    "no emulators": (
        JointExceptions(),
        {"mounted": {"joint_2": MountedDrive(sign=-1)}, "emulators": "none", "channels": ["can0"]},
    ),
}


@pytest.mark.parametrize("wrong", MISPLACED)
def test_drives_that_the_bus_cannot_have_are_refused(wrong: str) -> None:
    own, given = MISPLACED[wrong]
    settings = CanSettings(**given)
    robot = msgspec.structs.replace(ROBOT, joints={"joint_2": own})
    with raises_error(
        ConfigError, code=("bus/invalid-channel", "config/conflict", "drive/unsupported-setting")
    ):
        validate_joint_drives(robot, settings)
        validate_mounting_overrides(
            robot, "backends.can", settings.mounted, are_emulated=settings.emulators_run != "none"
        )
        validate_ratings(robot)


@pytest.mark.parametrize("tail", [True, False])
def test_only_the_first_module_reports_the_tail_link(tail: bool) -> None:
    wanted = plan_parameters(ROBOT, CanSettings(), ReportSchedule(100.0, tail=tail))
    assert [values[ModuleParameter.TAIL] for values in wanted.values()] == [float(tail)] + [
        0.0
    ] * 12


@pytest.mark.parametrize(
    ("action", "motion"), [("damp", SafeMotion.DAMP), ("passive", SafeMotion.PASSIVE)]
)
def test_parameters_take_stop_mode_from_robot_and_watchdog_from_settings(
    action: str, motion: SafeMotion
) -> None:
    robot = changed("safety", action=action)
    told = plan_parameters(robot, CanSettings(watchdog_s=0.05), ReportSchedule(100.0, 3, 17))[1]
    names = (
        ModuleParameter.STOP_MODE,
        ModuleParameter.WATCHDOG,
        ModuleParameter.CONTACT_EVERY,
        ModuleParameter.IMU_EVERY,
    )
    assert [told[name] for name in names] == [motion, 0.05, 3.0, 17.0]
    validate_ratings(robot)


def test_stiff_holding_is_nothing_a_module_does_by_itself() -> None:
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        validate_ratings(changed("safety", action="hold"))


@pytest.mark.parametrize(
    ("field", "opcode", "signal", "room"),
    [
        ("angle_rad", Opcode.JOINT_STATE, "angle", 1.0),
        ("speed_rad_s", Opcode.JOINT_STATE, "velocity", SPEED_RANGE_FACTOR),
        ("torque_nm", Opcode.JOINT_STATE, "torque", 1.0),
        ("stop_at_c", Opcode.HEALTH, "motor_temperature", 1.0),
    ],
)
def test_limits_end_where_the_bus_ends(
    field: str, opcode: Opcode, signal: str, room: float
) -> None:
    most = load_layouts()[opcode].signals[signal].high / room
    if field != "angle_rad" or most <= 3.1:
        validate_ratings(changed("limits", **{field: most * 0.999}))
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        validate_ratings(changed("limits", **{field: most * 1.001}))


@pytest.mark.parametrize(
    ("torque_nm", "speed_rad_s"),
    [
        (6.9, 7.5),
        (7.0, 7.0),
        (float("nan"), 7.5),
    ],
)
def test_a_weaker_module_is_named_with_what_to_do(torque_nm: float, speed_rad_s: float) -> None:
    with raises_error(BackendError, code="drive/unsupported-setting", field="joint_4"):
        validate_ratings(ROBOT, rated(torque_nm, speed_rad_s))
