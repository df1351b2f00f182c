"""Encodes every message of the ROS bridge, reads it as a ROS node does, and compares it field by field."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from snakesim_hal.wire import messages as m
from snakesim_hal.wire.custom_sample import make_message_schema, parse_custom_message
from snakesim_operator.features.ros2 import messages as ros
from snakesim_operator.features.ros2 import robot_in_ros
from snakesim_operator.features.ros2.graph import RosType
from snakesim_operator.features.ros2.messages import RosMarker, RosTransform
from snakesim_operator.features.ros2.steering import CmdVelSteering
from snakesim_testing.hal.custom_sample import MOUNTING, VALID_VALUES, SkinSample
from snakesim_testing.hal.strategies import make_strategy
from snakesim_testing.hypothesis_profiles import choose_trial_count

JAZZY = get_typestore(Stores.ROS2_JAZZY)
MAX_ROS_TIME_S = 2**31  # ROS stores seconds in a signed number of 32 bits
STAMP_NS = 12_345_678_901
DEPTH_HEADER_BYTES = 12  # compressed_depth_image_transport places them before the PNG
FEW_EXAMPLES = settings(max_examples=choose_trial_count(25))


def read_message(ros_type: RosType, payload: bytes) -> Any:
    """Deserialize a message as a ROS node does."""
    return JAZZY.deserialize_cdr(payload, ros_type.name)


def convert_to_ns(stamp: Any) -> int:
    """Convert the time of a ROS header to ns."""
    return stamp.sec * 10**9 + stamp.nanosec


@pytest.mark.parametrize("store", [Stores.ROS2_KILTED, Stores.ROS2_LYRICAL])
def test_ros_type_hashes_equal_those_of_later_distributions(store: Stores) -> None:
    for ros_type in vars(ros).values():
        if isinstance(ros_type, ros.RosType):
            assert get_typestore(store).hash_rihs01(ros_type.name) == ros_type.type_hash


@FEW_EXAMPLES
@given(make_strategy(m.JointState))
def test_ros_joint_states_omit_invalid_joints(joints: m.JointState) -> None:
    count = min(map(len, (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, joints.valid)))
    joints = m.JointState(
        tick=0,
        timestamp_ns=0,
        angle_rad=joints.angle_rad[:count],
        velocity_rad_s=joints.velocity_rad_s[:count],
        torque_nm=joints.torque_nm[:count],
        valid=joints.valid[:count],
        age_ns=[0] * count,
    )
    names = [f"jöint_{'x' * i}{i}" for i in range(count)]
    message = read_message(
        ros.JOINT_STATE, robot_in_ros.encode_joint_state(STAMP_NS, names, joints)
    )
    is_valid = np.array(joints.valid, dtype=bool)
    assert convert_to_ns(message.header.stamp) == STAMP_NS
    assert message.header.frame_id == ""
    assert message.name == [name for name, valid in zip(names, joints.valid, strict=True) if valid]
    for field, ros_field in (
        ("angle_rad", "position"),
        ("velocity_rad_s", "velocity"),
        ("torque_nm", "effort"),
    ):
        valid_values = np.array(getattr(joints, field), dtype=float)[is_valid]
        assert np.array_equal(getattr(message, ros_field), valid_values)


def test_ros_transforms_match_kinematics() -> None:
    transforms = [
        RosTransform("odom", "base_link", (1, 2, 3), (0.5, 0.1, 0.2, 0.3)),
        RosTransform("a", "bc", (4, 5, 6), (1, 0, 0, 0)),
    ]
    messages = read_message(ros.TRANSFORMS, ros.encode_transforms(STAMP_NS, transforms)).transforms
    for transform, message in zip(transforms, messages, strict=True):
        position = message.transform.translation
        rotation = message.transform.rotation
        assert message.header.frame_id == transform.parent
        assert message.child_frame_id == transform.child
        assert convert_to_ns(message.header.stamp) == STAMP_NS
        assert (position.x, position.y, position.z) == transform.position_m
        assert (rotation.w, rotation.x, rotation.y, rotation.z) == transform.orientation_wxyz


@FEW_EXAMPLES
@given(st.lists(make_strategy(m.WorldContact), max_size=3))
def test_ros_contact_markers_are_arrows_along_forces(contacts: list[m.WorldContact]) -> None:
    payload = ros.encode_markers(STAMP_NS, "odom", robot_in_ros.make_contact_markers(contacts))
    first, *arrows = read_message(ros.MARKERS, payload).markers
    assert first.action == ros.DELETE_ALL
    for number, (contact, arrow) in enumerate(zip(contacts, arrows, strict=True)):
        assert arrow.id == number
        assert arrow.type == ros.ARROW
        assert arrow.action == ros.ADD
        assert arrow.ns == "contacts"
        assert arrow.header.frame_id == "odom"
        assert convert_to_ns(arrow.header.stamp) == STAMP_NS
        tail, tip = (np.array([point.x, point.y, point.z]) for point in arrow.points)
        assert np.array_equal(tail, contact.position_w)
        assert np.allclose(tip - tail, 0.01 * np.array(contact.force_w), rtol=1e-6, atol=1e-6)


def read_obstacle_markers() -> list[Any]:
    """Return the ROS markers of a cylinder of confidence 0.5, a box turned by 90 degrees, and a touched sphere."""
    quarter_turn_rad = np.pi / 2
    obstacles = [
        m.KnownObstacle(
            name="c",
            shape="cylinder",
            position_w=(1, 2, 0.1),
            radius_m=0.05,
            height_m=0.2,
            confidence=0.5,
        ),
        m.KnownObstacle(
            name="b",
            shape="box",
            position_w=(3, 4, 0.1),
            yaw_rad=quarter_turn_rad,
            half_size_m=(0.1, 0.2, 0.3),
        ),
        m.KnownObstacle(
            name="s", shape="sphere", position_w=(5, 6, 0.1), radius_m=0.07, touched=True
        ),
    ]
    world = m.WorldModel(
        tick=1,
        timestamp_ns=1,
        base_position_w=(0, 0, 0),
        base_orientation_wxyz=(1, 0, 0, 0),
        base_confidence=1,
        contacts=[],
        obstacles=obstacles,
    )
    markers = robot_in_ros.make_obstacle_markers(world)
    _, *shapes = read_message(ros.MARKERS, ros.encode_markers(STAMP_NS, "odom", markers)).markers
    return shapes


def test_ros_obstacle_markers_have_shape_size_and_pose() -> None:
    markers = read_obstacle_markers()
    assert [marker.type for marker in markers] == [ros.CYLINDER, ros.CUBE, ros.SPHERE]
    sizes_m = [(marker.scale.x, marker.scale.y, marker.scale.z) for marker in markers]
    assert sizes_m == [(0.1, 0.1, 0.2), (0.2, 0.4, 0.6), (0.14, 0.14, 0.14)]
    assert [(marker.pose.position.x, marker.pose.position.y) for marker in markers] == [
        (1, 2),
        (3, 4),
        (5, 6),
    ]
    box_orientation = markers[1].pose.orientation
    assert box_orientation.z == pytest.approx(np.sqrt(0.5))
    assert box_orientation.x == 0


def test_ros_obstacle_marker_of_uncertain_obstacle_is_translucent() -> None:
    cylinder, _, _ = read_obstacle_markers()
    assert cylinder.color.a == pytest.approx(0.6)  # of confidence 0.5


def test_ros_obstacle_marker_of_touched_obstacle_is_redder() -> None:
    _, box, sphere = read_obstacle_markers()
    assert sphere.color.r > box.color.r


IMAGE_FIELDS: dict[str, Any] = {
    "tick": 0,
    "timestamp_ns": 0,
    "link": 1,
    "position_l": (0.1, 0, 0),
    "orientation_l_wxyz": (1, 0, 0, 0),
    "width": 4,
    "height": 3,
    "fx_px": 80.0,
    "fy_px": 81.0,
    "cx_px": 1.5,
    "cy_px": 1.0,
}


def make_depth_image(scale_m: float = 0.001) -> m.DepthImage:
    """Make a depth image of 4 by 3 pixels with the counts 0 to 11."""
    return m.DepthImage(
        **IMAGE_FIELDS,
        range_min_m=0.05,
        range_max_m=4.0,
        scale_m=scale_m,
        depth=np.arange(12, dtype="<u2").tobytes(),
    )


def make_color_image() -> m.ColorImage:
    """Make a color image of 4 by 3 pixels with the values 0 to 35."""
    return m.ColorImage(**IMAGE_FIELDS, rgb=bytes(range(36)))


def test_ros_depth_image_with_1_mm_scale_is_sent_unchanged() -> None:
    frame_id = "head_depth_optical_frame"
    payload = robot_in_ros.encode_depth_image(STAMP_NS, frame_id, make_depth_image())
    message = read_message(ros.IMAGE, payload)
    assert message.header.frame_id == frame_id
    assert convert_to_ns(message.header.stamp) == STAMP_NS
    assert (message.width, message.height) == (4, 3)
    assert message.encoding == "16UC1"
    assert message.is_bigendian == 0
    assert message.step == 4 * 2  # bytes in a row of 4 pixels
    assert np.array_equal(message.data.tobytes(), np.arange(12, dtype="<u2").tobytes())


def test_ros_depth_image_with_other_scale_is_sent_in_meters() -> None:
    coarse = make_depth_image(scale_m=0.01)
    message = read_message(ros.IMAGE, robot_in_ros.encode_depth_image(STAMP_NS, "f", coarse))
    assert message.encoding == "32FC1"
    assert message.step == 4 * 4  # bytes in a row of 4 pixels
    depth_m = np.frombuffer(message.data.tobytes(), "<f4")
    assert np.isnan(depth_m[0])  # count 0: not measured
    assert np.allclose(depth_m[1:], 0.01 * np.arange(1, 12))


def test_ros_color_image_has_intrinsics() -> None:
    image = make_color_image()
    message = read_message(ros.IMAGE, robot_in_ros.encode_color_image(STAMP_NS, "f", image))
    assert message.encoding == "rgb8"
    assert message.step == 12
    assert message.data.tobytes() == image.rgb
    info = read_message(ros.CAMERA_INFO, robot_in_ros.encode_camera_info(STAMP_NS, "f", image))
    assert info.width == 4
    assert info.height == 3
    assert info.distortion_model == "plumb_bob"
    assert info.k.tolist() == [80, 0, 1.5, 0, 81, 1, 0, 0, 1]
    assert info.p.tolist() == [80, 0, 1.5, 0, 0, 81, 1, 0, 0, 0, 1, 0]
    assert info.r.tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert info.d.tolist() == [0] * 5


def test_ros_compressed_images_are_png_with_the_same_pixels() -> None:
    color = make_color_image()
    payload = robot_in_ros.encode_compressed_color(STAMP_NS, "f", color)
    message = read_message(ros.COMPRESSED_IMAGE, payload)
    assert message.format == "rgb8; png compressed bgr8"
    assert np.asarray(Image.open(BytesIO(message.data.tobytes()))).tobytes() == color.rgb
    for scale_m in (0.001, 0.01):
        payload = robot_in_ros.encode_compressed_depth(STAMP_NS, "f", make_depth_image(scale_m))
        message = read_message(ros.COMPRESSED_IMAGE, payload)
        assert message.format == "16UC1; compressedDepth png"
        assert message.header.frame_id == "f"
        png = message.data.tobytes()[DEPTH_HEADER_BYTES:]
        depth_mm = np.asarray(Image.open(BytesIO(png)))
        assert np.array_equal(depth_mm, np.arange(12).reshape(3, 4) * round(scale_m / 0.001))


def read_imu_of_link_5() -> Any:
    """Return the ROS message of the second of two IMUs."""
    sample = m.Imu(
        tick=0,
        timestamp_ns=0,
        link=[3, 5],
        angular_velocity_rad_s=[(0, 0, 0), (1, 2, 3)],
        acceleration_m_s2=[(0, 0, 0), (4, 5, 6)],
    )
    return read_message(ros.IMU, robot_in_ros.encode_imu(STAMP_NS, "link_5_imu_frame", sample, 1))


def test_ros_imu_message_has_rates_and_acceleration_of_its_link() -> None:
    message = read_imu_of_link_5()
    rate = message.angular_velocity
    acceleration = message.linear_acceleration
    assert convert_to_ns(message.header.stamp) == STAMP_NS
    assert message.header.frame_id == "link_5_imu_frame"
    assert (rate.x, rate.y, rate.z) == (1, 2, 3)
    assert (acceleration.x, acceleration.y, acceleration.z) == (4, 5, 6)


def test_ros_imu_message_marks_orientation_as_missing() -> None:
    message = read_imu_of_link_5()
    assert message.orientation_covariance[0] == -1  # ROS: the orientation is not measured
    assert message.linear_acceleration_covariance.tolist() == [0] * 9  # ROS: unknown


@FEW_EXAMPLES
@given(make_strategy(m.RangeScan))
def test_ros_scan_contains_the_ranges(scan: m.RangeScan) -> None:
    message = read_message(ros.LASER_SCAN, robot_in_ros.encode_laser_scan(STAMP_NS, "f", scan))
    expected = [np.inf if range_m is None else np.float32(range_m) for range_m in scan.range_m]
    assert message.ranges.tolist() == expected
    assert message.intensities.size == 0
    assert message.angle_min == np.float32(scan.angle_min_rad)
    assert message.angle_increment == np.float32(scan.angle_step_rad)
    angle_max_rad = scan.angle_min_rad + scan.angle_step_rad * (len(expected) - 1)
    assert message.angle_max == np.float32(angle_max_rad)
    assert message.range_min == np.float32(scan.range_min_m)
    assert message.range_max == np.float32(scan.range_max_m)


def test_custom_sensor_numbers_have_field_and_unit() -> None:
    custom_type = parse_custom_message(make_message_schema(SkinSample, "skin"))
    sample: Any = custom_type.message(**MOUNTING, **VALID_VALUES)
    payload = robot_in_ros.encode_numbers(custom_type, "pressed_n", STAMP_NS, "f", sample)
    message = read_message(ros.FLOAT64_ARRAY, payload)
    assert message.data.tolist() == pytest.approx([1.5, np.nan], nan_ok=True)
    (dimension,) = message.layout.dim
    assert dimension.label == "pressed_n [N]"
    assert dimension.size == 2


@FEW_EXAMPLES
@given(make_strategy(m.RobotStatus))
def test_ros_diagnostics_contain_the_status(status: m.RobotStatus) -> None:
    payload = robot_in_ros.encode_diagnostics(STAMP_NS, status)
    (message,) = read_message(ros.DIAGNOSTICS, payload).status
    assert (message.level == robot_in_ros.ERROR) == (status.lifecycle in ("fault", "estop"))
    assert message.name == status.robot
    assert message.message == f"{status.lifecycle}: {status.reason}"
    assert {"lifecycle", "backend", "lease holder"} <= {value.key for value in message.values}


@given(st.integers(0, 2**62))
def test_ros_clock_equals_robot_time_below_its_maximum(timestamp_ns: int) -> None:
    clock = read_message(ros.CLOCK, ros.encode_clock(timestamp_ns)).clock
    assert convert_to_ns(clock) == timestamp_ns or timestamp_ns >= MAX_ROS_TIME_S * 10**9


def test_ros_text_is_unicode_and_marker_has_defaults() -> None:
    assert (
        read_message(ros.STRING, ros.encode_string("<robot>ä</robot>")).data == "<robot>ä</robot>"
    )
    cube = RosMarker("n", ros.CUBE, (1, 2, 3), (1, 0, 0, 1))
    (_, marker) = read_message(ros.MARKERS, ros.encode_markers(0, "map", [cube])).markers
    defaults = (marker.lifetime.sec, marker.frame_locked, marker.text, marker.mesh_resource)
    assert defaults == (0, False, "", "")


class TestSteering:
    """The steering intents that follow from Twist messages of a ROS node."""

    def serialize_twist(self, speed_m_s: float = 0.0, turn_rad_s: float = 0.0) -> bytes:
        """Serialize a Twist message with the library rosbags."""
        twist_type: Any = JAZZY.types["geometry_msgs/msg/Twist"]
        vector_type: Any = JAZZY.types["geometry_msgs/msg/Vector3"]
        twist = twist_type(vector_type(speed_m_s, 0.0, 0.0), vector_type(0.0, 0.0, turn_rad_s))
        return bytes(JAZZY.serialize_cdr(twist, ros.TWIST.name))

    def test_ros_twist_gives_speed_and_direction(self) -> None:
        steering = CmdVelSteering()
        first = steering.make_intent(self.serialize_twist(0.2, 1.0), 10**9, 0.5)
        assert first is not None
        assert (first.speed_m_s, first.heading_w_rad, first.go, first.valid_for_ns) == (
            0.2,
            0.5,
            True,
            500_000_000,
        )
        later = steering.make_intent(self.serialize_twist(0.2, 1.0), 1_100_000_000, 0.5)
        assert later is not None
        assert later.heading_w_rad == pytest.approx(0.6)
        without_turn = steering.make_intent(self.serialize_twist(0.2), 1_200_000_000, 0.55)
        assert without_turn is not None
        assert without_turn.heading_w_rad == pytest.approx(0.6)

    def test_ros_zero_twist_stops(self) -> None:
        stop = CmdVelSteering().make_intent(self.serialize_twist(), 1, None)
        assert stop is not None
        assert not stop.go
        assert stop.heading_w_rad is None

    def test_ros_twist_expires_by_age_but_stop_never(self) -> None:
        steering = CmdVelSteering()
        fresh = steering.make_intent(self.serialize_twist(0.2), 2 * 10**9, None, age_ns=400_000_000)
        assert fresh is not None
        assert fresh.timestamp_ns == 1_600_000_000
        assert fresh.valid_for_ns == 500_000_000
        assert (
            steering.make_intent(self.serialize_twist(0.2), 2 * 10**9, None, age_ns=600_000_000)
            is None
        )
        assert steering.rejected_count == 1
        assert steering.reason == "is older than 0.5 s by the times of its sender's messages"
        stop = steering.make_intent(self.serialize_twist(), 2 * 10**9, None, age_ns=60 * 10**9)
        assert stop is not None
        assert not stop.go
        assert stop.timestamp_ns == 2 * 10**9

    def test_ros_twist_direction_stays_near_the_body(self) -> None:
        steering = CmdVelSteering()
        for i in range(200):
            intent = steering.make_intent(self.serialize_twist(0.1, 2.0), i * 100_000_000, 3.0)
            assert intent is not None
            assert intent.heading_w_rad is not None
            assert abs(intent.heading_w_rad - 3.0) <= np.pi / 2 + 1e-9

    def test_ros_twist_after_silence_starts_from_body_direction(self) -> None:
        steering = CmdVelSteering()
        steering.make_intent(self.serialize_twist(0.1), 0, 1.0)
        restarted = steering.make_intent(self.serialize_twist(0.1, 1.0), 10**10, 2.0)
        assert restarted is not None
        assert restarted.heading_w_rad == 2.0

    @pytest.mark.parametrize("payload", [b"", b"\0\1\0\0", b"\0\7\0\0" + bytes(48)])
    def test_ros_twist_with_invalid_payload_is_counted(self, payload: bytes) -> None:
        steering = CmdVelSteering()
        assert steering.make_intent(payload, 0, 0.0) is None
        assert steering.rejected_count == 1

    @pytest.mark.parametrize(
        ("speed_m_s", "turn_rad_s"), [(np.nan, 0.0), (0.0, np.inf), (11.0, 0.0), (0.0, -11.0)]
    )
    def test_ros_twist_impossible_for_a_snake_is_rejected(
        self, speed_m_s: float, turn_rad_s: float
    ) -> None:
        steering = CmdVelSteering()
        assert steering.make_intent(self.serialize_twist(speed_m_s, turn_rad_s), 0, 0.0) is None
        assert steering.rejected_count == 1
