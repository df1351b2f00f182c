"""Path following: every joint in position mode, towards a body pose slightly further along the path.

The obstacles turn the change of shape into motion. With the arc length s of the tail end, the mission's speed v, the
period T and the look-ahead L, the reference is the pose of the body at the arc length

    s_ref = min(max(s_ref + v T, s), s + L)

so that it moves with the mission's speed, but never further than L ahead of the measured body: a blocked snake does
not wind up.
"""

from typing import Annotated

from snakesim_gnc.control.bumpless import Blend, BumplessFollower
from snakesim_gnc.control.climb import PlatformClimb
from snakesim_gnc.control.progress import PathProgress, SpeedFilter
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import from_zero


class PathFollowingParameters(FileStruct, frozen=True, kw_only=True):
    """Too little look-ahead does not overcome the drag. Too much wedges the body between tight obstacles."""

    look_ahead_m: Annotated[float, from_zero(1, "m")] = 0.03
    """Maximum look-ahead of the shape along its path."""

    blend_s: Blend = 0.3
    """Time over which the command changes smoothly to a new reference."""

    speed_filter_s: SpeedFilter = 0.03
    """Time constant of the filter of the speed along the path. 0: no filter."""


class PathFollowing(Controller[PathFollowingParameters]):
    """Controls the shape of the body along a path. It does not use the positions of obstacles."""

    Parameters = PathFollowingParameters

    def __init__(self, robot: RobotDescription, parameters: PathFollowingParameters) -> None:
        super().__init__(robot, parameters)
        self._body = PlanarBody(robot)
        self._platform_climb = PlatformClimb(robot)
        self._progress = PathProgress(self._body, speed_filter_s=parameters.speed_filter_s)
        self._bumpless_follower = BumplessFollower(robot, parameters.blend_s)
        self._reference_s_m = 0.0  # s_ref

    def update(self, observation: Observation) -> ControllerCommand:
        """Return position setpoints of the body slightly further along its path.

        The look-ahead is bounded, so that a blocked body does not wind up. While the position of the body on the path
        is unknown, the joints hold their references.

        Args:
            observation: The inputs of this tick.

        Returns:
            Position setpoints of all joints, with telemetry about the position on the path.
        """
        location = self._progress.update(observation)
        if isinstance(location, str):  # why the position is unknown
            return self._bumpless_follower.hold_pose(observation, location)
        tail_s_m = location.tail_s_m
        if location.may_have_jumped:
            self._reference_s_m = tail_s_m
        advanced_s_m = self._reference_s_m + location.trajectory.speed_m_s * observation.period_s
        self._reference_s_m = min(
            max(advanced_s_m, tail_s_m), tail_s_m + self.parameters.look_ahead_m
        )

        yaw_rad = self._body.expand_joint_angles(
            location.body_on_path.compute_pose_at(self._reference_s_m)
        )
        pitch_rad = self._platform_climb.compute_pitch_angles_rad(
            location.trajectory.rises, self._reference_s_m
        )
        reference_rad = yaw_rad + pitch_rad
        setpoints = self._bumpless_follower.make_setpoints(
            observation, reference_rad, may_have_jumped=location.may_have_jumped
        )
        return ControllerCommand(
            setpoints, Telemetry(path_s_m=tail_s_m, reference_rad=reference_rad.tolist())
        )
