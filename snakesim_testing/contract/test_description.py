"""The description of the robot, readable before anything moves."""

from collections import Counter

import msgspec

from snakesim_hal.model.robot import layout_hash
from snakesim_hal.model.scenario import describe_run_robot
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, encode, format_encoding
from snakesim_hal.wire.custom_sample import find_custom_messages
from snakesim_hal.wire.messages import Description, Imu
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import Record, Rig


def test_the_description_matches_the_robot_file(bench: Bench, rig: Rig) -> None:
    """Joints (count, order, names, axes, limits, gains), links, period, lease and safety come from the run's files."""
    robot = rig.robot
    wanted = describe_run_robot(bench.config)
    assert [joint.name for joint in robot.joints] == [joint.name for joint in wanted.joints], "names and order"
    for joint, expected in zip(robot.joints, wanted.joints, strict=True):
        # These are from the drive, not from the file.
        drive = {"serial": joint.serial, "firmware": joint.firmware, "watchdog": joint.watchdog}
        assert joint == msgspec.structs.replace(expected, **drive)
    assert robot.links == wanted.links
    for name in ("robot", "config_hash", "period_ns", "lease_ns", "max_step_rad", "stop_mode", "custom"):
        assert getattr(robot, name) == getattr(wanted, name), name


def test_the_layout_is_the_hash_of_the_joints(rig: Rig) -> None:
    """Commands carry the layout, so that one made for another order of joints is refused."""
    assert rig.robot.layout == layout_hash(rig.robot.joints)


def test_the_description_is_readable_at_once_and_stays(bench: Bench, rig: Rig, healthy: Record) -> None:
    """It is available before the first sample (the rig has read it then), and the same after running."""
    assert healthy.samples
    assert rig.backend.describe() == rig.robot


def test_the_description_survives_the_wire(rig: Rig) -> None:
    """Encoded and decoded by the HAL's codec, with its bounds, it is the same."""
    description = rig.robot
    assert Decoder(Description).decode(encode(description), format_encoding(Description)) == description


def test_every_sensor_listed_is_a_key_of_the_hal_once(rig: Rig) -> None:
    """Sensors are at the sensor keys, with a rate up to the control rate; the joints are always listed."""
    listed = [sensor.key for sensor in rig.robot.sensors]
    assert len(set(listed)) == len(listed), f"listed twice: {listed}"
    assert find_custom_messages(rig.robot).keys() == rig.robot.custom.keys(), "a schema of `custom` fits no message"
    assert keys.JOINTS in listed
    for sensor in rig.robot.sensors:
        assert sensor.key.startswith("sensor/") and keys.find_message(sensor.key), sensor.key
        assert sensor.rate_hz <= 1.001e9 / rig.period_ns, f"{sensor.key}: faster than the control rate"


def test_every_sensor_listed_delivers_at_about_its_rate(rig: Rig, healthy: Record) -> None:
    """A listed sensor is published; an absent one is not listed."""
    seconds = len(healthy.samples) * rig.period_ns * 1e-9
    for sensor in rig.robot.sensors:
        if sensor.key == keys.JOINTS:
            continue
        came = count_readings(sensor.key, healthy)
        wanted = seconds * sensor.rate_hz
        slack = 1 + t.RATE_SHARE * wanted
        assert came >= 1 or wanted < 2, f"{sensor.key} is listed but never published"
        assert abs(came - wanted) <= slack, f"{sensor.key}: {came} in {seconds} s, stated are {sensor.rate_hz} Hz"


def count_readings(key: str, record: Record) -> int:
    """Number of readings. IMUs may answer in turns, so there it is that of the most frequent link."""
    messages = [sample.others[key] for sample in record.samples if key in sample.others]
    links = Counter(link for message in messages if isinstance(message, Imu) for link in message.link)
    return max(links.values()) if links else len(messages)


def test_nothing_comes_that_is_not_listed(rig: Rig, healthy: Record) -> None:
    """The description lists every key; and each key has its own message type."""
    listed = {sensor.key for sensor in rig.robot.sensors}
    for sample in healthy.samples:
        for key, message in sample.others.items():
            assert key in listed, f"{key} is published but not listed"
            assert isinstance(message, keys.find_message(key) or ()), f"{key}: {type(message).__name__}"
