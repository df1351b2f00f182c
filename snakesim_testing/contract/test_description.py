"""The description of the robot, readable before anything moves."""

from collections import Counter

import msgspec

from snakesim_hal.model.robot_file.robot import compute_layout_hash
from snakesim_hal.model.scenario import describe_run_robot
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.custom_sample import find_custom_messages
from snakesim_hal.wire.messages import Imu, RobotDescription
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import BackendRig, RigRecord


def test_the_description_matches_the_robot_file(bench: Bench, rig: BackendRig) -> None:
    """The description has the joints, links, period, lease and safety settings of the robot file and the scenario."""
    robot = rig.robot
    expected_robot = describe_run_robot(bench.config)
    assert [joint.name for joint in robot.joints] == [
        joint.name for joint in expected_robot.joints
    ], "names and order"
    for joint, expected in zip(robot.joints, expected_robot.joints, strict=True):
        # These are from the drive, not from the file.
        drive_fields = {
            "serial": joint.serial,
            "firmware": joint.firmware,
            "watchdog": joint.watchdog,
        }
        assert joint == msgspec.structs.replace(expected, **drive_fields)
    assert robot.links == expected_robot.links
    for name in (
        "robot",
        "config_hash",
        "period_ns",
        "lease_ns",
        "max_step_rad",
        "stop_mode",
        "custom",
    ):
        assert getattr(robot, name) == getattr(expected_robot, name), name


def test_the_layout_is_the_hash_of_the_joints(rig: BackendRig) -> None:
    """The layout is the hash of the joints, so that a command made for another order of joints is refused."""
    assert rig.robot.layout == compute_layout_hash(rig.robot.joints)


def test_the_description_is_readable_at_once_and_stays(
    bench: Bench, rig: BackendRig, healthy: RigRecord
) -> None:
    """The description is available before the first sample, when the rig reads it, and the same after a motion."""
    assert healthy.samples
    assert rig.backend.describe() == rig.robot


def test_the_description_survives_the_wire(rig: BackendRig) -> None:
    """The description is unchanged by the HAL's encoder and decoder, which check the bounds of its fields."""
    description = rig.robot
    assert (
        MessageDecoder(RobotDescription).decode(
            encode(description), format_encoding(RobotDescription)
        )
        == description
    )


def test_every_sensor_listed_is_a_key_of_the_hal_once(rig: BackendRig) -> None:
    """Every sensor is listed once, at a sensor key, with a rate up to the control rate; the joints are listed."""
    listed_keys = [sensor.key for sensor in rig.robot.sensors]
    assert len(set(listed_keys)) == len(listed_keys), (
        f"the description lists a sensor twice: {listed_keys}"
    )
    assert find_custom_messages(rig.robot).keys() == rig.robot.custom.keys(), (
        "the description has a schema in `custom` that fits no message"
    )
    assert keys.JOINTS in listed_keys
    for sensor in rig.robot.sensors:
        assert sensor.key.startswith("sensor/") and keys.find_message(sensor.key), sensor.key
        assert sensor.rate_hz <= 1.001e9 / rig.period_ns, (
            f"the rate of {sensor.key} is higher than the control rate"
        )


def test_every_sensor_listed_delivers_at_about_its_rate(
    rig: BackendRig, healthy: RigRecord
) -> None:
    """Every listed sensor delivers samples at about its stated rate."""
    duration_s = len(healthy.samples) * rig.period_ns * 1e-9
    for sensor in rig.robot.sensors:
        if sensor.key == keys.JOINTS:
            continue
        sample_count = count_readings(sensor.key, healthy)
        expected_count = duration_s * sensor.rate_hz
        tolerance = 1 + tolerances.RATE_TOLERANCE_FRACTION * expected_count
        assert sample_count >= 1 or expected_count < 2, (
            f"{sensor.key} is listed but never published"
        )
        assert abs(sample_count - expected_count) <= tolerance, (
            f"{sensor.key}: {sample_count} samples in {duration_s} s, but the description has {sensor.rate_hz} Hz"
        )


def count_readings(key: str, record: RigRecord) -> int:
    """Return the number of samples of a sensor in a record.

    IMUs may report in turns, so their number is that of the link with the most samples.
    """
    messages = [sample.by_key[key] for sample in record.samples if key in sample.by_key]
    links = Counter(
        link for message in messages if isinstance(message, Imu) for link in message.link
    )
    return max(links.values()) if links else len(messages)


def test_nothing_comes_that_is_not_listed(rig: BackendRig, healthy: RigRecord) -> None:
    """Every sample is at a key that the description lists, and has the message type of its key."""
    listed_keys = {sensor.key for sensor in rig.robot.sensors}
    for sample in healthy.samples:
        for key, message in sample.by_key.items():
            assert key in listed_keys, f"{key} is published but not listed"
            assert isinstance(message, keys.find_message(key) or ()), (
                f"{key} has messages of the wrong type {type(message).__name__}"
            )
