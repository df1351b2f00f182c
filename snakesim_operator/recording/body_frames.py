"""Joint states and transforms of a robot for Foxglove, in messages that are made once and filled again and again."""

import math
import struct
from collections.abc import Iterable, Sequence
from itertools import chain, pairwise

from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState as NamedJoint
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates

from snakesim_hal.wire.messages import Description, JointState
from snakesim_operator.recording import shapes


class _Rows:
    """Joint states as bytes: only the numbers change, and setting each in a message costs ten times what this does."""

    def __init__(self, joints: JointStates) -> None:
        """joints: with a number of its own in every field that is to be filled, in their order 1.0, 2.0 ..."""
        data, number, format_ = joints.SerializeToString(), 1.0, "<"
        self._parts: list[bytes | float] = []
        while (at := data.find(wanted := struct.pack("<d", number))) >= 0:
            self._parts += (data[:at], number)
            format_ += f"{at}sd"
            data, number = data[at + len(wanted) :], number + 1.0
        assert not data, "a number ends each joint"
        self._pack = struct.Struct(format_).pack
        self._time = JointStates()

    def filled(self, numbers: Iterable[float], time_ns: int) -> bytes:
        """The message. numbers: of all fields, in their order."""
        stamp = self._time.timestamp
        stamp.seconds, stamp.nanos = divmod(time_ns, 1_000_000_000)
        self._parts[1::2] = numbers
        return self._time.SerializeToString() + self._pack(*self._parts)


class BodyFrames:
    """What is made is valid until the next call."""

    def __init__(self, robot: Description) -> None:
        """robot: with one link more than joints."""
        links = robot.links
        chained = [
            shapes.frame(0, rear.name, link.name, (rear.length_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
            for rear, link in pairwise(links)
        ]
        placed = shapes.frame(0, shapes.WORLD_FRAME, links[0].name, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        self._chained, self._placed = (
            FrameTransforms(transforms=chained),
            FrameTransforms(transforms=[placed, *chained]),
        )
        self._pitched = [joint.axis == "pitch" for joint in robot.joints]
        self.joints = len(robot.joints)
        names = [joint.name for joint in robot.joints]
        measured = [
            NamedJoint(name=name, position=3 * i + 1.0, velocity=3 * i + 2.0, effort=3 * i + 3.0)
            for i, name in enumerate(names)
        ]
        self._measured = _Rows(JointStates(joints=measured))
        self._wanted = _Rows(JointStates(joints=[NamedJoint(name=n, position=i + 1.0) for i, n in enumerate(names)]))

    def transforms(
        self, angles_rad: Sequence[float], base: tuple[Sequence[float], Sequence[float]] | None, time_ns: int
    ) -> FrameTransforms:
        """Each link in the frame of the one behind it; the last one in the world, if that is known.

        angles_rad: (n_joints,), tail to head. base: position_w (3,) and orientation wxyz (4,) of link 0.
        """
        made = self._chained if base is None else self._placed
        frames = list(made.transforms)
        seconds, nanos = divmod(time_ns, 1_000_000_000)
        for frame in frames:
            frame.timestamp.seconds, frame.timestamp.nanos = seconds, nanos
        if base is not None:
            frame = frames.pop(0)
            at, turn = frame.translation, frame.rotation
            at.x, at.y, at.z = base[0]
            turn.w, turn.x, turn.y, turn.z = base[1]
        for frame, angle_rad, pitched in zip(frames, angles_rad, self._pitched, strict=True):
            turn = frame.rotation
            turn.w = math.cos(0.5 * angle_rad)
            if pitched:
                turn.y = math.sin(0.5 * angle_rad)
            else:
                turn.z = math.sin(0.5 * angle_rad)
        return made

    def joint_states(self, joints: JointState, time_ns: int) -> bytes:
        """Angle, speed and torque of each joint by its name: a JointStates."""
        rows = zip(joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, strict=True)
        return self._measured.filled(chain.from_iterable(rows), time_ns)

    def reference(self, wanted_rad: Sequence[float], time_ns: int) -> bytes:
        """The angle that the controller wants of each joint: a JointStates. wanted_rad: (n_joints,), tail to head."""
        return self._wanted.filled(wanted_rad, time_ns)
