"""Types of services against hashes that others have, and joint commands against what no robot may be told."""

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
# From docs/design.md of ros2/rmw_zenoh.
ADDER = (
    "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
    "example_interfaces::srv::dds_::AddTwoInts_/"
    "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a/::,10:,:,:,,"
)


def test_a_service_of_the_design_document() -> None:
    two_ints = types.define_service(
        "example_interfaces/srv/AddTwoInts", "int64 a\nint64 b", "int64 sum"
    )
    topic = RosTopic("/add_two_ints", two_ints.type)
    zenoh_id = ADDER.split("/")[2]
    assert (
        make_token(2, zenoh_id, 10, graph.SERVER, NodeName("add_two_ints_server"), topic) == ADDER
    )


def test_hashes_are_those_that_others_have() -> None:
    ours = {
        one.type.name: one.type.type_hash
        for one in vars(types).values()
        if isinstance(one, types.RosService)
    }
    assert ours == {name: f"RIHS01_{digits}" for name, digits in SERVICE_HASHES.items()}


def test_an_answer_says_who_asked_what() -> None:
    gid = bytes(range(16))
    reply = graph.make_reply_attachment(graph.make_attachment(9, 1, gid))
    assert reply is not None
    assert reply[:8] == (9).to_bytes(8, "little")
    assert graph.make_reply_attachment(b"") is None
    assert graph.make_reply_attachment(graph.make_attachment(-1, 1, gid)) is None


@pytest.mark.parametrize("value", [True, 3, 0.5, "a", [1.0, 2.5], ["a", "b"], None])
def test_values_of_parameters_keep_their_type(value: Any) -> None:
    sent = _encode_value(value)
    kinds = {True: 1, 3: 2, 0.5: 3, "a": 4, None: 0}
    assert sent.type == (
        kinds[value] if not isinstance(value, list) else 8 if value[0] == 1.0 else 9
    )
    fields = (
        "bool_value",
        "integer_value",
        "double_value",
        "string_value",
        *[""] * 3,
        "double_array_value",
    )
    if sent.type not in (NOT_SET, 9):
        assert np.array_equal(getattr(sent, fields[sent.type - 1]), value)


def test_a_parameter_is_described_with_unit_and_range() -> None:
    lead = RobotParameter(
        "speed_kp_s", 0.2, unit="s", description="how far ahead", minimum=0.0, maximum=1.0
    )
    seen = _make_descriptor("control.speed_kp_s", lead)
    assert seen.description == "how far ahead [s]"
    assert seen.additional_constraints == ">= 0, <= 1"
    (span,) = seen.floating_point_range
    assert span.from_value == 0.0
    assert span.to_value == 1.0


