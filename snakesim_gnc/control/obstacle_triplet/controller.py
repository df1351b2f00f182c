"""The obstacle-triplet controller: one joint pushes with a torque, all others keep the body on its path.

For each new world model the controller finds the push-points of the body, solves every triplet on alternating sides
among them, and chooses one. Its propulsion joint is the first joint ahead of o_2. As the body moves forward, o_2 passes
joint after joint towards the tail, and so does the propulsion, until the triplet's last obstacle is lost.

The propulsion force is `propulsion_n (1 - speed / mission speed)`, never below zero. A force below the drag moves
nothing: positions follow the path at the measured arc length, without a look-ahead that would push by itself. They
follow it no faster than the mission's speed, which brakes a body that is too fast.

Between push-points the propulsion joint swings freely until its contacts carry load. It is damped, the force is reduced
as it swings out, and a joint that has left its reference too far returns to position mode. A body that is stationary
while it pushes is reported with the cause; where that strains joint or contacts, the triplet is released for a while
and others are tried.

Nothing jumps at a hand-over. In the tick of a change of mode, a position target is within `fade` times the joint's
angle from its reference, and a torque target within `fade` times (measured torque - propulsion torque), of the target
with which the motor keeps its torque; `fade = period / blend_s + |speed| period / blend_m`, 0.07 with the defaults at
100 Hz and 0.2 m/s. The limiter of the HAL limits it once more: `speed_limit * period` and `torque_rate_limit * period`.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_gnc.control.bumpless import BumplessTransfer
from snakesim_gnc.control.climb import PlatformClimb
from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.obstacle_triplet.contacts import (
    PlannedContact,
    PushPoint,
    find_push_points,
    plan_contact,
)
from snakesim_gnc.control.obstacle_triplet.parameters import TripletParameters
from snakesim_gnc.control.obstacle_triplet.selection import (
    ObstacleNames,
    PropulsionChoice,
    TripletFinder,
    choose_triplet,
)
from snakesim_gnc.control.obstacle_triplet.stall import StallDetector, StallReason, explain_stall
from snakesim_gnc.control.obstacle_triplet.telemetry import (
    compute_bending_torques_nm,
    make_contact_messages,
)
from snakesim_gnc.control.progress import BodyLocation, PathProgress
from snakesim_gnc.geometry.body_on_path import PathBodyPose
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.wire.messages import JointMode, KnownObstacle, RobotDescription
from snakesim_hal.wire.setpoints import RequestedSetpoints

# The path may pass an obstacle that is near the body so far beyond the body's ends.
PLAN_WINDOW_M = 1.0
MIN_TORQUE_PER_N = 1e-12  # N·m/N; avoids a division by zero
MAX_REASON_LENGTH = 400  # characters


@dataclass(frozen=True)
class PropulsionDemand:
    """The torque of the propulsion joint in one tick, and the forces that it comes from."""

    joint: int  # index among all joints
    desired_force_n: float  # propulsion force from the speed alone
    force_n: float  # after fading, and within the joint's torque limit
    torque_nm: float
    is_saturated: bool  # the torque limit has reduced the force
    is_swung_out: bool  # the joint is so far from its reference that the force is reduced


class ObstacleTriplet(Controller[TripletParameters]):
    """Obstacle-aided locomotion with three contacts and one propulsion joint.

    Source: section IV of the SnakeSIM paper, with the correction that `statics` describes.
    """

    Parameters = TripletParameters
    required_modes = (JointMode.POSITION, JointMode.TORQUE)
    required_measurements = ("torque",)

    def __init__(self, robot: RobotDescription, parameters: TripletParameters) -> None:
        """Create a controller that pushes off three obstacles at a time, with one joint in torque mode.

        It starts without push-points and triplet: all joints are in position mode until a world model shows three
        obstacles that the body can push off.

        Args:
            robot: Description of the robot; the joints with a vertical axis bend the body.
            parameters: Gains, limits and thresholds of this controller.
        """
        super().__init__(robot, parameters)
        # Models and estimators.
        self._body = PlanarBody(robot)
        self._platform_climb = PlatformClimb(robot)
        self._progress = PathProgress(self._body, speed_filter_s=parameters.speed_filter_s)
        self._measured_contacts = MeasuredContacts()
        # Joints in position mode.
        self._bumpless_transfer = BumplessTransfer(robot)
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._body_pose: PathBodyPose | None = None  # the pose on the path that these joints follow
        # (n_joints,) rad, angles of that pose; empty before the first tick.
        self._reference_rad = np.empty(0)
        # Filtered load that their targets compensate.
        self._filtered_loads_nm = np.zeros(len(robot.joints))
        # Push-points and triplets.
        # By the obstacle's name.
        self._planned_contacts: dict[str, tuple[KnownObstacle, PlannedContact]] = {}
        self._push_points: list[PushPoint] = []
        self._triplet_finder = TripletFinder(
            condition_max=parameters.condition_max,
            authority_min=parameters.authority_min,
            hold_on_m=parameters.hold_on_m,
        )
        self._choice: PropulsionChoice | None = None
        self._refusal_reasons: list[str] = []  # why triplets cannot be used
        # Propulsion of the tick before.
        self._unlimited_force_n = 0.0  # before the joint's torque limit
        self._force_n = 0.0
        # Supervision.
        self._stall_detector = StallDetector(
            stall_m=parameters.stall_m,
            stall_s=parameters.stall_s,
            propulsion_n=parameters.propulsion_n,
        )
        # Last stall, and the arc length of the tail where it occurred.
        self._stall: tuple[StallReason, float] | None = None
        # Triplet -> arc length at which it was stationary.
        self._banned_triplets: dict[ObstacleNames, float] = {}
        # Joint among those that bend, time until which.
        self._excluded_joint: tuple[int, float] | None = None
        self._position_mode_until_s = 0.0

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the setpoints of the next period: one joint propels by its torque, the others follow the path.

        Push-points are the places where the body can push off an obstacle. They, and the triplet of them that propels,
        are chosen again for each new world model. While the position on the path is unknown, all joints hold their
        reference angles.

        Args:
            observation: The inputs of this tick.

        Returns:
            Setpoints of all joints, with telemetry about the triplet and its forces.
        """
        # 1. Where the body is on its path. A text instead is the reason why this is unknown.
        location = self._progress.update(observation)
        if isinstance(location, str):
            return self._hold_reference(observation, location)
        self._measured_contacts.add_world(location.world)

        # 2. The pose that the joints in position mode follow, stored as `_reference_rad`.
        body_pose = self._update_reference_pose(observation, location)

        # 3. Which triplet propels in this tick, stored as `_choice`. The order matters: a new choice uses the new
        # push-points, and the joint of a new choice may be released at once.
        choice_of_last_tick = self._choice
        if location.trajectory.speed_m_s <= 0:
            self._choice = None
            self._stall_detector.reset()
        if location.is_new_world or location.may_have_jumped:
            self._update_push_points(location, body_pose)
            self._update_choice(observation, location, body_pose)
        self._release_swung_out_joint(observation, body_pose)

        # 4. Targets of the joints. The load and the propulsion joint depend on the choice of this tick.
        reference_rad = self._reference_rad + self._compute_load_compensation_rad(
            observation, body_pose
        )
        self._switch_propulsion_joint(observation, location, reference_rad, choice_of_last_tick)
        return self._make_command(observation, location, body_pose, reference_rad)

    def _switch_propulsion_joint(
        self,
        observation: Observation,
        location: BodyLocation,
        reference_rad: Floats,
        choice_of_last_tick: PropulsionChoice | None,
    ) -> None:
        """Switch torque mode to the joint of the chosen triplet, and advance the ramps by time and by travel.

        Args:
            observation: The inputs of this tick.
            location: Speed of the body on the path.
            reference_rad: (n_joints,) reference angles in rad.
            choice_of_last_tick: The chosen triplet of the tick before; None if there was none.
        """
        parameters = self.parameters
        choice = self._choice
        joint = None
        has_changed_triplet = False
        if choice is not None:
            joint = self._body.yaw_joints[choice.joint]
            has_changed_triplet = (
                choice_of_last_tick is not None
                and choice.triplet.names != choice_of_last_tick.triplet.names
            )
        self._bumpless_transfer.switch_torque_joint(
            joint, observation.joints, reference_rad, restart_ramp=has_changed_triplet
        )
        self._bumpless_transfer.advance_ramps(
            observation.period_s / parameters.blend_s
            + abs(location.speed_m_s) * observation.period_s / parameters.blend_m
        )

    def _make_command(
        self,
        observation: Observation,
        location: BodyLocation,
        body_pose: PathBodyPose,
        reference_rad: Floats,
    ) -> ControllerCommand:
        """Set all joints to position mode at their reference, and the propulsion joint, if there is one, to its torque.

        Args:
            observation: The inputs of this tick.
            location: Position and speed of the body on the path.
            body_pose: The pose on the path that the joints follow.
            reference_rad: (n_joints,) reference angles in rad, with the compensation of the load.

        Returns:
            The setpoints, with telemetry. Without a chosen triplet, no joint propels.
        """
        targets: list[float] = self._bumpless_transfer.compute_position_targets_rad(
            reference_rad
        ).tolist()
        modes = [JointMode.POSITION] * len(targets)
        setpoints = RequestedSetpoints(modes, targets, self._body.torque_limit_nm)
        choice = self._choice
        if choice is None:
            self._unlimited_force_n = 0.0
            self._force_n = 0.0
            return ControllerCommand(setpoints, self._make_rest_telemetry(location))
        demand = self._compute_propulsion_demand(observation, location, choice)
        self._force_n = demand.force_n
        modes[demand.joint] = JointMode.TORQUE
        targets[demand.joint] = demand.torque_nm
        self._watch_stall(observation, location, choice, demand)
        return ControllerCommand(
            setpoints, self._make_push_telemetry(location, body_pose, choice, demand)
        )

    # --- control law ---------------------------------------------------------------------------------------------

    def _update_reference_pose(
        self, observation: Observation, location: BodyLocation
    ) -> PathBodyPose:
        """Update the pose on the path that the joints in position mode follow, without a jump of their targets.

        Its arc length follows the measured one with slack, no faster than `overspeed_ratio` times the mission's speed,
        and at most `brake_m` behind.

        Args:
            observation: The inputs of this tick.
            location: Position of the body on the path.

        Returns:
            The updated pose; its joint angles are stored as the reference.
        """
        parameters = self.parameters
        measured_s_m = location.tail_s_m
        last_pose = self._body_pose
        if last_pose is None or location.may_have_jumped:
            body_pose = location.body_on_path.compute_pose_at(measured_s_m)
        else:
            # Stay where the pose was, unless the body has moved on by more than the slack in either direction.
            last_s_m = last_pose.tail_s_m
            lowest_s_m = measured_s_m - parameters.slack_m
            highest_s_m = measured_s_m + parameters.slack_m
            # A body that is too fast is braked by the pose, which does not follow, but not without limit.
            max_speed_m_s = max(location.trajectory.speed_m_s, 0.0) * parameters.overspeed_ratio
            reachable_s_m = last_s_m + max_speed_m_s * observation.period_s
            followed_s_m = min(max(last_s_m, lowest_s_m), highest_s_m, reachable_s_m)
            body_pose = location.body_on_path.compute_pose_at(
                max(followed_s_m, measured_s_m - parameters.brake_m)
            )
        pitch_rad = self._platform_climb.compute_pitch_angles_rad(
            location.trajectory.rises, body_pose.tail_s_m
        )
        reference_rad = self._body.expand_joint_angles(body_pose) + pitch_rad
        if not len(self._reference_rad):
            self._bumpless_transfer.start_in_position_mode(observation.joints, reference_rad)
        elif location.may_have_jumped:
            self._bumpless_transfer.absorb_reference_jump(reference_rad - self._reference_rad)
        self._body_pose = body_pose
        self._reference_rad = reference_rad
        return body_pose

    def _compute_load_compensation_rad(
        self, observation: Observation, body_pose: PathBodyPose
    ) -> Floats:
        """Update the filtered loads, and return by how much targets lead the path's angles: load / stiffness.

        The load of a joint is `load_ratio` times its torque for the planned contact forces. A servo gives way under a
        load; with this lead, its joint stays on the path.

        Args:
            observation: The inputs of this tick.
            body_pose: The pose on the path that the joints follow.

        Returns:
            (n_joints,) angles in rad.
        """
        load_ratio = self.parameters.load_ratio
        if load_ratio == 0.0:
            return np.zeros(len(self._filtered_loads_nm))
        loads_nm = np.zeros(len(self._filtered_loads_nm))
        if self._choice is not None and self._force_n > 0.0:
            loads_nm = load_ratio * compute_bending_torques_nm(
                self._body, body_pose, self._choice, self._force_n
            )
        decay = np.exp(-observation.period_s / self.parameters.load_filter_s)
        self._filtered_loads_nm = decay * self._filtered_loads_nm + (1.0 - decay) * loads_nm
        return self._filtered_loads_nm / self._stiffness

    def _compute_propulsion_demand(
        self, observation: Observation, location: BodyLocation, choice: PropulsionChoice
    ) -> PropulsionDemand:
        """Compute the torque with which the propulsion joint pushes the body along the path in this tick.

            f   = propulsion_n (1 - v / v_mission) * fade,   between 0 and propulsion_n, with a limited rate
            tau = f * torque_per_n - damping q',             within the joint's torque limit

        fade is 1 while the joint has swung out by less than `angle_fade_rad`, and falls to 0 at twice as much.

        Args:
            observation: The inputs of this tick, with the joint's angle and velocity q'.
            location: The body's speed v along the path, and the mission's speed.
            choice: The triplet that propels, its joint, and the joint torque for 1 N of propulsion.

        Returns:
            The joint, its torque, the force before and after limits, and which limit applied.
        """
        parameters = self.parameters
        joint = self._body.yaw_joints[choice.joint]
        limit_nm = self._body.torque_limit_nm[joint]
        torque_per_n = choice.torque_per_n

        # Force by the speed.
        speed_error_ratio = 1.0 - location.speed_m_s / location.trajectory.speed_m_s
        desired_force_n = parameters.propulsion_n * min(max(speed_error_ratio, 0.0), 1.0)

        # Fade the force while the joint swings out, and limit its change from tick to tick.
        swing_out_rad = observation.joints.angle_rad[joint] - float(self._reference_rad[joint])
        if torque_per_n <= 0:
            swing_out_rad = -swing_out_rad  # positive: in the direction of the torque
        fade = 2.0 - swing_out_rad / parameters.angle_fade_rad
        unlimited_force_n = desired_force_n * min(max(fade, 0.0), 1.0)
        max_change_n = parameters.propulsion_rate_n_s * observation.period_s
        unlimited_force_n = min(
            max(unlimited_force_n, self._unlimited_force_n - max_change_n),
            self._unlimited_force_n + max_change_n,
        )
        self._unlimited_force_n = unlimited_force_n

        # Torque by the force, with damping, and within the limit of the joint.
        force_n = min(unlimited_force_n, limit_nm / max(abs(torque_per_n), MIN_TORQUE_PER_N))
        torque_nm = (
            force_n * torque_per_n
            - parameters.damping_nm_s_per_rad * observation.joints.velocity_rad_s[joint]
        )
        torque_nm = min(
            max(self._bumpless_transfer.compute_torque_target_nm(torque_nm), -limit_nm), limit_nm
        )
        return PropulsionDemand(
            joint=joint,
            desired_force_n=desired_force_n,
            force_n=force_n,
            torque_nm=torque_nm,
            is_saturated=force_n < unlimited_force_n,
            is_swung_out=fade < 1.0,
        )

    # --- push-points and triplets --------------------------------------------------------------------------------

    def _update_push_points(self, location: BodyLocation, body_pose: PathBodyPose) -> None:
        """Plan the contacts with the obstacles near the body, and find those that the body can push off now.

        Obstacles that the body touches or pushes off already remain push-points up to a wider gap, `give_up_gap_m`.

        Args:
            location: Position of the body, with the new world model.
            body_pose: The pose on the path that the joints follow.
        """
        if location.may_have_jumped:
            self._planned_contacts.clear()
        self._update_planned_contacts(location)
        retained = [
            contact.obstacle for contact in location.world.contacts if contact.obstacle is not None
        ]
        if self._choice is not None:
            retained += self._choice.triplet.names
        self._push_points = find_push_points(
            [contact for _, contact in self._planned_contacts.values()],
            retained,
            body_pose,
            location.body_points_w,
            self._body.body_points_s_m,
            gap_m=self.parameters.gap_m,
            give_up_gap_m=self.parameters.give_up_gap_m,
            end_m=self.parameters.end_m,
        )

    def _update_planned_contacts(self, location: BodyLocation) -> None:
        """Plan contacts with obstacles that are new or have changed, and drop contacts with obstacles that are gone."""
        obstacles = {obstacle.name: obstacle for obstacle in location.world.obstacles}
        for name in list(self._planned_contacts):
            if name not in obstacles:
                del self._planned_contacts[name]
        for name, obstacle in obstacles.items():
            known_contact = self._planned_contacts.get(name)
            if known_contact is None or known_contact[0] != obstacle:
                self._planned_contacts[name] = (obstacle, self._plan_contact(location, obstacle))

    def _plan_contact(self, location: BodyLocation, obstacle: KnownObstacle) -> PlannedContact:
        half_length_m = self._body.length_m / 2
        return plan_contact(
            location.body_on_path.route,
            obstacle,
            self._body.radius_m,
            search_middle_s_m=location.tail_s_m + half_length_m,
            window_m=half_length_m + PLAN_WINDOW_M,
        )

    def _update_choice(
        self, observation: Observation, location: BodyLocation, body_pose: PathBodyPose
    ) -> None:
        """Choose the triplet that propels, with its joint, from the current push-points; `_choice` is None without one.

        No triplet is chosen if no motion is desired, or for some time after a stall. A triplet at which the body was
        stationary is chosen only if there is no other.

        Args:
            observation: The inputs of this tick.
            location: Position of the body on the path, and the desired speed.
            body_pose: The pose on the path that the joints follow.
        """
        self._expire_restrictions(observation.time_s, location.tail_s_m)
        excluded_joint = None
        if self._excluded_joint is not None:
            excluded_joint, _ = self._excluded_joint
        choices, self._refusal_reasons = self._triplet_finder.find_propulsion_choices(
            self._push_points,
            body_pose.body_points_w,
            self._body.body_points_s_m,
            self._choice,
            excluded_joint,
        )
        if location.trajectory.speed_m_s <= 0 or observation.time_s < self._position_mode_until_s:
            self._choice = None
            return
        current_triplet = None
        if self._choice is not None:
            current_triplet = self._choice.triplet
        switch_fraction = self.parameters.switch_fraction
        choice = choose_triplet(
            choices,
            current_triplet,
            switch_fraction=switch_fraction,
            banned_triplets=self._banned_triplets,
        )
        if choice is None:  # a banned triplet is better than none
            choice = choose_triplet(choices, current_triplet, switch_fraction=switch_fraction)
        self._choice = choice

    def _expire_restrictions(self, time_s: float, tail_s_m: float) -> None:
        """Forget a stall and bans that lie `blend_m` of travel back, and an excluded joint whose time is over."""
        blend_m = self.parameters.blend_m
        self._banned_triplets = {
            names: s_m
            for names, s_m in self._banned_triplets.items()
            if abs(tail_s_m - s_m) < blend_m
        }
        if self._stall is not None and abs(tail_s_m - self._stall[1]) > blend_m:
            self._stall = None
        if self._excluded_joint is not None and time_s >= self._excluded_joint[1]:
            self._excluded_joint = None

    # --- supervision ---------------------------------------------------------------------------------------------

    def _release_swung_out_joint(self, observation: Observation, body_pose: PathBodyPose) -> None:
        """Return the propulsion joint to position mode if it has swung out too far, and exclude it for `guard_s`."""
        if self._choice is None:
            return
        joint = self._choice.joint
        guard_s = self.parameters.guard_s
        robot_joint = self._body.yaw_joints[joint]
        swing_out_rad = observation.joints.angle_rad[robot_joint] - float(
            body_pose.angles_rad[joint]
        )
        if abs(swing_out_rad) > self.parameters.angle_guard_rad:
            self._excluded_joint = (joint, observation.time_s + guard_s)
            name = self._body.joint_names[robot_joint]
            self._refusal_reasons = [
                f"{name} left its reference by {swing_out_rad:+.2f} rad; in position mode for {guard_s} s"
            ]
            self._choice = None

    def _watch_stall(
        self,
        observation: Observation,
        location: BodyLocation,
        choice: PropulsionChoice,
        demand: PropulsionDemand,
    ) -> None:
        """Detect a standstill while pushing, and release a triplet that is strained but does not move the body.

        A released triplet is banned near this place, and all joints go to position mode for `release_s`.

        Args:
            observation: The inputs of this tick.
            location: Position of the body on the path.
            choice: The triplet that propels.
            demand: Force and torque of the propulsion joint, and which limit applied.
        """
        if not self._stall_detector.has_stalled(
            observation.time_s, location.tail_s_m, demand.desired_force_n
        ):
            return
        self._stall_detector.reset()
        joint_name = self._body.joint_names[demand.joint]
        stall = explain_stall(
            desired_force_n=demand.desired_force_n,
            force_n=demand.force_n,
            net_force=self._measured_contacts.resolve_along(choice.triplet.contacts[0].tangent_w),
            push_points=choice.triplet.names,
            weight_n=self._body.weight_n,
            saturated_joint=joint_name if demand.is_saturated else None,
            swung_out_joint=joint_name if demand.is_swung_out else None,
            jam_force_n=self.parameters.jam_force_n,
            drag_ratio=self.parameters.drag_ratio,
        )
        self._stall = (stall, location.tail_s_m)
        if stall.should_release_triplet:
            self._banned_triplets[choice.triplet.names] = location.tail_s_m
            self._position_mode_until_s = observation.time_s + self.parameters.release_s

    def _hold_reference(self, observation: Observation, reason: str) -> ControllerCommand:
        """Command every joint to its reference angle without propulsion, while the position of the body is unknown.

        The first call takes the measured angles as reference. Later calls fade out what the last push added to the
        targets.

        Args:
            observation: The inputs of this tick.
            reason: Why the position is unknown, for the telemetry.

        Returns:
            Position setpoints of all joints.
        """
        self._choice = None
        self._unlimited_force_n = 0.0
        self._force_n = 0.0
        self._stall_detector.reset()
        if not len(self._reference_rad):
            self._reference_rad = np.array(observation.joints.angle_rad)
            self._bumpless_transfer.start_in_position_mode(observation.joints, self._reference_rad)
        # The load compensation becomes part of the offset, which fades.
        self._bumpless_transfer.absorb_reference_jump(-self._filtered_loads_nm / self._stiffness)
        self._filtered_loads_nm = np.zeros(len(self._filtered_loads_nm))
        self._bumpless_transfer.switch_torque_joint(None, observation.joints, self._reference_rad)
        self._bumpless_transfer.advance_ramps(observation.period_s / self.parameters.blend_s)
        targets = self._bumpless_transfer.compute_position_targets_rad(self._reference_rad).tolist()
        return ControllerCommand(
            make_position_setpoints(self.robot, targets),
            Telemetry(reason=reason, reference_rad=self._reference_rad.tolist()),
        )

    # --- reports -------------------------------------------------------------------------------------------------

    def _make_rest_telemetry(self, location: BodyLocation) -> Telemetry:
        """Make the telemetry of a tick in which no joint pushes, with the reason."""
        return Telemetry(
            reason=self._explain_rest(location.trajectory.speed_m_s)[:MAX_REASON_LENGTH],
            usable_push_points=len(self._push_points),
            path_s_m=location.tail_s_m,
            reference_rad=self._reference_rad.tolist(),
            jammed=self._is_jammed(),
        )

    def _explain_rest(self, desired_m_s: float) -> str:
        if self._stall is not None:
            stall, _ = self._stall
            return stall.reason
        if desired_m_s > 0:
            return "; ".join(self._refusal_reasons) or "no three push-points on alternating sides"
        if desired_m_s == 0:
            return ""
        return "cannot go backward"

    def _is_jammed(self) -> bool:
        return self._stall is not None and self._stall[0].is_jammed

    def _make_push_telemetry(
        self,
        location: BodyLocation,
        body_pose: PathBodyPose,
        choice: PropulsionChoice,
        demand: PropulsionDemand,
    ) -> Telemetry:
        """Return the telemetry of a tick in which a triplet propels: its joint, its contacts and its forces.

        Args:
            location: Position of the body on the path, and the world model.
            body_pose: The pose on the path that the joints follow.
            choice: The triplet that propels.
            demand: Force and torque of the propulsion joint, and which limit applied.

        Returns:
            The telemetry, with contact forces in N, and with the torque margin at full propulsion in N·m.
        """
        stall_reason = ""
        if self._stall is not None:
            stall, _ = self._stall
            stall_reason = stall.reason
        forces_n: list[float] = (demand.force_n * choice.triplet.unit_forces.forces).tolist()
        full_torque_nm = abs(self.parameters.propulsion_n * choice.torque_per_n)
        return Telemetry(
            reason=stall_reason,
            usable_push_points=len(self._push_points),
            path_s_m=location.tail_s_m,
            propulsion_joint=demand.joint,
            propulsion_n=demand.force_n,
            push_points=make_contact_messages(self._body, location.world, choice, forces_n),
            desired_force_n=forces_n,
            propulsion_torque_nm=demand.torque_nm,
            bending_torque_nm=compute_bending_torques_nm(
                self._body, body_pose, choice, demand.force_n
            ).tolist(),
            reference_rad=self._reference_rad.tolist(),
            condition=choice.triplet.unit_forces.condition,
            torque_headroom_nm=self._body.torque_limit_nm[demand.joint] - full_torque_nm,
            saturated=demand.is_saturated,
            jammed=self._is_jammed(),
        )
