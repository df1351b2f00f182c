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

from snakesim_gnc.control.bumpless import HandOver
from snakesim_gnc.control.climb import Climb
from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.obstacle_triplet.contacts import PlannedContact, PushPoint, find_push_points, plan_contact
from snakesim_gnc.control.obstacle_triplet.parameters import TripletParameters
from snakesim_gnc.control.obstacle_triplet.selection import Choice, Names, Triplets, choose_triplet
from snakesim_gnc.control.obstacle_triplet.stall import Stall, StallWatch, explain
from snakesim_gnc.control.obstacle_triplet.telemetry import compute_bending_nm, make_contact_messages
from snakesim_gnc.control.progress import Located, PathProgress
from snakesim_gnc.geometry.body_on_path import BodyPose
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, positions
from snakesim_hal.wire.messages import Description, Mode, Obstacle
from snakesim_hal.wire.setpoints import RequestedSetpoints

PLAN_WINDOW_M = 1.0  # the path may pass an obstacle that is near the body so far beyond the body's ends
MIN_TORQUE_PER_N = 1e-12  # N·m/N; avoids a division by zero
MAX_REASON = 400  # characters


@dataclass(frozen=True)
class PropulsionDemand:
    """The torque of the propulsion joint in one tick, and the forces that it comes from."""

    joint: int  # index among all joints
    desired_n: float  # propulsion force from the speed alone
    force_n: float  # after fading, and within the joint's torque limit
    torque_nm: float
    saturated: bool  # the torque limit has reduced the force
    swung: bool  # the joint is so far from its reference that the force is reduced


