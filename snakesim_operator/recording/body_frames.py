"""Joint states and transforms of a robot for Foxglove, in messages that are made once and filled again and again."""

import math
from collections.abc import Sequence
from itertools import pairwise

from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState as NamedJoint
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates

from snakesim_hal.wire.messages import Description, JointState
from snakesim_operator.recording import shapes


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
        self._measured, self._wanted = (
            JointStates(joints=[NamedJoint(name=joint.name) for joint in robot.joints]) for _ in range(2)
        )

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

    def joint_states(self, joints: JointState, time_ns: int) -> JointStates:
        """Angle, speed and torque of each joint by its name."""
        made = self._measured
        made.timestamp.seconds, made.timestamp.nanos = divmod(time_ns, 1_000_000_000)
        numbers = zip(made.joints, joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, strict=True)
        for named, angle_rad, speed_rad_s, torque_nm in numbers:
            named.position, named.velocity, named.effort = angle_rad, speed_rad_s, torque_nm
        return made

    def reference(self, wanted_rad: Sequence[float], time_ns: int) -> JointStates:
        """The angle that the controller wants of each joint. wanted_rad: (n_joints,), tail to head."""
        made = self._wanted
        made.timestamp.seconds, made.timestamp.nanos = divmod(time_ns, 1_000_000_000)
        for named, angle_rad in zip(made.joints, wanted_rad, strict=True):
            named.position = angle_rad
        return made
