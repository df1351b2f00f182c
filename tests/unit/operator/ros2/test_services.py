"""Types of ROS services against published hashes, and joint commands with invalid, stale and early messages."""

from typing import Any

import msgspec
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from snakesim_hal.wire.messages import Clock, JointMode, JointState, LifecycleState
from snakesim_operator.features.ros2 import graph
from snakesim_operator.features.ros2 import service_types as types
from snakesim_operator.features.ros2.graph import NodeName, RosTopic, make_token
from snakesim_operator.features.ros2.joint_commands import TARGET_LIFETIME_NS, RosJointTargets
from snakesim_operator.features.ros2.parameters import NOT_SET, _encode_value, _make_descriptor
from snakesim_operator.robot_commands.parameters import RobotParameter
from snakesim_testing.hal import small_robots as rig
from snakesim_testing.operator.ros2_robots import SERVICE_HASHES, describe_shipped_robot

JAZZY = get_typestore(Stores.ROS2_JAZZY)
# Constants of rcl_interfaces/msg/ParameterType.
DOUBLE_ARRAY = 8
STRING_ARRAY = 9
# From docs/design.md of ros2/rmw_zenoh.
ADDER_TOKEN = (
    "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
    "example_interfaces::srv::dds_::AddTwoInts_/"
    "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a/::,10:,:,:,,"
)


def test_ros_service_token_equals_that_of_the_design_document() -> None:
    two_ints = types.define_service(
        "example_interfaces/srv/AddTwoInts", "int64 a\nint64 b", "int64 sum"
    )
    topic = RosTopic("/add_two_ints", two_ints.type)
    zenoh_id = ADDER_TOKEN.split("/")[2]
    token = make_token(2, zenoh_id, 10, graph.SERVER, NodeName("add_two_ints_server"), topic)
    assert token == ADDER_TOKEN


def test_ros_service_hashes_equal_the_published_ones() -> None:
    hashes = {
        service.type.name: service.type.type_hash
        for service in vars(types).values()
        if isinstance(service, types.RosService)
    }
    assert hashes == {name: f"RIHS01_{digits}" for name, digits in SERVICE_HASHES.items()}


def test_ros_reply_attachment_names_request_or_is_none() -> None:
    gid = bytes(range(16))
    reply = graph.make_reply_attachment(graph.make_attachment(9, 1, gid))
    assert reply is not None
    assert reply[:8] == (9).to_bytes(8, "little")
    assert graph.make_reply_attachment(b"") is None
    assert graph.make_reply_attachment(graph.make_attachment(-1, 1, gid)) is None


@pytest.mark.parametrize("value", [True, 3, 0.5, "a", [1.0, 2.5], ["a", "b"], None])
def test_ros_parameter_value_keeps_its_type(value: Any) -> None:
    encoded = _encode_value(value)
    if isinstance(value, list):
        expected_type = DOUBLE_ARRAY if value[0] == 1.0 else STRING_ARRAY
    else:
        expected_type = {True: 1, 3: 2, 0.5: 3, "a": 4, None: 0}[value]
    assert encoded.type == expected_type
    fields = {
        1: "bool_value",
        2: "integer_value",
        3: "double_value",
        4: "string_value",
        DOUBLE_ARRAY: "double_array_value",
    }
    if encoded.type not in (NOT_SET, STRING_ARRAY):
        assert np.array_equal(getattr(encoded, fields[encoded.type]), value)


def test_ros_parameter_descriptor_has_unit_and_range() -> None:
    parameter = RobotParameter(
        "speed_kp_s", 0.2, unit="s", description="how far ahead", minimum=0.0, maximum=1.0
    )
    descriptor = _make_descriptor("control.speed_kp_s", parameter)
    assert descriptor.description == "how far ahead [s]"
    assert descriptor.additional_constraints == ">= 0, <= 1"
    (value_range,) = descriptor.floating_point_range
    assert value_range.from_value == 0.0
    assert value_range.to_value == 1.0


