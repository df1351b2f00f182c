"""Joint states and transforms of a robot for Foxglove, in messages that are built once and filled for each sample."""

import math
import struct
from collections.abc import Iterable, Sequence
from itertools import chain, pairwise

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState as NamedJoint
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates

from snakesim_hal.wire.messages import Description, JointState
from snakesim_operator.recording import shapes

Pose = tuple[Sequence[float], Sequence[float]]  # position (3,) in m and orientation wxyz (4,)
_NO_ROTATION = (1.0, 0.0, 0.0, 0.0)


class _JointStatesTemplate:
    """An encoded JointStates in which only the numbers are replaced.

    Setting each field of a protobuf message takes ten times as long, and this happens for every sample.
    """

    def __init__(self, joints: JointStates) -> None:
        """Split the encoded message at its numbers, so that `fill` can put others in their places.

        Args:
            joints: A message with a marker in every field that will be filled: 1.0, 2.0, 3.0 and so on, in the order
                of the fields.
        """
        remaining = joints.SerializeToString()
        marker = 1.0
        struct_format = "<"
        self._parts: list[bytes | float] = []  # alternating: the bytes before a number, the number
        while True:
            encoded_marker = struct.pack("<d", marker)
            position = remaining.find(encoded_marker)
            if position < 0:
                break
            self._parts += (remaining[:position], marker)
            struct_format += f"{position}sd"
            remaining = remaining[position + len(encoded_marker) :]
            marker += 1.0
        assert not remaining, "a number ends each joint"
        self._pack = struct.Struct(struct_format).pack
        self._time_only = JointStates()

    def fill(self, numbers: Iterable[float], time_ns: int) -> bytes:
        """Return the encoded message with these numbers, in the order of the markers, at this robot time."""
        timestamp = self._time_only.timestamp
        timestamp.seconds, timestamp.nanos = divmod(time_ns, 1_000_000_000)
        self._parts[1::2] = numbers
        return self._time_only.SerializeToString() + self._pack(*self._parts)


class BodyMessages:
    """Makes the transforms and joint states of one robot."""

    def __init__(self, robot: Description) -> None:
        """Build the messages of one robot, which are later filled for each sample.

        Args:
            robot: Links and joints, tail to head; it has one link more than joints.
        """
        # Each link's frame is at the front end of the link behind it.
        link_frames: list[FrameTransform] = []
        for rear, front in pairwise(robot.links):
            rear_end = (rear.length_m, 0.0, 0.0)
            link_frames.append(shapes.make_frame(0, rear.name, front.name, rear_end, _NO_ROTATION))
        tail_name = robot.links[0].name
        base_frame = shapes.make_frame(0, shapes.WORLD_FRAME, tail_name, (0.0, 0.0, 0.0), _NO_ROTATION)
        self._chain = FrameTransforms(transforms=link_frames)
        self._chain_in_world = FrameTransforms(transforms=[base_frame, *link_frames])
        self._is_pitch = [joint.axis == "pitch" for joint in robot.joints]
        self.joint_count = len(robot.joints)

        # A template needs markers 1.0, 2.0, 3.0 ... in the order of its fields: three for each measured joint state,
        # and one for each reference angle.
        measured: list[NamedJoint] = []
        references: list[NamedJoint] = []
        for i, joint in enumerate(robot.joints):
            marker = 3 * i + 1.0
            measured.append(NamedJoint(name=joint.name, position=marker, velocity=marker + 1.0, effort=marker + 2.0))
            references.append(NamedJoint(name=joint.name, position=i + 1.0))
        self._measured = _JointStatesTemplate(JointStates(joints=measured))
        self._references = _JointStatesTemplate(JointStates(joints=references))

    def fill_transforms(self, angles_rad: Sequence[float], base: Pose | None, time_ns: int) -> FrameTransforms:
        """Return the frame of each link relative to the link behind it, and of the tail link in the world if known.

        The same message is filled again by the next call, so that the caller must encode it before that.

        Args:
            angles_rad: (n_joints,) joint angles, tail to head.
            base: Position in m and orientation wxyz of the tail link in the world; None if unknown.
            time_ns: Robot time.
        """
        message = self._chain if base is None else self._chain_in_world
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
        for frame, angle_rad, is_pitch in zip(frames, angles_rad, self._is_pitch, strict=True):
            half_angle_rad = 0.5 * angle_rad
            rotation = frame.rotation
            rotation.w = math.cos(half_angle_rad)
            if is_pitch:
                rotation.y = math.sin(half_angle_rad)
            else:
                rotation.z = math.sin(half_angle_rad)
        return message

    def encode_joint_states(self, joints: JointState, time_ns: int) -> bytes:
        """Return an encoded JointStates with angle, speed and torque of each joint."""
        rows = zip(joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, strict=True)
        return self._measured.fill(chain.from_iterable(rows), time_ns)

    def encode_references(self, reference_rad: Sequence[float], time_ns: int) -> bytes:
        """Return an encoded JointStates with the angles that the controller wants, (n_joints,), tail to head."""
        return self._references.fill(reference_rad, time_ns)
