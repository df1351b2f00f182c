"""Joint states and transforms of a robot for Foxglove, in messages that are built once and filled for each sample."""

import math
import struct
from collections.abc import Iterable, Sequence
from itertools import chain, pairwise

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState as NamedJoint
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates

from snakesim_hal.wire.messages import JointState, RobotDescription
from snakesim_operator.recording.foxglove_messages import shapes

BasePose = tuple[Sequence[float], Sequence[float]]  # position (3,) in m and orientation wxyz (4,)
_NO_ROTATION = (1.0, 0.0, 0.0, 0.0)


class _JointStatesTemplate:
    """An encoded JointStates message in which only the floating-point values are replaced for each sample.

    Setting each field of a protobuf message takes ten times as long, and this happens for every sample.
    """

    def __init__(self, placeholder_message: JointStates) -> None:
        """Split an encoded message at its placeholder values, so that `encode_with_values` can replace them.

        Each field is found in the encoded bytes by its unique placeholder value, because protobuf does not tell the
        offset of a field.

        Args:
            placeholder_message: A message with a placeholder in every field to be replaced: 1.0, 2.0, 3.0 and so on,
                in the order of the fields.
        """
        remaining = placeholder_message.SerializeToString()
        placeholder = 1.0
        struct_format = "<"
        self._parts: list[bytes | float] = []  # alternating: the bytes before a value, the value
        while True:
            encoded_placeholder = struct.pack("<d", placeholder)
            position = remaining.find(encoded_placeholder)
            if position < 0:
                break
            self._parts += (remaining[:position], placeholder)
            struct_format += f"{position}sd"
            remaining = remaining[position + len(encoded_placeholder) :]
            placeholder += 1.0
        assert not remaining, "a number ends each joint"
        self._pack = struct.Struct(struct_format).pack
        self._timestamp_message = JointStates()

    def encode_with_values(self, values: Iterable[float], time_ns: int) -> bytes:
        """Return the encoded message with new values and a new timestamp.

        Args:
            values: One value for each placeholder, in the order of the placeholders.
            time_ns: Robot time of the values, in ns.
        """
        timestamp = self._timestamp_message.timestamp
        timestamp.seconds, timestamp.nanos = divmod(time_ns, 1_000_000_000)
        self._parts[1::2] = values
        # Protobuf merges concatenated messages, so the timestamp may be encoded separately.
        return self._timestamp_message.SerializeToString() + self._pack(*self._parts)


class BodyMessageEncoder:
    """Encodes the link transforms and joint states of one robot for Foxglove."""

    def __init__(self, robot: RobotDescription) -> None:
        """Preallocate the FrameTransforms and JointStates messages of one robot.

        The methods fill them with the values of each sample of the joint angles.

        Args:
            robot: Description of the robot, with links and joints from tail to head and one link more than joints.
        """
        # The frame of each link is at its rear joint: the front end of its parent, the next link toward the tail.
        link_frames: list[FrameTransform] = []
        for parent, child in pairwise(robot.links):
            rear_end = (parent.length_m, 0.0, 0.0)
            link_frames.append(
                shapes.make_frame_transform(0, parent.name, child.name, rear_end, _NO_ROTATION)
            )
        tail_name = robot.links[0].name
        base_frame = shapes.make_frame_transform(
            0, shapes.WORLD_FRAME, tail_name, (0.0, 0.0, 0.0), _NO_ROTATION
        )
        self._link_transforms = FrameTransforms(transforms=link_frames)
        self._link_transforms_in_world = FrameTransforms(transforms=[base_frame, *link_frames])
        self._is_pitch_joint = [joint.axis == "pitch" for joint in robot.joints]
        self.joint_count = len(robot.joints)

        # A template finds the offset of each field in the encoded message by the field's unique placeholder value.
        # The placeholders are 1.0, 2.0, 3.0 ... in the order of the fields: three for each measured joint state, and
        # one for each reference angle.
        measured_joints: list[NamedJoint] = []
        reference_joints: list[NamedJoint] = []
        for i, joint in enumerate(robot.joints):
            placeholder = 3 * i + 1.0
            measured_joints.append(
                NamedJoint(
                    name=joint.name,
                    position=placeholder,
                    velocity=placeholder + 1.0,
                    effort=placeholder + 2.0,
                )
            )
            reference_joints.append(NamedJoint(name=joint.name, position=i + 1.0))
        self._measured_template = _JointStatesTemplate(JointStates(joints=measured_joints))
        self._reference_template = _JointStatesTemplate(JointStates(joints=reference_joints))

    def fill_transforms(
        self, angles_rad: Sequence[float], base: BasePose | None, time_ns: int
    ) -> FrameTransforms:
        """Fill and return the transform of each link relative to its parent, and of the tail link in the world.

        The next call reuses the returned message, so the caller must encode it before that.

        Args:
            angles_rad: (n_joints,) joint angles, tail to head.
            base: Position in m and orientation wxyz of the tail link in the world. If None, the pose is unknown, and
                the transform in the world is left out.
            time_ns: Robot time of the joint angles, in ns.
        """
        message = self._link_transforms if base is None else self._link_transforms_in_world
        frames = list(message.transforms)
        seconds, nanos = divmod(time_ns, 1_000_000_000)
        for frame in frames:
            frame.timestamp.seconds = seconds
            frame.timestamp.nanos = nanos
        if base is not None:
            position_w, orientation_wxyz = base
            base_frame = frames.pop(0)
            translation = base_frame.translation
            rotation = base_frame.rotation
            translation.x, translation.y, translation.z = position_w
            rotation.w, rotation.x, rotation.y, rotation.z = orientation_wxyz
        for frame, angle_rad, is_pitch in zip(
            frames, angles_rad, self._is_pitch_joint, strict=True
        ):
            half_angle_rad = 0.5 * angle_rad
            rotation = frame.rotation
            rotation.w = math.cos(half_angle_rad)
            if is_pitch:
                rotation.y = math.sin(half_angle_rad)
            else:
                rotation.z = math.sin(half_angle_rad)
        return message

    def encode_joint_states(self, joints: JointState, time_ns: int) -> bytes:
        """Return an encoded JointStates message with the measured angle, speed and torque of each joint."""
        rows = zip(joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, strict=True)
        return self._measured_template.encode_with_values(chain.from_iterable(rows), time_ns)

    def encode_references(self, reference_rad: Sequence[float], time_ns: int) -> bytes:
        """Return an encoded JointStates message with the controller's reference angles, (n_joints,), tail to head."""
        return self._reference_template.encode_with_values(reference_rad, time_ns)