class TestJointTargets:
    """What JointState messages become."""

    robot = describe_shipped_robot("planar13")

    def said(self, names: list[str], *, stamp_s: float = 0.0, **numbers: Any) -> bytes:
        kinds: Any = JAZZY.types
        fields = [
            np.array(numbers.get(word, []), dtype=np.float64)
            for word in ("position", "velocity", "effort")
        ]
        seconds, nanoseconds = divmod(round(stamp_s * 1e9), 10**9)
        header = kinds["std_msgs/msg/Header"](
            kinds["builtin_interfaces/msg/Time"](seconds, nanoseconds), ""
        )
        kind = "sensor_msgs/msg/JointState"
        return bytes(JAZZY.serialize_cdr(kinds[kind](header, names, *fields), kind))

    def clock(self, timestamp_ns: int, lifecycle: LifecycleState = "armed") -> Clock:
        return msgspec.structs.replace(
            rig.make_clock(1), arm_session=1, timestamp_ns=timestamp_ns, lifecycle=lifecycle
        )

    def joints(self, angle_rad: float) -> JointState:
        return rig.make_joint_state(self.robot, angle_rad)

    def test_named_joints_follow_and_the_others_stay(self) -> None:
        targets = RosJointTargets(self.robot)
        targets.make_setpoints(self.clock(0), self.joints(0.1))
        assert targets.accept_message(self.said(["joint_3"], position=[0.5]), 10)
        assert targets.accept_message(self.said(["joint_4"], effort=[-1.0]), 10)
        points = targets.make_setpoints(self.clock(20), self.joints(0.2))
        assert points.target[2] == 0.5
        assert points.mode[3] == JointMode.TORQUE
        assert points.target[3] == -1.0
        assert set(points.target[4:]) == {0.1}
        assert set(points.mode[4:]) == {JointMode.POSITION}  # where arming found them

    def test_ros_joint_commands_that_stop_hold_the_joint(self) -> None:
        targets = RosJointTargets(self.robot)
        targets.accept_message(self.said(["joint_3"], velocity=[1.0]), 0)
        targets.make_setpoints(self.clock(TARGET_LIFETIME_NS), self.joints(0.3))
        for angle_rad in (0.4, 0.45):
            points = targets.make_setpoints(
                self.clock(TARGET_LIFETIME_NS + 1), self.joints(angle_rad)
            )
        assert points.mode[2] == JointMode.POSITION
        assert points.target[2] == 0.4

    @pytest.mark.parametrize(
        ("stamp_s", "ros_now_s", "age_s", "why"),
        [
            (10.0, None, 3.0, ""),  # its stamp counts, and nothing else
            (9.4, None, 0.0, "is older than 0.5 s by the stamp of its header"),
            (10.2, None, 0.0, "is ahead of the time in ROS by the stamp of its header"),
            (1.7e9, 1.7e9 + 0.2, 0.0, ""),  # of a real robot: wall-clock time
            (1.7e9, 1.7e9 + 14.0, 0.0, "is older than 0.5 s"),
            (1.7e9, None, 0.0, "is ahead of the time in ROS"),  # a node without use_sim_time
            (0.0, None, 0.3, ""),  # no stamp
            (0.0, None, 14.0, "is older than 0.5 s by the times of its sender's messages"),
        ],
    )
    def test_an_old_message_moves_nothing(
        self, stamp_s: float, ros_now_s: float | None, age_s: float, why: str
    ) -> None:
        targets = RosJointTargets(self.robot)
        targets.make_setpoints(self.clock(0), self.joints(0.1))
        message, now_ns = self.said(["joint_3"], stamp_s=stamp_s, position=[0.5]), 10 * 10**9
        ros_now_ns = None if ros_now_s is None else round(ros_now_s * 1e9)
        taken = targets.accept_message(message, now_ns, ros_now_ns, round(age_s * 1e9))
        assert taken == (not why)
        assert why in targets.reason
        assert targets.make_setpoints(self.clock(now_ns + 1), self.joints(0.1)).target[2] == (
            0.1 if why else 0.5
        )

    def test_a_command_ends_half_a_second_after_it_was_sent(self) -> None:
        targets = RosJointTargets(self.robot)
        assert targets.accept_message(
            self.said(["joint_3"], position=[0.5]), 10**9, age_ns=400_000_000
        )
        assert targets.make_setpoints(self.clock(1_100_000_000), self.joints(0.1)).target[2] == 0.5
        assert targets.make_setpoints(self.clock(1_100_000_001), self.joints(0.1)).target[2] == 0.1

    def test_what_was_said_before_arming_moves_nothing(self) -> None:
        targets = RosJointTargets(self.robot)
        targets.accept_message(self.said(["joint_3"], position=[0.5]), 0)
        targets.make_setpoints(self.clock(1, "disarmed"), self.joints(0.1))
        assert targets.make_setpoints(self.clock(2), self.joints(0.1)).target[2] == 0.1

    @pytest.mark.parametrize(
        ("names", "numbers", "why"),
        [
            (["joint_99"], {"position": [0.1]}, "names 'joint_99'; planar13 has joint_1, joint_2"),
            (["joint_1", "joint_2"], {"position": [0.1]}, "has 1 numbers in position for 2 names"),
            (["joint_1", "joint_1"], {"effort": [0.1, 0.1]}, "must have one for each joint"),
            (["joint_1"], {"velocity": [np.nan]}, "has velocity nan for joint_1, must be finite"),
            (["joint_1"], {}, "has no position, velocity or effort"),
        ],
    )
    def test_a_message_is_taken_whole_or_not_at_all(
        self, names: list[str], numbers: dict[str, Any], why: str
    ) -> None:
        targets = RosJointTargets(self.robot)
        assert not targets.accept_message(self.said(names, **numbers), 0)
        assert targets.rejected_count == 1
        assert why in targets.reason
        assert not targets.accept_message(b"\0\1\0\0\1", 0)
        assert set(targets.make_setpoints(self.clock(1), self.joints(0.1)).target) == {0.1}
