"""Sensor samples of a tick."""

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, encode, format_encoding
from snakesim_hal.wire.custom_sample import find_custom_message
from snakesim_hal.wire.messages import MountedSample, Power
from snakesim_hal.wire.outgoing import find_wrong_value
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.faults import inject_or_skip
from snakesim_testing.contract.rig import Record, Rig

COLUMNS = ("angle_rad", "velocity_rad_s", "torque_nm", "valid", "age_ns")


def test_joints_carry_the_tick_and_stamp_that_were_asked_for(rig: Rig, healthy: Record) -> None:
    """One joint state a tick, stamped with the robot's own time."""
    ticks = [joints.tick for joints in healthy.joints]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    assert all(joints.timestamp_ns == joints.tick * rig.period_ns for joints in healthy.joints)


def test_other_sensors_are_stamped_when_they_were_read(rig: Rig, healthy: Record) -> None:
    """Never from the future, never older than delay, interval and transport together; and in order."""
    for sensor in rig.robot.sensors:
        if sensor.key == keys.JOINTS:
            continue
        oldest_ns = 1e9 * (sensor.delay_s + 1 / sensor.rate_hz) + t.SENSOR_PERIODS * rig.period_ns
        stamps: list[int] = []
        for sample in healthy.samples:
            if (message := sample.others.get(sensor.key)) is not None:
                timestamp_ns: int = message.timestamp_ns  # pyright: ignore[reportAttributeAccessIssue]
                stamps.append(timestamp_ns)
                age_ns = sample.joints.timestamp_ns - timestamp_ns
                assert 0 <= age_ns <= oldest_ns, f"{sensor.key}: {age_ns * 1e-6} ms old"
        assert all(before < after for before, after in pairwise(stamps)), f"{sensor.key}: out of order"


def test_every_vector_has_one_entry_a_joint(rig: Rig, healthy: Record) -> None:
    """Angle, velocity, torque, validity and age, tail to head."""
    for joints in healthy.joints:
        lengths = {name: len(getattr(joints, name)) for name in COLUMNS}
        assert set(lengths.values()) == {rig.count}, lengths


def test_every_sample_survives_the_wire(rig: Rig, healthy: Record) -> None:
    """Finite and within the bounds of the messages: encoded and decoded by the HAL's codec it is the same.

    A custom message is decoded by its schema in the description, which is all that clients know of it.
    """
    for sample in healthy.samples:
        for key, message in ((keys.JOINTS, sample.joints), *sample.others.items()):
            own = find_custom_message(key, rig.robot)
            decoder = Decoder(type(message) if own is None else own.message)
            try:
                decoded = decoder.decode(encode(message), format_encoding(type(message)))
            except WireError as error:
                pytest.fail(f"{key}: {find_wrong_value(message) or error}")
            assert msgspec.to_builtins(decoded) == msgspec.to_builtins(message)
        assert all(math.isfinite(number) for name in COLUMNS[:3] for number in getattr(sample.joints, name))


def test_every_sample_fits_the_robot(rig: Rig, healthy: Record) -> None:
    """Links and joints are those of the description, rotations are rotations, an image has all of its pixels."""
    for sample in healthy.samples:
        for key, message in sample.others.items():
            assert (why := find_mismatch(message, rig.robot)) is None, f"{key}: {why}"


def test_no_sample_contradicts_itself(healthy: Record) -> None:
    """What cameras and lidars measure is within their range; a custom message finds impossible values itself."""
    for sample in healthy.samples:
        for key, message in sample.others.items():
            if isinstance(message, MountedSample):
                assert not (why := message.find_contradiction()), f"{key}: {why}"


def test_every_joint_is_valid_and_fresh_at_every_tick(rig: Rig, healthy: Record) -> None:
    """In normal operation all joints are known; a reading is at most a period old, besides the stated delay."""
    delay_s = next(sensor.delay_s for sensor in rig.robot.sensors if sensor.key == keys.JOINTS)
    oldest_ns = t.AGE_PERIODS * rig.period_ns + delay_s * 1e9
    for joints in healthy.joints:
        assert all(joints.valid), f"tick {joints.tick}: {joints.valid}"
        assert max(joints.age_ns) <= oldest_ns, f"tick {joints.tick}: {joints.age_ns} ns"


def test_what_is_not_known_yet_is_not_reported_as_valid(rig: Rig) -> None:
    """The very first sample: a joint has the same angle as afterwards, or it is not valid."""
    for i, valid in enumerate(rig.first_sample.joints.valid):
        away = rig.first_sample.joints.angle_rad[i] - rig.home_rad[i]
        assert not valid or abs(away) < t.STILL_RAD, f"joint {i} was {away:+.3f} rad off and called valid"


def test_readings_follow_the_motion(healthy: Record) -> None:
    """A moving robot gives new readings: no joint repeats one old reading for long."""
    angles = np.round(healthy.angle_rad, 6)
    for i in range(angles.shape[1]):
        fresh = len(np.unique(angles[:, i]))
        assert fresh > len(angles) // 3, f"joint {i}: only {fresh} different readings in {len(angles)} ticks"


def test_supply_and_temperatures_are_in_volts_and_degrees(bench: Bench, rig: Rig) -> None:
    """Every joint that measures them reports a voltage near the robot file's, and the temperatures of a cool motor."""
    power = read_power(rig)
    for i, joint in enumerate(bench.config.robot.joint_table):
        name = rig.robot.joints[i].name
        if "voltage" in rig.robot.joints[i].measures:
            assert power.valid[i], f"{name} has not reported its supply"
            difference = abs(power.voltage_v[i] / joint.supply.voltage_v - 1)
            assert difference <= t.SUPPLY_SHARE, f"{name}: {power.voltage_v[i]} V, on {joint.supply.voltage_v:g} V"
        if "temperature" in rig.robot.joints[i].measures:
            for temperature_c in (power.motor_c[i], power.board_c[i]):
                limit_c = rig.robot.joints[i].derate_from_c
                assert t.COLDEST_C < temperature_c < limit_c, f"{name}: {temperature_c} °C, and it has not worked yet"


def test_a_sagging_supply_is_reported_at_its_joint(rig: Rig) -> None:
    """The supply of one drive sags: its reported voltage drops, and the robot is stopped."""
    if "voltage" not in rig.robot.joints[1].measures:
        pytest.skip(f"{rig.robot.joints[1].name} does not measure its supply")
    before_v = read_power(rig).voltage_v
    inject_or_skip(rig, "undervoltage:joint_2@0-9")
    rig.spoiled = True
    sagging_v = read_power(rig).voltage_v
    assert before_v[1] - sagging_v[1] > t.SAG_V, f"it sags from {before_v[1]} V, and is reported as {sagging_v[1]} V"
    assert rig.authority.state == "fault", "a supply below `min_voltage_v`, and the robot may be armed"


def read_power(rig: Rig) -> Power:
    """Return the newest power sample after every drive had time for a report; skip without a power sensor."""
    if not any(sensor.key == keys.POWER for sensor in rig.robot.sensors):
        pytest.skip("this robot has no power sensor")
    record = rig.idle(rig.count_periods(t.POWER_S))
    samples = [sample.others[keys.POWER] for sample in record.samples if keys.POWER in sample.others]
    assert samples, f"no power sample in {t.POWER_S} s"
    newest = samples[-1]
    assert isinstance(newest, Power)
    return newest