class TestJointTargets:
    """The setpoints that follow from JointState messages of a ROS node."""

    robot = describe_shipped_robot("planar13")

    def serialize_message(
        self, joint_names: list[str], *, stamp_s: float = 0.0, **numbers: Any
    ) -> bytes:
        """Serialize a JointState message with these positions, velocities and efforts."""
        ros_types: Any = JAZZY.types
        fields = [
            np.array(numbers.get(field, []), dtype=np.float64)
            for field in ("position", "velocity", "effort")
        ]
        seconds, nanoseconds = divmod(round(stamp_s * 1e9), 10**9)
        stamp = ros_types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
        header = ros_types["std_msgs/msg/Header"](stamp, "")
        type_name = "sensor_msgs/msg/JointState"
        message = ros_types[type_name](header, joint_names, *fields)
        return bytes(JAZZY.serialize_cdr(message, type_name))

    def make_clock(self, timestamp_ns: int, lifecycle: LifecycleState = "armed") -> Clock:
        """Make the clock of a host in this lifecycle state."""
        return msgspec.structs.replace(
            rig.make_clock(1), arm_session=1, timestamp_ns=timestamp_ns, lifecycle=lifecycle
        )

    def measure_joints(self, angle_rad: float) -> JointState:
        """Make measurements in which every joint has this angle."""
        return rig.make_joint_state(self.robot, angle_rad)

    def test_ros_joint_command_moves_named_joints_and_holds_others(self) -> None:
        targets = RosJointTargets(self.robot)
        targets.make_setpoints(self.make_clock(0), self.measure_joints(0.1))
        assert targets.accept_message(self.serialize_message(["joint_3"], position=[0.5]), 10)
        assert targets.accept_message(self.serialize_message(["joint_4"], effort=[-1.0]), 10)
        setpoints = targets.make_setpoints(self.make_clock(20), self.measure_joints(0.2))
        assert setpoints.target[2] == 0.5
        assert setpoints.mode[3] == JointMode.TORQUE
        assert setpoints.target[3] == -1.0
        # All other joints hold the angle that they had when the robot was armed.
        assert set(setpoints.target[4:]) == {0.1}
        assert set(setpoints.mode[4:]) == {JointMode.POSITION}

    def test_ros_joint_commands_that_stop_hold_the_joint(self) -> None:
        targets = RosJointTargets(self.robot)
        targets.accept_message(self.serialize_message(["joint_3"], velocity=[1.0]), 0)
        targets.make_setpoints(self.make_clock(TARGET_LIFETIME_NS), self.measure_joints(0.3))
        for angle_rad in (0.4, 0.45):
            setpoints = targets.make_setpoints(
                self.make_clock(TARGET_LIFETIME_NS + 1), self.measure_joints(angle_rad)
            )
        assert setpoints.mode[2] == JointMode.POSITION
        assert setpoints.target[2] == 0.4

    @pytest.mark.parametrize(
        ("stamp_s", "ros_now_s", "age_s", "reason"),
        [
            (10.0, None, 3.0, ""),  # only its stamp counts
            (9.4, None, 0.0, "is older than 0.5 s by the stamp of its header"),
            (10.2, None, 0.0, "is ahead of the time in ROS by the stamp of its header"),
            (1.7e9, 1.7e9 + 0.2, 0.0, ""),  # a real robot, with wall-clock time
            (1.7e9, 1.7e9 + 14.0, 0.0, "is older than 0.5 s"),
            (1.7e9, None, 0.0, "is ahead of the time in ROS"),  # a node without use_sim_time
            (0.0, None, 0.3, ""),  # no stamp
            (0.0, None, 14.0, "is older than 0.5 s by the times of its sender's messages"),
        ],
    )
    def test_ros_joint_command_too_old_or_early_moves_nothing(
        self, stamp_s: float, ros_now_s: float | None, age_s: float, reason: str
    ) -> None:
        targets = RosJointTargets(self.robot)
        targets.make_setpoints(self.make_clock(0), self.measure_joints(0.1))
        message = self.serialize_message(["joint_3"], stamp_s=stamp_s, position=[0.5])
        now_ns = 10 * 10**9
        ros_now_ns = None if ros_now_s is None else round(ros_now_s * 1e9)
        is_accepted = targets.accept_message(message, now_ns, ros_now_ns, round(age_s * 1e9))
        assert is_accepted == (not reason)
        assert reason in targets.reason
        setpoints = targets.make_setpoints(self.make_clock(now_ns + 1), self.measure_joints(0.1))
        assert setpoints.target[2] == (0.1 if reason else 0.5)

    def test_ros_joint_command_ends_half_a_second_after_sending(self) -> None:
        targets = RosJointTargets(self.robot)
        assert targets.accept_message(
            self.serialize_message(["joint_3"], position=[0.5]), 10**9, age_ns=400_000_000
        )
        measured = self.measure_joints(0.1)
        last_ns = 1_100_000_000  # received after 1 s at an age of 0.4 s, valid for 0.5 s
        assert targets.make_setpoints(self.make_clock(last_ns), measured).target[2] == 0.5
        assert targets.make_setpoints(self.make_clock(last_ns + 1), measured).target[2] == 0.1

    def test_ros_joint_command_before_arming_moves_nothing(self) -> None:
        targets = RosJointTargets(self.robot)
        targets.accept_message(self.serialize_message(["joint_3"], position=[0.5]), 0)
        targets.make_setpoints(self.make_clock(1, "disarmed"), self.measure_joints(0.1))
        assert targets.make_setpoints(self.make_clock(2), self.measure_joints(0.1)).target[2] == 0.1

    @pytest.mark.parametrize(
        ("joint_names", "numbers", "reason"),
        [
            (["joint_99"], {"position": [0.1]}, "names 'joint_99'; planar13 has joint_1, joint_2"),
            (["joint_1", "joint_2"], {"position": [0.1]}, "has 1 numbers in position for 2 names"),
            (["joint_1", "joint_1"], {"effort": [0.1, 0.1]}, "must have one for each joint"),
            (["joint_1"], {"velocity": [np.nan]}, "has velocity nan for joint_1, must be finite"),
            (["joint_1"], {}, "has no position, velocity or effort"),
        ],
    )
    def test_ros_joint_command_with_one_error_moves_no_joint(
        self, joint_names: list[str], numbers: dict[str, Any], reason: str
    ) -> None:
        targets = RosJointTargets(self.robot)
        assert not targets.accept_message(self.serialize_message(joint_names, **numbers), 0)
        assert targets.rejected_count == 1
        assert reason in targets.reason
        assert not targets.accept_message(b"\0\1\0\0\1", 0)
        setpoints = targets.make_setpoints(self.make_clock(1), self.measure_joints(0.1))
        assert set(setpoints.target) == {0.1}
