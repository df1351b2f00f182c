"""Sensor samples of a tick."""

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.custom_sample import find_custom_message
from snakesim_hal.wire.messages import MountedSample, Power
from snakesim_hal.wire.outgoing import describe_invalid_field
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.faults import inject_or_skip
from snakesim_testing.contract.rig import BackendRig, RigRecord

JOINT_STATE_VECTORS = ("angle_rad", "velocity_rad_s", "torque_nm", "valid", "age_ns")


def test_joints_carry_the_tick_and_stamp_that_were_asked_for(
    rig: BackendRig, healthy: RigRecord
) -> None:
    """There is one joint state for each tick, and its timestamp is the robot time of the tick."""
    ticks = [joints.tick for joints in healthy.joints]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    assert all(joints.timestamp_ns == joints.tick * rig.period_ns for joints in healthy.joints)


def test_other_sensors_are_stamped_when_they_were_read(rig: BackendRig, healthy: RigRecord) -> None:
    """Sensor samples are never from the future, never older than delay, period and transport, and in order."""
    for sensor in rig.robot.sensors:
        if sensor.key == keys.JOINTS:
            continue
        max_age_ns = (
            1e9 * (sensor.delay_s + 1 / sensor.rate_hz)
            + tolerances.SENSOR_START_PERIODS * rig.period_ns
        )
        timestamps_ns: list[int] = []
        for sample in healthy.samples:
            if (message := sample.by_key.get(sensor.key)) is not None:
                timestamp_ns: int = message.timestamp_ns  # pyright: ignore[reportAttributeAccessIssue]
                timestamps_ns.append(timestamp_ns)
                age_ns = sample.joints.timestamp_ns - timestamp_ns
                assert 0 <= age_ns <= max_age_ns, (
                    f"a sample of {sensor.key} is {age_ns * 1e-6:g} ms old; allowed are 0 to {max_age_ns * 1e-6:g} ms"
                )
        assert all(before < after for before, after in pairwise(timestamps_ns)), (
            f"the samples of {sensor.key} are out of order"
        )


def test_every_vector_has_one_entry_a_joint(rig: BackendRig, healthy: RigRecord) -> None:
    """Angle, velocity, torque, validity and age in a joint state have one entry for each joint."""
    for joints in healthy.joints:
        lengths = {name: len(getattr(joints, name)) for name in JOINT_STATE_VECTORS}
        assert set(lengths.values()) == {rig.joint_count}, lengths


def test_every_sample_survives_the_wire(rig: BackendRig, healthy: RigRecord) -> None:
    """Every sample is finite, within the bounds of its message, and unchanged by the HAL's encoder and decoder.

    A custom message is decoded by its schema in the description, which is all that clients know of it.
    """
    for sample in healthy.samples:
        for key, message in ((keys.JOINTS, sample.joints), *sample.by_key.items()):
            custom_message = find_custom_message(key, rig.robot)
            decoder = MessageDecoder(
                type(message) if custom_message is None else custom_message.message
            )
            try:
                decoded = decoder.decode(encode(message), format_encoding(type(message)))
            except WireError as error:
                pytest.fail(f"{key}: {describe_invalid_field(message) or error}")
            assert msgspec.to_builtins(decoded) == msgspec.to_builtins(message)
        assert all(
            math.isfinite(number)
            for name in JOINT_STATE_VECTORS[:3]
            for number in getattr(sample.joints, name)
        )


def test_every_sample_fits_the_robot(rig: BackendRig, healthy: RigRecord) -> None:
    """Every sample agrees with the description of the robot: links, joints, rotations, and the size of images."""
    for sample in healthy.samples:
        for key, message in sample.by_key.items():
            assert (mismatch := find_mismatch(message, rig.robot)) is None, f"{key}: {mismatch}"


def test_no_sample_contradicts_itself(healthy: RigRecord) -> None:
    """No sample contradicts itself, such as a camera or a lidar with a distance beyond its range."""
    for sample in healthy.samples:
        for key, message in sample.by_key.items():
            if isinstance(message, MountedSample):
                assert not (contradiction := message.find_contradiction()), (
                    f"{key}: {contradiction}"
                )


