"""Samples that the driver makes from frames of joint modules, also of contacts that an emulator encodes."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_can_backend.bus.load import ReportSchedule, plan_reports
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.driver.sensors import (
    NEVER_RECEIVED_AGE_NS,
    SampleBuilder,
    are_contacts_due,
    describe_sensors,
    locate_on_capsule,
)
from snakesim_can_backend.emulator.frames import encode_contact, write_contact, write_tail_contact
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import Opcode
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.backend import Samples
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.physics_model import LinkLoad
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Imu, Power
from snakesim_hal.wire.quantities import Vector
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.can.frames import (
    answer_sync,
    make_accelerometer_frame,
    make_contact_frame,
    make_gyro_frame,
    make_health_frame,
    run_syncs,
    start_sync,
)

JOINTS = 4
PERIOD_NS = 10_000_000
ALL_SENSORS: dict[str, Any] = {
    "robot__sensors__contacts__rate_hz": 100.0,
    "robot__sensors__imu__rate_hz": 50.0,
    "robot__sensors__pose__rate_hz": 100.0,
}


def make_sensors(
    run: RunConfig, schedule: ReportSchedule | None = None
) -> tuple[ModuleReports, SampleBuilder]:
    """Return module reports, and the builder that makes samples from them."""
    reports = ModuleReports(run.robot.chain.modules)
    return reports, SampleBuilder(run, schedule or plan_reports(run, CanSettings()), reports, None)


def get_contacts(samples: Samples) -> Contacts:
    """Return the contacts of a sample."""
    contacts = samples.by_key[keys.CONTACTS]
    assert isinstance(contacts, Contacts)
    return contacts


# --- joints ------------------------------------------------------------------------------------------------


def test_joint_state_of_newest_sync_has_age_zero() -> None:
    reading, sensors = make_sensors(make_can_config())
    run_syncs(reading, 1, angle=0.5, velocity=-1.0, torque=2.0)
    joints = sensors.make_samples(tick=7, timestamp_ns=70_000_000).joints
    assert joints.tick == 7
    assert joints.timestamp_ns == 70_000_000
    assert joints.angle_rad == pytest.approx([0.5] * JOINTS)
    assert joints.velocity_rad_s == pytest.approx([-1.0] * JOINTS)
    assert joints.torque_nm == pytest.approx([2.0] * JOINTS)
    assert joints.age_ns == [0] * JOINTS
    assert joints.valid == [True] * JOINTS


def test_joint_state_of_silent_module_is_valid_for_the_lease() -> None:
    lease_periods = 5
    reading, sensors = make_sensors(make_can_config())
    run_syncs(reading, 1, angle=0.5)
    for missed in range(1, 9):
        run_syncs(reading, 1, [1, 2, 4], angle=0.6)  # node 3 is silent
        joints = sensors.make_samples(7 + missed, 0).joints
        assert joints.age_ns == [0, 0, missed * PERIOD_NS, 0]
        assert joints.valid == [True, True, missed <= lease_periods, True]
        assert joints.angle_rad == pytest.approx([0.6, 0.6, 0.5, 0.6])


def test_joint_state_never_received_is_invalid() -> None:
    reading, sensors = make_sensors(make_can_config())
    run_syncs(reading, 1, [1, 2, 4])
    joints = sensors.make_samples(0, 0).joints
    assert joints.valid == [True, True, False, True]
    assert joints.age_ns[2] == NEVER_RECEIVED_AGE_NS
    assert joints.angle_rad == pytest.approx([0.1, 0.1, 0.0, 0.1]), (
        "an unknown angle is 0.0 and invalid"
    )


# --- contacts ----------------------------------------------------------------------------------------------


def test_contacts_are_sampled_only_at_requested_syncs() -> None:
    run = make_can_config(**ALL_SENSORS)
    schedule = ReportSchedule(100.0, contact_every=3)
    reading, sensors = make_sensors(run, schedule)
    for tick in range(300):
        sync = start_sync(reading, contacts=are_contacts_due(schedule, reading.sync + 1))
        answer_sync(reading)
        assert are_contacts_due(schedule, sync) is (sync % 256 % 3 == 0)
        assert (keys.CONTACTS in sensors.make_samples(tick, 0).by_key) is are_contacts_due(
            schedule, sync
        )
    assert not any(
        are_contacts_due(ReportSchedule(100.0, contact_every=0), sync) for sync in range(300)
    )


def test_contacts_without_touch_are_an_empty_list() -> None:
    reading, sensors = make_sensors(make_can_config(**ALL_SENSORS))
    start_sync(reading, contacts=True)
    reading.process_frame(make_contact_frame(2, reading.sync, touched=False, force_x=9.0))
    assert get_contacts(sensors.make_samples(3, 30)) == Contacts(
        tick=3, timestamp_ns=30, contacts=[], measured_force_n=0.0
    )


def test_contact_is_in_the_frame_of_its_link() -> None:
    run = make_can_config(**ALL_SENSORS)
    reading, sensors = make_sensors(run)
    start_sync(reading, contacts=True)
    reading.process_frame(
        make_contact_frame(
            2, reading.sync, force_x=1.0, force_y=-3.0, along=0.04, bearing=math.pi / 2
        )
    )
    (reported,) = get_contacts(sensors.make_samples(3, 30)).contacts
    radius_m = run.robot.module.radius_m
    assert reported.link == 2
    assert reported.obstacle is None
    assert reported.torque_l == (0.0, 0.0, 0.0)
    assert reported.position_l == pytest.approx((0.04, 0.0, radius_m))
    assert reported.normal_l == pytest.approx((0.0, 0.0, -1.0)), "from the obstacle into the body"
    assert reported.force_l == pytest.approx((1.0, -3.0, 0.0))
    axes = np.array((reported.normal_l, reported.tangent_1_l, reported.tangent_2_l))
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert reported.tangent_1_l[0] > 0


def test_contact_below_threshold_of_robot_is_omitted() -> None:
    reading, sensors = make_sensors(
        make_can_config(**ALL_SENSORS, robot__sensors__contacts__threshold_n=1.0)
    )
    start_sync(reading, contacts=True)
    for node, force_n in ((1, 0.9), (2, 1.0), (3, -1.05)):
        reading.process_frame(make_contact_frame(node, reading.sync, force_z=force_n))
    assert [reported.link for reported in get_contacts(sensors.make_samples(0, 0)).contacts] == [
        2,
        3,
    ]


# The position of a contact, from the physics model through emulator and bus to the HAL.


def compute_capsule_point(
    along_m: float, polar: float, bearing: float, length_m: float, radius_m: float
) -> Vector:
    """Return a point of a capsule: on the cylinder if polar is 0, on the sphere at the nearer end otherwise."""
    if polar == 0:
        base_m = along_m
    elif polar > 0:
        base_m = length_m
    else:
        base_m = 0.0
    across = radius_m * math.cos(polar)
    return (
        base_m + radius_m * math.sin(polar),
        across * math.cos(bearing),
        across * math.sin(bearing),
    )


@given(
    link=st.integers(0, JOINTS),
    position_fraction=st.floats(0, 1),
    polar=st.just(0.0) | st.floats(-1.4, 1.4),
    bearing=st.floats(-math.pi, math.pi),
)
def test_contact_anywhere_on_a_capsule_is_reported_within_bus_resolution(
    link: int, position_fraction: float, polar: float, bearing: float
) -> None:
    run = make_can_config(**ALL_SENSORS)
    length_m = run.robot.link_lengths_m[link]
    radius_m = run.robot.module.radius_m
    point = compute_capsule_point(position_fraction * length_m, polar, bearing, length_m, radius_m)
    reading, sensors = make_sensors(run)
    sync = start_sync(reading, contacts=True)
    values = (*encode_contact(LinkLoad(link, point, (1.0, 2.0, 3.0))), sync)
    reading.process_frame(
        write_tail_contact(1, values) if link == 0 else write_contact(link, values)
    )
    (reported,) = get_contacts(sensors.make_samples(0, 0)).contacts
    assert reported.link == link
    axis_point = (min(max(point[0], 0.0), length_m), 0.0, 0.0)
    outward = [
        (point_m - base_m) / radius_m for point_m, base_m in zip(point, axis_point, strict=True)
    ]
    cosine = -float(np.dot(outward, reported.normal_l))
    # A position step along the link changes the normal by up to step / (radius x cos(polar)).
    bearing_error_rad = load_layouts()[Opcode.CONTACT].signals["bearing"].scale / 2
    along_error_rad = (
        load_layouts()[Opcode.CONTACT].signals["along"].scale / 2 / (radius_m * math.cos(polar))
    )
    max_error_rad = 1.5 * (bearing_error_rad * math.cos(polar) + along_error_rad) + 1e-9
    assert math.acos(min(cosine, 1.0)) <= max_error_rad
    assert math.dist(point, reported.position_l) <= radius_m * max_error_rad + 0.00025


@given(st.floats(-0.3, 0.3), st.floats(-4, 4), st.floats(0.01, 0.2), st.floats(0.005, 0.1))
def test_contact_position_is_on_the_capsule(
    along_m: float, bearing: float, length_m: float, radius_m: float
) -> None:
    outward, point = locate_on_capsule(along_m, bearing, length_m, radius_m)
    assert math.hypot(*outward) == pytest.approx(1.0)
    axis_m = min(max(point[0], 0.0), length_m)
    assert math.dist(point, (axis_m, 0.0, 0.0)) == pytest.approx(radius_m)
    if -radius_m <= along_m <= length_m + radius_m:
        assert point[0] == pytest.approx(along_m, abs=1e-12)


# --- IMUs, power, pose -------------------------------------------------------------------------------------


def test_imu_sample_has_only_new_and_complete_reports() -> None:
    reading, sensors = make_sensors(make_can_config(**ALL_SENSORS))
    run_syncs(reading, 1)
    assert keys.IMU not in sensors.make_samples(0, 0).by_key
    reading.process_frame(make_gyro_frame(3, 0, 0.5))
    reading.process_frame(make_accelerometer_frame(3, 0, 9.81))
    reading.process_frame(make_gyro_frame(1, 0, 0.5))  # incomplete: without its acceleration
    imu = sensors.make_samples(1, 10).by_key[keys.IMU]
    assert isinstance(imu, Imu)
    assert imu.tick == 1
    assert imu.timestamp_ns == 10
    assert imu.link == [3]
    assert imu.angular_velocity_rad_s[0] == pytest.approx((0.5, 0.0, 0.0))
    assert imu.acceleration_m_s2[0] == pytest.approx((0.0, 0.0, 9.81))
    assert keys.IMU not in sensors.make_samples(2, 0).by_key


def test_power_sample_is_made_every_half_second() -> None:
    reading, sensors = make_sensors(make_can_config())
    run_syncs(reading, 1)
    ticks_with_power = [
        tick for tick in range(101) if keys.POWER in sensors.make_samples(tick, 0).by_key
    ]
    assert ticks_with_power == [0, 50, 100]  # at 100 Hz


def test_power_sample_of_modules_without_report_is_invalid() -> None:
    reading, sensors = make_sensors(make_can_config())
    run_syncs(reading, 1)
    reading.process_frame(
        make_health_frame(
            2, voltage=23.5, current=-1.5, motor_temperature=-10, board_temperature=40, leak=1
        )
    )
    reading.process_frame(make_health_frame(4, voltage=24.0))
    power = sensors.make_samples(50, 7).by_key[keys.POWER]
    assert isinstance(power, Power)
    assert power.tick == 50
    assert power.timestamp_ns == 7
    assert power.valid == [False, True, False, True]
    assert power.leak == [False, True, False, False]
    assert power.voltage_v == pytest.approx([0.0, 23.5, 0.0, 24.0])
    assert power.current_a[1] == pytest.approx(-1.5)
    assert power.motor_c[1] == -10.0
    assert power.board_c[1] == 40.0
    assert all(len(column) == JOINTS for column in (power.current_a, power.motor_c, power.board_c))


def test_power_values_of_a_module_expire() -> None:
    reading, sensors = make_sensors(make_can_config())
    run_syncs(reading, 1)
    reading.process_frame(make_health_frame(2, voltage=23.5))

    def get_valid_flags(tick: int) -> list[bool]:
        power = sensors.make_samples(tick, 0).by_key[keys.POWER]
        assert isinstance(power, Power)
        return power.valid

    run_syncs(reading, 125)  # at 100 Hz: two and a half report periods
    assert get_valid_flags(50) == [False, True, False, False]
    run_syncs(reading, 1)
    assert get_valid_flags(100) == [False] * JOINTS
    reading.process_frame(make_health_frame(2, voltage=23.5))
    assert get_valid_flags(150) == [False, True, False, False]


# --- descriptions ------------------------------------------------------------------------------------------


def test_sensor_descriptions_have_rates_and_delays() -> None:
    run = make_can_config(**ALL_SENSORS)
    sensors = describe_sensors(run, ReportSchedule(100.0, 4, 20), pose_delay_s=0.02)
    rates_hz = {sensor.key: sensor.rate_hz for sensor in sensors}
    assert rates_hz == {
        keys.JOINTS: 100.0,
        keys.CONTACTS: 25.0,
        keys.IMU: 5.0,
        keys.POWER: 2.0,
        keys.POSE: 100.0,
    }
    assert {sensor.key: sensor.delay_s for sensor in sensors if sensor.delay_s} == {keys.POSE: 0.02}
    minimal_keys = {
        sensor.key
        for sensor in describe_sensors(run, ReportSchedule(100.0, 0, 0), pose_delay_s=None)
    }
    assert minimal_keys == {keys.JOINTS, keys.POWER}
