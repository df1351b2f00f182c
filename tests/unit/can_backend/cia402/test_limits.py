"""The driver reads units, limits and EDS files of drives at the start, and compares them with the joints."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from snakesim_can_backend.cia402.configuration import encode_cycle_period, list_configuration_steps
from snakesim_can_backend.cia402.eds import BUNDLED, read_all_eds, read_eds
from snakesim_can_backend.cia402.limits import determine_scaling, find_incompatibilities
from snakesim_can_backend.cia402.objects import (
    DEVICE_TYPE,
    ENCODER_INCREMENTS,
    MAX_POSITION,
    MAX_SPEED,
    MAX_TORQUE,
    MIN_POSITION,
    RATED_CURRENT,
    RATED_TORQUE,
    SUPPORTED_MODES,
    ObjectEntry,
)
from snakesim_can_backend.cia402.sdo import ReadStep, WriteStep
from snakesim_can_backend.cia402.settings import Cia402Settings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.messages import raises_error

FITTING_OBJECTS: dict[ObjectEntry, int] = {  # suits a joint of 4 N·m, 5 rad/s and 1.5 rad
    DEVICE_TYPE: 0x0002_0192,
    SUPPORTED_MODES: 0x380,
    ENCODER_INCREMENTS: 10_000,
    RATED_TORQUE: 2_000,
    MAX_TORQUE: 2_000,
    MAX_SPEED: 48,
    MIN_POSITION: -2_400,
    MAX_POSITION: 2_400,
}


def make_joint(**dotted: Any) -> Joint:
    return make_can_config(1, backend="cia402", **dotted).robot.joint_table[0]


def list_incompatibilities(
    changed: dict[ObjectEntry, int], checked_joint: Joint | None = None, **settings: Any
) -> list[str]:
    """Return what does not fit between a drive with changed objects and a joint."""
    if checked_joint is None:
        checked_joint = make_joint()
    values = FITTING_OBJECTS | changed
    drive_settings = Cia402Settings(**settings)
    scaling = determine_scaling(values, drive_settings, checked_joint)
    assert not isinstance(scaling, str), scaling
    return list(find_incompatibilities(values, scaling, drive_settings, checked_joint))


def test_drive_with_fitting_limits_has_no_incompatibilities() -> None:
    assert list_incompatibilities({}) == []
    assert list_incompatibilities({MIN_POSITION: 0, MAX_POSITION: 0}) == [], (
        "equal limits mean that the drive has no position limits"
    )
    without_speed = dict(FITTING_OBJECTS)
    del without_speed[MAX_SPEED]
    scaling = determine_scaling(without_speed, Cia402Settings(), make_joint())
    assert not isinstance(scaling, str)
    assert (
        list(find_incompatibilities(without_speed, scaling, Cia402Settings(), make_joint())) == []
    )


@pytest.mark.parametrize(
    ("changed", "settings", "expected_text"),
    [
        (
            {MAX_TORQUE: 1_900},
            {},
            "torque limit (6072h) of 3.8 N·m, and its joint may command 4 N·m",
        ),
        (
            {MAX_SPEED: 40},
            {},
            "speed limit (6080h) of 4.189 rad/s, and its joint may turn at 5 rad/s",
        ),
        ({MAX_POSITION: 2_000}, {}, "position limits (607Dh) of -1.508 to 1.257 rad"),
        ({SUPPORTED_MODES: 0x300}, {}, "mode 8, cyclic synchronous position (CSP) (6502h)"),
        ({SUPPORTED_MODES: 0x180}, {}, "mode 10, cyclic synchronous torque (CST) (6502h)"),
        ({DEVICE_TYPE: 0x191}, {}, "device profile 401"),
        (
            {},
            {"counts_per_turn": 4096},
            "10000 a turn, and `backends.cia402.counts_per_turn` = 4096",
        ),
        (
            {},
            {"rated_torque_nm": 1.5},
            "rated torque (6076h) of 2 N·m, and `backends.cia402.rated_torque_nm` = 1.5",
        ),
    ],
)
def test_limit_or_unit_that_does_not_fit_joint_is_named(
    changed: dict[ObjectEntry, int], settings: dict[str, Any], expected_text: str
) -> None:
    incompatibilities = list_incompatibilities(changed, **settings)
    assert any(expected_text in incompatibility for incompatibility in incompatibilities), (
        incompatibilities
    )


def test_limits_of_drive_respect_gear_sign_and_zero() -> None:
    geared = make_joint(robot__drive__gear=10.0, robot__drive__sign=-1, robot__drive__zero_rad=1.0)
    fitting = {MAX_TORQUE: 200, MAX_SPEED: 480, MIN_POSITION: -22_500, MAX_POSITION: 25_600}
    assert list_incompatibilities(fitting, geared) == []
    assert "speed limit" in list_incompatibilities(fitting | {MAX_SPEED: 48}, geared)[0]
    assert "position limits" in list_incompatibilities(fitting | {MAX_POSITION: 22_500}, geared)[0]


def test_units_of_a_drive_convert_both_ways() -> None:
    scaling = determine_scaling(
        FITTING_OBJECTS, Cia402Settings(velocity_units_per_turn_s=60), make_joint()
    )
    assert not isinstance(scaling, str)
    assert scaling.to_position(3.141592653589793) == 5000
    assert scaling.to_velocity(6.283185307179586) == 60
    assert scaling.to_torque(-1.0) == -500
    assert scaling.to_max_torque(0.9999) == 499, "rounded down"
    assert scaling.to_angle_rad(5000) == pytest.approx(3.14159265)
    assert scaling.to_velocity_rad_s(60) == pytest.approx(6.28318531)
    assert scaling.to_torque_nm(-500) == pytest.approx(-1.0)


def test_rated_torque_of_drive_without_it_follows_rated_current() -> None:
    values = {entry: value for entry, value in FITTING_OBJECTS.items() if entry != RATED_TORQUE} | {
        RATED_CURRENT: 8_000
    }
    scaling = determine_scaling(
        values, Cia402Settings(), make_joint(robot__motor__torque_constant_nm_per_a=0.25)
    )
    assert not isinstance(scaling, str)
    assert scaling.rated_torque_nm == pytest.approx(2.0)
    refusal = determine_scaling(values, Cia402Settings(), make_joint())
    assert isinstance(refusal, str) and "rated_torque_nm" in refusal
    no_counts = {
        entry: value for entry, value in FITTING_OBJECTS.items() if entry != ENCODER_INCREMENTS
    }
    refusal = determine_scaling(no_counts, Cia402Settings(), make_joint())
    assert isinstance(refusal, str) and "counts_per_turn" in refusal


def test_configuration_writes_each_mapping_while_disabled_and_checks_it() -> None:
    steps = list_configuration_steps(5, Cia402Settings(), 0.01)
    writes = [
        step
        for step in steps
        if isinstance(step, WriteStep) and step.entry.index in (0x1400, 0x1600)
    ]
    assert [(step.entry.index, step.entry.sub, step.value) for step in writes] == [
        (0x1400, 1, 0x8000_0205),
        (0x1600, 0, 0),
        (0x1600, 1, 0x6040_0010),
        (0x1600, 2, 0x607A_0020),
        (0x1600, 3, 0x6072_0010),
        (0x1600, 0, 3),
        (0x1400, 2, 255),
        (0x1400, 1, 0x205),
    ]
    checked = {step.entry: step.expected for step in steps if isinstance(step, ReadStep)}
    last_written = {
        step.entry: step.value
        for step in steps
        if isinstance(step, WriteStep) and not step.optional
    }
    assert {entry: checked[entry] for entry in last_written} == last_written


@pytest.mark.parametrize(
    ("period_s", "encoded"),
    [(0.01, (10, -3)), (0.02, (20, -3)), (0.0025, (25, -4)), (1 / 30, (33, -3)), (0.5, (50, -2))],
)
def test_control_period_is_encoded_as_value_and_exponent(
    period_s: float, encoded: tuple[int, int]
) -> None:
    assert encode_cycle_period(period_s) == encoded


# --- EDS files -------------------------------------------------------------------------------------------------


def test_bundled_eds_has_all_objects_that_the_driver_needs() -> None:
    assert list(read_eds(BUNDLED).find_missing_objects()) == []
    assert len(read_all_eds([str(BUNDLED)])) == 1


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[6072]\n", "[2072]\n"),
        (
            "ParameterName=Target velocity\nObjectType=0x7\nDataType=0x0004",
            "ParameterName=V\nDataType=0x0003",
        ),
        (
            "ParameterName=Max torque\nObjectType=0x7\nDataType=0x0006\nAccessType=rww\nPDOMapping=1",
            "DataType=0x0006",
        ),
        ("[1016sub1]", "[1016sub9]"),
        ("[6041]\nParameterName=Statusword\nObjectType=0x7", "[6041]\nObjectType=seven"),
        ("[FileInfo]", "nothing before a section"),
    ],
    ids=["missing", "other size", "not mappable", "no consumer", "no number", "syntax"],
)
def test_eds_without_a_required_object_is_refused(tmp_path: Path, old: str, new: str) -> None:
    text = BUNDLED.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "drive.eds"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with raises_error(
        ConfigError, code=("drive/unsupported-setting", "file/not-readable"), field="drive.eds"
    ):
        read_all_eds([str(path)])


def test_compact_arrays_and_defaults_with_node_id_are_read(tmp_path: Path) -> None:
    path = tmp_path / "drive.eds"
    path.write_text(
        "[DeviceInfo]\nVendorNumber=0x1A\nProductNumber=7\n"
        "[1003]\nParameterName=Errors\nObjectType=0x8\nDataType=0x0007\nAccessType=ro\nCompactSubObj=2\n"
        "[1014]\nParameterName=EMCY\nDataType=0x0007\nAccessType=rw\nDefaultValue=$NODEID+0x80\n",
        encoding="utf-8",
    )
    eds = read_eds(path)
    assert (eds.vendor, eds.product) == (0x1A, 7)
    assert set(eds.objects) == {(0x1003, 0), (0x1003, 1), (0x1003, 2), (0x1014, 0)}
    assert eds.objects[0x1014, 0].default_value(5) == 0x85
    assert replace(eds.objects[0x1014, 0], default="text").default_value(5) == 0