def test_every_joint_is_valid_and_fresh_at_every_tick(rig: BackendRig, healthy: RigRecord) -> None:
    """In normal operation all joints are valid, and no reading is older than a period besides the stated delay."""
    delay_s = next(sensor.delay_s for sensor in rig.robot.sensors if sensor.key == keys.JOINTS)
    max_age_ns = tolerances.MAX_READING_AGE_PERIODS * rig.period_ns + delay_s * 1e9
    for joints in healthy.joints:
        assert all(joints.valid), f"not all joints are valid in tick {joints.tick}: {joints.valid}"
        assert max(joints.age_ns) <= max_age_ns, (
            f"the joint state is too old in tick {joints.tick}: {joints.age_ns} ns"
        )


def test_what_is_not_known_yet_is_not_reported_as_valid(rig: BackendRig) -> None:
    """In the very first sample, the angle of each joint is the same as afterwards, or it is not valid."""
    for i, valid in enumerate(rig.first_sample.joints.valid):
        deviation_rad = rig.first_sample.joints.angle_rad[i] - rig.home_rad[i]
        assert not valid or abs(deviation_rad) < tolerances.STANDSTILL_RAD, (
            f"the first angle of joint {i} is valid, but has an error of {deviation_rad:+.3f} rad"
        )


def test_readings_follow_the_motion(healthy: RigRecord) -> None:
    """While the robot moves, no joint reports one old reading for long as if it were new."""
    angles = np.round(healthy.angle_rad, 6)
    for i in range(angles.shape[1]):
        distinct_count = len(np.unique(angles[:, i]))
        assert distinct_count > len(angles) // 3, (
            f"joint {i}: only {distinct_count} different readings in {len(angles)} ticks"
        )


def test_supply_and_temperatures_are_in_volts_and_degrees(bench: Bench, rig: BackendRig) -> None:
    """Reported voltages are near that of the robot file, and reported temperatures are those of a cool motor."""
    power = wait_for_power_sample(rig)
    for i, joint in enumerate(bench.config.robot.joint_table):
        name = rig.robot.joints[i].name
        if "voltage" in rig.robot.joints[i].measures:
            assert power.valid[i], f"{name} has not reported its supply"
            relative_difference = abs(power.voltage_v[i] / joint.supply.voltage_v - 1)
            assert relative_difference <= tolerances.SUPPLY_TOLERANCE_FRACTION, (
                f"{name} reports {power.voltage_v[i]} V with a supply of {joint.supply.voltage_v:g} V"
            )
        if "temperature" in rig.robot.joints[i].measures:
            for temperature_c in (power.motor_c[i], power.board_c[i]):
                limit_c = rig.robot.joints[i].derate_from_c
                assert tolerances.MIN_TEMPERATURE_C < temperature_c < limit_c, (
                    f"{name} reports {temperature_c} °C, although it has not worked yet"
                )


def test_a_sagging_supply_is_reported_at_its_joint(rig: BackendRig) -> None:
    """If the supply of one drive sags, its reported voltage drops, and the robot is stopped by a fault."""
    if "voltage" not in rig.robot.joints[1].measures:
        pytest.skip(f"{rig.robot.joints[1].name} does not measure its supply")
    before_v = wait_for_power_sample(rig).voltage_v
    inject_or_skip(rig, "undervoltage:joint_2@0-9")
    rig.must_reopen = True
    sagging_v = wait_for_power_sample(rig).voltage_v
    assert before_v[1] - sagging_v[1] > tolerances.MIN_SUPPLY_SAG_V, (
        f"the supply sags from {before_v[1]} V, but the report is {sagging_v[1]} V"
    )
    assert rig.authority.state == "fault", (
        "the robot may be armed, although a supply is below `min_voltage_v`"
    )


def wait_for_power_sample(rig: BackendRig) -> Power:
    """Wait until every drive had time for a report, and return the newest power sample.

    The test is skipped if the robot has no power sensor.
    """
    if not any(sensor.key == keys.POWER for sensor in rig.robot.sensors):
        pytest.skip("this robot has no power sensor")
    record = rig.wait_periods(rig.count_periods(tolerances.POWER_REPORT_TIME_S))
    samples = [
        sample.by_key[keys.POWER] for sample in record.samples if keys.POWER in sample.by_key
    ]
    assert samples, f"the backend sent no power sample in {tolerances.POWER_REPORT_TIME_S} s"
    newest = samples[-1]
    assert isinstance(newest, Power)
    return newest