class ObstacleTriplet(Controller[TripletParameters]):
    """Obstacle-aided locomotion with three contacts and one propulsion joint.

    Source: section IV of the SnakeSIM paper, with the correction that `statics` describes.
    """

    Parameters = TripletParameters
    required_modes = (Mode.POSITION, Mode.TORQUE)
    required_measurements = ("torque",)

    def __init__(self, robot: Description, parameters: TripletParameters) -> None:
        """Create a controller that pushes off three obstacles at a time, with one joint in torque mode.

        It starts without push-points and triplet: all joints are in position mode until a world model shows three
        obstacles that the body can push off.

        Args:
            robot: description of the robot; the joints with a vertical axis bend the body.
            parameters: gains, limits and thresholds of this controller.
        """
        super().__init__(robot, parameters)
        # Models and estimators.
        self._body = PlanarBody(robot)
        self._climb = Climb(robot)
        self._progress = PathProgress(self._body, speed_filter_s=parameters.speed_filter_s)
        self._contacts = MeasuredContacts()
        # Joints in position mode.
        self._hand_over = HandOver(robot)
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._body_pose: BodyPose | None = None  # the pose on the path that these joints follow
        self._reference = np.empty(0)  # (n_joints,) rad, angles of that pose; empty before the first tick
        self._load_nm = np.zeros(len(robot.joints))  # filtered load that their targets compensate
        # Push-points and triplets.
        self._planned: dict[str, tuple[Obstacle, PlannedContact]] = {}  # by the obstacle's name
        self._points: list[PushPoint] = []
        self._triplets = Triplets(
            condition_max=parameters.condition_max,
            authority_min=parameters.authority_min,
            hold_on_m=parameters.hold_on_m,
        )
        self._choice: Choice | None = None
        self._refused: list[str] = []  # why triplets cannot be used
        # Propulsion of the tick before.
        self._unlimited_n = 0.0  # before the joint's torque limit
        self._force_n = 0.0
        # Supervision.
        self._stall_watch = StallWatch(
            stall_m=parameters.stall_m, stall_s=parameters.stall_s, propulsion_n=parameters.propulsion_n
        )
        self._stall: tuple[Stall, float] | None = None  # and the arc length at which it began
        self._banned: dict[Names, float] = {}  # triplet -> arc length at which it was stationary
        self._barred: tuple[int, float] | None = None  # joint among those that bend, time until which
        self._position_until_s = 0.0

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the setpoints of the next period: one joint propels by its torque, the others follow the path.

        Push-points and the triplet that propels are chosen again for each new world model. While the position on the
        path is unknown, all joints hold their reference angles.

        Args:
            observation: the inputs of this tick.

        Returns:
            Setpoints of all joints, with telemetry about the triplet and its forces.
        """
        located = self._progress.update(observation)
        if isinstance(located, str):
            return self._wait(observation, located)
        self._contacts.add_world(located.world)
        body_pose = self._follow_path(observation, located)
        last_choice = self._choice
        if located.trajectory.speed_m_s <= 0:
            self._choice = None
            self._stall_watch.reset()
        if located.fresh or located.restarted:
            self._update_push_points(located, body_pose)
            self._update_choice(observation, located, body_pose)
        self._release_swung_joint(observation, body_pose)
        reference = self._reference + self._compensate_load(observation, body_pose)
        self._hand_over_propulsion(observation, located, reference, last_choice)
        return self._command(observation, located, body_pose, reference)

    def _hand_over_propulsion(
        self, observation: Observation, located: Located, reference: Floats, last_choice: Choice | None
    ) -> None:
        """Pass the propulsion to the joint of the present choice, and fade by time and by travel."""
        parameters = self.parameters
        choice = self._choice
        joint = None
        is_other_triplet = False
        if choice is not None:
            joint = self._body.bends[choice.joint]
            is_other_triplet = last_choice is not None and choice.triplet.names != last_choice.triplet.names
        self._hand_over.pass_to(joint, observation.joints, reference, fade_in_again=is_other_triplet)
        self._hand_over.fade(
            observation.period_s / parameters.blend_s
            + abs(located.speed_m_s) * observation.period_s / parameters.blend_m
        )

    def _command(
        self, observation: Observation, located: Located, body_pose: BodyPose, reference: Floats
    ) -> ControllerCommand:
        """Set all joints to position mode at their reference, and the propulsion joint, if there is one, to its torque.

        Args:
            observation: the inputs of this tick.
            located: position and speed of the body on the path.
            body_pose: the pose on the path that the joints follow.
            reference: (n_joints,) reference angles in rad, with the compensation of the load.

        Returns:
            The setpoints, with telemetry. Without a chosen triplet, no joint propels.
        """
        targets: list[float] = self._hand_over.positions_rad(reference).tolist()
        modes = [Mode.POSITION] * len(targets)
        setpoints = RequestedSetpoints(modes, targets, self._body.torque_limit_nm)
        choice = self._choice
        if choice is None:
            self._unlimited_n = 0.0
            self._force_n = 0.0
            return ControllerCommand(setpoints, self._report_rest(located))
        demand = self._compute_propulsion(observation, located, choice)
        self._force_n = demand.force_n
        modes[demand.joint] = Mode.TORQUE
        targets[demand.joint] = demand.torque_nm
        self._watch_stall(observation, located, choice, demand)
        return ControllerCommand(setpoints, self._report_push(located, body_pose, choice, demand))

    # --- control law ---------------------------------------------------------------------------------------------

    def _follow_path(self, observation: Observation, located: Located) -> BodyPose:
        """Update the pose on the path that the joints in position mode follow, without a jump of their targets.

        Its arc length follows the measured one with slack, no faster than `overspeed_ratio` times the mission's speed,
        and at most `brake_m` behind.

        Args:
            observation: the inputs of this tick.
            located: position of the body on the path.

        Returns:
            The updated pose; its joint angles are stored as the reference.
        """
        parameters = self.parameters
        s = located.tail_s_m
        last_pose = self._body_pose
        if last_pose is None or located.restarted:
            body_pose = located.on_path.pose_at(s)
        else:
            last_s = last_pose.tail_s_m
            max_speed_m_s = max(located.trajectory.speed_m_s, 0.0) * parameters.overspeed_ratio
            max_s = last_s + max_speed_m_s * observation.period_s
            followed_s = min(max(last_s, s - parameters.slack_m), s + parameters.slack_m, max_s)
            body_pose = located.on_path.pose_at(max(followed_s, s - parameters.brake_m))
        lift_rad = self._climb.angles_rad(located.trajectory.rises, body_pose.tail_s_m)
        reference = self._body.all_angles(body_pose) + lift_rad
        if not len(self._reference):
            self._hand_over.start(observation.joints, reference)
        elif located.restarted:
            self._hand_over.shift(reference - self._reference)
        self._body_pose = body_pose
        self._reference = reference
        return body_pose

    def _compensate_load(self, observation: Observation, body_pose: BodyPose) -> Floats:
        """Return how far targets lead the path's angles, (n_joints,) rad: filtered load / stiffness.

        The load of a joint is `load_ratio` times its torque for the planned contact forces. A servo gives way under a
        load; with this lead, its joint stays on the path.
        """
        load_ratio = self.parameters.load_ratio
        if load_ratio == 0.0:
            return np.zeros(len(self._load_nm))
        load_nm = np.zeros(len(self._load_nm))
        if self._choice is not None and self._force_n > 0.0:
            load_nm = load_ratio * compute_bending_nm(self._body, body_pose, self._choice, self._force_n)
        keep = np.exp(-observation.period_s / self.parameters.load_filter_s)
        self._load_nm = keep * self._load_nm + (1.0 - keep) * load_nm
        return self._load_nm / self._stiffness

    def _compute_propulsion(self, observation: Observation, located: Located, choice: Choice) -> PropulsionDemand:
        """Compute the torque of the propulsion joint.

            f   = propulsion_n (1 - v / v_mission) * fade,   between 0 and propulsion_n, with a limited rate
            tau = f * torque_per_n - damping q',             within the joint's torque limit

        fade is 1 while the joint has swung out by less than `angle_fade_rad`, and falls to 0 at twice as much.

        Args:
            observation: the inputs of this tick, with the joint's angle and velocity q'.
            located: the body's speed v along the path, and the mission's speed.
            choice: the triplet that propels, its joint, and the joint torque for 1 N of propulsion.

        Returns:
            The joint, its torque, the force before and after limits, and which limit applied.
        """
        parameters = self.parameters
        joint = self._body.bends[choice.joint]
        limit_nm = self._body.torque_limit_nm[joint]
        torque_per_n = choice.torque_per_n

        speed_error_ratio = 1.0 - located.speed_m_s / located.trajectory.speed_m_s
        desired_n = parameters.propulsion_n * min(max(speed_error_ratio, 0.0), 1.0)

        swing_rad = observation.joints.angle_rad[joint] - float(self._reference[joint])
        if torque_per_n <= 0:
            swing_rad = -swing_rad  # positive: in the direction of the torque
        fade = 2.0 - swing_rad / parameters.angle_fade_rad
        unlimited_n = desired_n * min(max(fade, 0.0), 1.0)
        max_change_n = parameters.propulsion_rate_n_s * observation.period_s
        unlimited_n = min(max(unlimited_n, self._unlimited_n - max_change_n), self._unlimited_n + max_change_n)
        self._unlimited_n = unlimited_n

        force_n = min(unlimited_n, limit_nm / max(abs(torque_per_n), MIN_TORQUE_PER_N))
        torque_nm = force_n * torque_per_n - parameters.damping_nm_s_per_rad * observation.joints.velocity_rad_s[joint]
        torque_nm = min(max(self._hand_over.torque_nm(torque_nm), -limit_nm), limit_nm)
        return PropulsionDemand(
            joint=joint,
            desired_n=desired_n,
            force_n=force_n,
            torque_nm=torque_nm,
            saturated=force_n < unlimited_n,
            swung=fade < 1.0,
        )

    # --- push-points and triplets --------------------------------------------------------------------------------

    def _update_push_points(self, located: Located, body_pose: BodyPose) -> None:
        """Plan the contacts with the obstacles near the body, and find those that the body can push off now.

        Obstacles that the body touches or pushes off already remain push-points up to a wider gap, `give_up_gap_m`.

        Args:
            located: position of the body, with the new world model.
            body_pose: the pose on the path that the joints follow.
        """
        if located.restarted:
            self._planned.clear()
        self._update_planned(located)
        retained = [contact.obstacle for contact in located.world.contacts if contact.obstacle is not None]
        if self._choice is not None:
            retained += self._choice.triplet.names
        self._points = find_push_points(
            [contact for _, contact in self._planned.values()],
            retained,
            body_pose,
            located.nodes_w,
            self._body.node_s_m,
            gap_m=self.parameters.gap_m,
            give_up_gap_m=self.parameters.give_up_gap_m,
            end_m=self.parameters.end_m,
        )

    def _update_planned(self, located: Located) -> None:
        """Plan contacts with obstacles that are new or have changed, and drop those of obstacles that are gone."""
        obstacles = {obstacle.name: obstacle for obstacle in located.world.obstacles}
        for name in list(self._planned):
            if name not in obstacles:
                del self._planned[name]
        for name, obstacle in obstacles.items():
            known = self._planned.get(name)
            if known is None or known[0] != obstacle:
                self._planned[name] = (obstacle, self._plan_contact(located, obstacle))

    def _plan_contact(self, located: Located, obstacle: Obstacle) -> PlannedContact:
        half_length_m = self._body.length_m / 2
        return plan_contact(
            located.on_path.route,
            obstacle,
            self._body.radius_m,
            near_s_m=located.tail_s_m + half_length_m,
            window_m=half_length_m + PLAN_WINDOW_M,
        )

    def _update_choice(self, observation: Observation, located: Located, body_pose: BodyPose) -> None:
        """Choose the triplet that propels, with its joint, from the present push-points; `_choice` is None without one.

        No triplet is chosen if no motion is desired, or for some time after a stall. A triplet at which the body was
        stationary is chosen only if there is no other.

        Args:
            observation: the inputs of this tick.
            located: position of the body on the path, and the desired speed.
            body_pose: the pose on the path that the joints follow.
        """
        self._expire_restrictions(observation.time_s, located.tail_s_m)
        barred_joint = None
        if self._barred is not None:
            barred_joint, _ = self._barred
        choices, self._refused = self._triplets.find_choices(
            self._points, body_pose.nodes_w, self._body.node_s_m, self._choice, barred_joint
        )
        if located.trajectory.speed_m_s <= 0 or observation.time_s < self._position_until_s:
            self._choice = None
            return
        present_triplet = None
        if self._choice is not None:
            present_triplet = self._choice.triplet
        switch_fraction = self.parameters.switch_fraction
        choice = choose_triplet(choices, present_triplet, switch_fraction=switch_fraction, banned=self._banned)
        if choice is None:  # a banned triplet is better than none
            choice = choose_triplet(choices, present_triplet, switch_fraction=switch_fraction)
        self._choice = choice

    def _expire_restrictions(self, time_s: float, tail_s_m: float) -> None:
        """Forget stalls and bans that lie `blend_m` of travel back, and a barred joint whose time is over."""
        blend_m = self.parameters.blend_m
        self._banned = {names: s_m for names, s_m in self._banned.items() if abs(tail_s_m - s_m) < blend_m}
        if self._stall is not None and abs(tail_s_m - self._stall[1]) > blend_m:
            self._stall = None
        if self._barred is not None and time_s >= self._barred[1]:
            self._barred = None

    # --- supervision ---------------------------------------------------------------------------------------------

    def _release_swung_joint(self, observation: Observation, body_pose: BodyPose) -> None:
        """Return a propulsion joint to position mode if it has left its reference too far."""
        if self._choice is None:
            return
        joint = self._choice.joint
        guard_s = self.parameters.guard_s
        robot_joint = self._body.bends[joint]
        swing_rad = observation.joints.angle_rad[robot_joint] - float(body_pose.angles_rad[joint])
        if abs(swing_rad) > self.parameters.angle_guard_rad:
            self._barred = (joint, observation.time_s + guard_s)
            name = self._body.names[robot_joint]
            self._refused = [f"{name} left its reference by {swing_rad:+.2f} rad; in position mode for {guard_s} s"]
            self._choice = None

    def _watch_stall(
        self, observation: Observation, located: Located, choice: Choice, demand: PropulsionDemand
    ) -> None:
        """Detect a standstill while pushing, and release a triplet that is strained but does not move the body.

        A released triplet is banned near this place, and all joints go to position mode for `release_s`.

        Args:
            observation: the inputs of this tick.
            located: position of the body on the path.
            choice: the triplet that propels.
            demand: force and torque of the propulsion joint, and which limit applied.
        """
        if not self._stall_watch.has_stalled(observation.time_s, located.tail_s_m, demand.desired_n):
            return
        self._stall_watch.reset()
        joint_name = self._body.names[demand.joint]
        stall = explain(
            desired_n=demand.desired_n,
            force_n=demand.force_n,
            net_force=self._contacts.resolve_along(choice.triplet.contacts[0].tangent_w),
            push_points=choice.triplet.names,
            weight_n=self._body.weight_n,
            saturated=joint_name if demand.saturated else None,
            swung=joint_name if demand.swung else None,
            jam_force_n=self.parameters.jam_force_n,
            drag_ratio=self.parameters.drag_ratio,
        )
        self._stall = (stall, located.tail_s_m)
        if stall.release_triplet:
            self._banned[choice.triplet.names] = located.tail_s_m
            self._position_until_s = observation.time_s + self.parameters.release_s

    def _wait(self, observation: Observation, why: str) -> ControllerCommand:
        """Command every joint to its reference angle without propulsion, while the position of the body is unknown.

        The first call takes the measured angles as reference. Later calls fade out what the last push added to the
        targets.

        Args:
            observation: the inputs of this tick.
            why: why the position is unknown, for the telemetry.

        Returns:
            Position setpoints of all joints.
        """
        self._choice = None
        self._unlimited_n = 0.0
        self._force_n = 0.0
        self._stall_watch.reset()
        if not len(self._reference):
            self._reference = np.array(observation.joints.angle_rad)
            self._hand_over.start(observation.joints, self._reference)
        # The load compensation becomes part of the offset, which fades.
        self._hand_over.shift(-self._load_nm / self._stiffness)
        self._load_nm = np.zeros(len(self._load_nm))
        self._hand_over.pass_to(None, observation.joints, self._reference)
        self._hand_over.fade(observation.period_s / self.parameters.blend_s)
        targets = self._hand_over.positions_rad(self._reference).tolist()
        return ControllerCommand(
            positions(self.robot, targets), Telemetry(reason=why, reference_rad=self._reference.tolist())
        )

    # --- reports -------------------------------------------------------------------------------------------------

    def _report_rest(self, located: Located) -> Telemetry:
        """Report why no joint pushes."""
        return Telemetry(
            reason=self._explain_rest(located.trajectory.speed_m_s)[:MAX_REASON],
            usable_push_points=len(self._points),
            path_s_m=located.tail_s_m,
            reference_rad=self._reference.tolist(),
            jammed=self._is_jammed(),
        )

    def _explain_rest(self, desired_m_s: float) -> str:
        if self._stall is not None:
            stall, _ = self._stall
            return stall.reason
        if desired_m_s > 0:
            return "; ".join(self._refused) or "no three push-points on alternating sides"
        if desired_m_s == 0:
            return ""
        return "cannot go backward"

    def _is_jammed(self) -> bool:
        return self._stall is not None and self._stall[0].jammed

    def _report_push(
        self, located: Located, body_pose: BodyPose, choice: Choice, demand: PropulsionDemand
    ) -> Telemetry:
        """Return the telemetry of a tick in which a triplet propels: its joint, its contacts and its forces.

        Args:
            located: position of the body on the path, and the world model.
            body_pose: the pose on the path that the joints follow.
            choice: the triplet that propels.
            demand: force and torque of the propulsion joint, and which limit applied.

        Returns:
            The telemetry, with contact forces in N, and with the torque margin at full propulsion in N·m.
        """
        stall_reason = ""
        if self._stall is not None:
            stall, _ = self._stall
            stall_reason = stall.reason
        forces_n: list[float] = (demand.force_n * choice.triplet.unit.forces).tolist()
        full_torque_nm = abs(self.parameters.propulsion_n * choice.torque_per_n)
        return Telemetry(
            reason=stall_reason,
            usable_push_points=len(self._points),
            path_s_m=located.tail_s_m,
            propulsion_joint=demand.joint,
            propulsion_n=demand.force_n,
            push_points=make_contact_messages(self._body, located.world, choice, forces_n),
            desired_force_n=forces_n,
            propulsion_torque_nm=demand.torque_nm,
            bending_torque_nm=compute_bending_nm(self._body, body_pose, choice, demand.force_n).tolist(),
            reference_rad=self._reference.tolist(),
            condition=choice.triplet.unit.condition,
            torque_headroom_nm=self._body.torque_limit_nm[demand.joint] - full_torque_nm,
            saturated=demand.saturated,
            jammed=self._is_jammed(),
        )
