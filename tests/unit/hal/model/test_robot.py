"""The description of a robot has the values of its robot file."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import decode_table, list_shipped_names, read_table_with_base
from snakesim_hal.model.robot_file.joints import (
    JointDrive,
    JointExceptions,
    JointMotor,
    JointSupply,
    MotionLimits,
    MotorHeat,
)
from snakesim_hal.model.robot_file.robot import RobotFile, compute_layout_hash, describe_robot
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import JointMode, RobotDescription
from snakesim_testing.hal.small_robots import (
    LEASE_NS,
    PERIOD_NS,
    ROBOT,
    make_description,
    make_robot_file,
)
from snakesim_testing.messages import raises_error

SECTIONS = ("limits", "motor", "drive", "heat", "supply")


@pytest.mark.parametrize("name", list_shipped_names("robots"))
def test_robot_description_of_shipped_robot_can_be_published(name: str) -> None:
    robot = decode_table(read_table_with_base(name, "robots"), RobotFile)
    description = describe_robot(
        robot, backend="sim", period_ns=PERIOD_NS, lease_ns=LEASE_NS, config_hash="0"
    )
    assert (
        MessageDecoder(RobotDescription).decode(
            encode(description), format_encoding(RobotDescription)
        )
        == description
    )
    assert len(description.joints) == robot.chain.modules == len(description.links) - 1
    for joint in description.joints:
        assert joint.angle_min_rad < 0 < joint.angle_max_rad
        assert min(joint.speed_limit_rad_s, joint.torque_limit_nm, joint.stiffness_nm_per_rad) > 0


@given(
    modules=st.integers(1, 40),
    axes=st.lists(st.sampled_from(["yaw", "pitch"]), min_size=1, max_size=5),
    length_m=st.floats(0.01, 2),
)
def test_robot_links_have_length_and_mass_of_all_modules(
    modules: int, axes: list[str], length_m: float
) -> None:
    robot = make_robot_file(chain={"modules": modules, "axes": axes}, module__length_m=length_m)
    assert (
        sum(robot.link_lengths_m)
        == pytest.approx(modules * length_m)
        == pytest.approx(robot.length_m)
    )
    assert sum(robot.link_masses_kg) == pytest.approx(modules * robot.module.mass_kg)
    assert robot.link_lengths_m[0] == robot.link_lengths_m[-1] == 0.5 * length_m
    assert robot.axes == [axes[i % len(axes)] for i in range(modules)]


def test_robot_description_has_the_values_of_its_file() -> None:
    description = make_description(chain__axes=["yaw", "pitch"])
    assert [joint.name for joint in description.joints] == ["joint_1", "joint_2", "joint_3"]
    assert [joint.axis for joint in description.joints] == ["yaw", "pitch", "yaw"]
    joint = description.joints[1]
    limits = ROBOT["limits"]
    motor = ROBOT["motor"]
    assert joint.angle_min_rad == -limits["angle_rad"]
    assert joint.angle_max_rad == limits["angle_rad"]
    assert joint.speed_limit_rad_s == limits["speed_rad_s"]
    assert joint.acceleration_limit_rad_s2 == limits["acceleration_rad_s2"]
    assert joint.torque_limit_nm == limits["torque_nm"]
    assert joint.torque_rate_limit_nm_s == limits["torque_rate_nm_s"]
    assert joint.stiffness_nm_per_rad == motor["stiffness_nm_per_rad"]
    assert joint.damping_nm_s_per_rad == motor["damping_nm_s_per_rad"]
    assert description.stop_mode == "damp"
    assert description.max_step_rad == 0.3


def test_robot_joint_exception_is_allowed_for_every_section_field() -> None:
    exceptions = {
        "id": 17, "sign": -1, "zero_rad": 0.3, "gear": 2.0, "port": "can1", "driver": "odrive",
        "angle_min_rad": -0.4, "angle_max_rad": 1.2, "speed_rad_s": 2.0, "torque_nm": 3.0, "derate_from_c": 60.0,
        "armature_kg_m2": 0.02, "torque_constant_nm_per_a": 0.08, "rated_nm": 1.0, "peak_nm": 3.5, "voltage_v": 25.2,
        "rise_at_rated_k": 90.0,
    }  # fmt: skip
    robot = make_robot_file(
        joints={"joint_2": exceptions}, drive__gear=9.0, limits__angle_max_rad=1.0
    )
    first, second, third = robot.joint_table
    for field, value in exceptions.items():
        owners = [
            owner
            for owner in (second, *(getattr(second, section) for section in SECTIONS))
            if hasattr(owner, field)
        ]
        assert {getattr(owner, field) for owner in owners} == {value}, field
    assert first.id == 1
    assert third.id == 3
    assert first.drive.gear == 9.0
    assert first.supply.voltage_v == 24.0
    assert (
        (first.limits.lower_rad, first.limits.upper_rad)
        == (-1.5, 1.0)
        == (third.limits.lower_rad, 1.0)
    )
    joints = make_description(joints={"joint_2": exceptions}, limits__angle_max_rad=1.0).joints
    assert [(joint.angle_min_rad, joint.angle_max_rad) for joint in joints] == [
        (-1.5, 1.0),
        (-0.4, 1.2),
        (-1.5, 1.0),
    ]
    assert [joint.torque_limit_nm for joint in joints] == [4.0, 3.0, 4.0]
    assert [joint.speed_limit_rad_s for joint in joints] == [5.0, 2.0, 5.0]
    assert [joint.derate_from_c for joint in joints] == [80.0, 60.0, 80.0]
    joint_limits = (
        make_robot_file(joints={"joint_2": {"angle_rad": 0.2}}, limits__angle_max_rad=1.0)
        .joint_table[1]
        .limits
    )
    assert (joint_limits.lower_rad, joint_limits.upper_rad) == (-0.2, 0.2), (
        "`angle_rad` sets both sides, although other joints have a maximum of their own"
    )


def test_robot_description_has_modes_and_measurements_of_each_joint() -> None:
    exceptions = {"joint_2": {"modes": ["torque", "position"], "measures": ["torque"]}}
    first, second, third = make_description(
        drive__modes=["position"], drive__measures=[], joints=exceptions
    ).joints
    assert first.modes == third.modes == [JointMode.PASSIVE, JointMode.POSITION]
    assert first.measures == []
    assert second.modes == [JointMode.PASSIVE, JointMode.POSITION, JointMode.TORQUE]
    assert second.measures == ["torque"]
    assert make_description().joints[0].modes == list(JointMode), (
        "a joint without `modes` has all modes"
    )
    assert make_description().joints[0].measures == ["torque", "temperature", "voltage"]


def test_robot_every_section_field_has_a_joint_field() -> None:
    section_fields = {
        field
        for section in (MotionLimits, JointMotor, JointDrive, MotorHeat, JointSupply)
        for field in section.__struct_fields__
    }
    assert section_fields - set(JointExceptions.__struct_fields__) == {"ambient_c"}, (
        "the temperature of the water is the same for all joints"
    )


def test_robot_description_lists_only_its_sensors_within_loop_rate() -> None:
    assert [sensor.key for sensor in make_description().sensors] == [keys.JOINTS]
    description = make_description(
        sensors={
            "contacts": {"rate_hz": 1000.0},
            "imu": {"rate_hz": 20.0, "delay_s": 0.1},
            "pose": {},
        }
    )
    rates = {sensor.key: sensor.rate_hz for sensor in description.sensors}
    assert rates == {keys.JOINTS: 100.0, keys.CONTACTS: 100.0, keys.IMU: 20.0, keys.POSE: 100.0}
    assert {sensor.key: sensor.delay_s for sensor in description.sensors}[keys.IMU] == 0.1


def test_robot_cameras_and_lidars_are_named_and_one_period_late() -> None:
    depth_cameras = [
        {"name": "head", "delay_s": 0.0, "color": True},
        {"name": "back", "link": 2, "position_m": [0.0, 0.0, 0.1]},
    ]
    description = make_description(
        sensors={
            "depth": depth_cameras,
            "range": [{"name": "front", "rate_hz": 500.0, "delay_s": 0.04}],
        }
    )
    rates_and_delays = {
        sensor.key: (sensor.rate_hz, sensor.delay_s) for sensor in description.sensors
    }
    del rates_and_delays[keys.JOINTS]
    assert rates_and_delays == {
        keys.depth_key("head"): (20.0, 0.01),
        keys.color_key("head"): (20.0, 0.01),
        keys.depth_key("back"): (20.0, 0.03),
        keys.ranges_key("front"): (100.0, 0.04),
    }


def test_robot_file_may_extend_another_with_differences(tmp_path: Path) -> None:
    file = tmp_path / "worm.toml"
    file.write_text(
        'extends = "planar13"\nname = "worm"\n[limits]\ntorque_nm = 3.0\n[[sensors.range]]\nname = "front"\n'
    )
    table = read_table_with_base(str(file), "robots")
    base_robot = decode_table(read_table_with_base("planar13", "robots"), RobotFile)
    robot = decode_table(table, RobotFile)
    assert robot.name == "worm"
    assert robot.limits.torque_nm == 3.0
    assert robot.sensors.range[0].name == "front"
    assert robot.chain == base_robot.chain
    assert robot.sensors.imu == base_robot.sensors.imu
    assert table.find_origin("limits.torque_nm") == str(file)
    assert table.find_origin("limits.angle_rad").endswith("planar13.toml")
    second_file = tmp_path / "more.toml"
    second_file.write_text('extends = "./worm.toml"\nname = "more"')
    second_robot = decode_table(read_table_with_base(str(second_file), "robots"), RobotFile)
    assert second_robot.name == "more"
    assert second_robot.limits.torque_nm == 3.0
    assert second_robot.chain == base_robot.chain
    file.write_text('extends = "./more.toml"')
    with raises_error(ConfigError, code="config/conflict", field="extends"):
        read_table_with_base(str(second_file), "robots")
    file.write_text("extends = 13")
    with raises_error(ConfigError, code="config/invalid-value", field="extends", value=13):
        read_table_with_base(str(file), "robots")


def test_robot_layout_hash_differs_for_other_vector_layouts() -> None:
    three = make_description()
    four = make_description(chain__modules=4)
    mixed_axes = make_description(chain__axes=["yaw", "pitch"])
    swapped = list(reversed(three.joints))
    hashes = {
        compute_layout_hash(joints)
        for joints in (three.joints, four.joints, mixed_axes.joints, swapped)
    }
    assert len(hashes) == 4
    # Vectors of the same layout with other values.
    assert make_description(limits__torque_nm=1.0).layout == three.layout
