"""Obstacle-aided propulsion with all joints: forces on the obstacles, and the shape slightly further along the path.

A body that obstacles hold on its path has one degree of freedom, its arc length s on the path. A bounded PI law of the
speed error e = v_wanted - v gives the force F along the path:

    F = lag_kp integral e dt + speed_kp e,    0 <= F <= what contacts and torque limits allow

`push.py` distributes F to the obstacles near the body, and finds the joint torques tau_push that produce these forces.

If the obstacles can balance the push and the drives have a torque mode, the joints are in torque mode:

    tau = tau_push + tau_shape,    tau_shape = k (theta(s) - q) + d (theta' v - q')

with gains k and d so low that obstacles decide the shape. The component of tau_shape along theta' is removed, so that
the shape does not push along the path and the desired forces are reached. With `drive_damping`, the drives damp these
torques: they are in position mode, with the targets q + tau / kp. The joints ahead of all pushing contacts may follow
the path more strictly (`front_steering.py`).

Otherwise the joints are in position mode, with the target theta(s + l) + tau_push / kp. The torques then only close
gaps, and the shape itself pushes, by its look-ahead l: tau_i = kp_i (theta_i(s + l) - theta_i(s)), hence by virtual
work with the force l sum_i kp_i theta_i'^2. The look-ahead follows a PI law of e, too.

A negative speed moves the body backward along its own path. A body that does not advance moves by a wave until it lies
where it can push (`contact_search.py`). See `docs/concepts/propulsion-control.md`.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta

from snakesim_gnc.control.bumpless import Blend, BumplessFollower
from snakesim_gnc.control.climb import PlatformClimb
from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.contact_search import ContactSearch
from snakesim_gnc.control.front_steering import FrontSteering
from snakesim_gnc.control.progress import BodyLocation, PathProgress, SpeedFilter
from snakesim_gnc.control.push import (
    PushLowPassFilter,
    PushSnapshot,
    find_body_contacts,
    solve_push,
)
from snakesim_gnc.control.push_report import explain_push_standstill, make_push_point_messages
from snakesim_gnc.control.undulation import LateralUndulation
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import JointMode, RobotDescription, WorldContact
from snakesim_hal.wire.quantities import above, from_zero

# A new path whose reference differs more than this starts with a small look-ahead.
MAX_CONTINUOUS_CHANGE_RAD = 0.1
DERIVATIVE_STEP_M = 0.02  # step of the finite difference for theta'
RANDOM_SIGNS = np.random.default_rng(1).choice((-1.0, 1.0), 4096)  # the same in every run

# Which contacts push, and how hard.
# Fraction of a push; the rest turns the body a little, until it touches other obstacles.
MAX_UNBALANCED_RATIO = 0.3
# At this measured force, the extra cost of a contact without force has fallen to 1/e.
CONTACT_FORCE_SCALE_N = 0.5
ACTUATION_DELAY_S = 0.03  # from a measurement until the motors act on it
# Below it, the integral of the push grows CREEP_INTEGRAL_GAIN times as fast.
MAX_CREEP_SPEED_M_S = 0.05
CREEP_INTEGRAL_GAIN = 2.0

# Torque mode.
# Fraction of a push that may be unbalanced in torque mode.
MAX_UNBALANCED_RATIO_IN_TORQUE_MODE = 0.03
MIN_BALANCED_DURATION_S = 0.1  # how long contacts must have been able to balance a push before
# Sum of theta'^2 below which the shape hardly depends on the place on the path.
MIN_SLOPE_SQUARED_PER_M2 = 20.0

# Reports.
# A body that was slower than this for MIN_STANDSTILL_DURATION_S is reported as stationary.
MAX_STANDSTILL_SPEED_M_S = 0.01
MIN_STANDSTILL_DURATION_S = 0.5


class ObstacleAidedParameters(FileStruct, frozen=True, kw_only=True):
    """Parameters. The bound of the look-ahead limits how hard the shape pushes."""

    speed_kp_s: Annotated[float, from_zero(5, "s")] = 0.2
    """Look-ahead of the shape for each m/s that the speed is too low."""

    integral_per_s: Annotated[float, from_zero(50, "1/s")] = 0.4
    """Rate at which the look-ahead grows while the speed stays too low."""

    max_look_ahead_m: Annotated[float, from_zero(1, "m")] = 0.05
    """Maximum look-ahead of the shape along its path. It limits how hard the shape pushes."""

    fresh_look_ahead_m: Annotated[float, from_zero(1, "m")] = 0.01
    """Look-ahead at the start of a new path."""

    push_scale: Annotated[float, Meta(ge=-1, le=1)] = 1.0
    """Factor of both pushing terms, for control experiments. Negative: backward."""

    push_sign_s: Annotated[float, from_zero(100, "s")] = 0.0
    """Time after which the sign of the push is drawn at random again, for control experiments. 0: never."""

    speed_kp_n_s_per_m: Annotated[float, from_zero(1000, "N*s/m")] = 25.0
    """Push on obstacles for each m/s that the speed is too low."""

    lag_kp_n_per_m: Annotated[float, from_zero(1000, "N/m")] = 60.0
    """Push on obstacles for each meter that the body has fallen behind."""

    max_push_n: Annotated[float, from_zero(1000, "N")] = 60.0
    """Maximum push along the path."""

    max_torque_nm: Annotated[float, from_zero(1000, "N*m")] = 5.0
    """Maximum torque of a joint for pushing."""

    max_contact_n: Annotated[float, above(1000, "N")] = 60.0
    """Maximum desired force on one contact."""

    reach_m: Annotated[float, above(1, "m")] = 0.03
    """Maximum gap between the body and an obstacle that is pushed."""

    contact_gap_scale_m: Annotated[float, above(1, "m")] = 0.005
    """Gap to an obstacle at which a contact counts half."""

    push_filter_s: Annotated[float, above(5, "s")] = 0.05
    """Time constant of the filter of how the push is shared among contacts."""

    torque_filter_s: Annotated[float, above(5, "s")] = 0.03
    """Time constant of the filter of the pushing torques."""

    search_after_s: Annotated[float, from_zero(1000, "s")] = 1.2
    """Time with less than 2 cm of advance after which the body searches for contacts by a wave. 0: never."""

    search_s: Annotated[float, above(1000, "s")] = 30.0
    """Duration of a search, after which the body tries its path again."""

    blend_s: Blend = 0.3
    """Time over which the command changes smoothly to a new reference."""

    speed_filter_s: SpeedFilter = 0.05
    """Time constant of the filter of the speed along the path. 0: no filter."""

    no_contact_cost: Annotated[float, from_zero(1000, "1")] = 10.0
    """Additional cost of a force on an obstacle without measured contact. 0: it costs as much as on others."""

    shape_nm_per_rad: Annotated[float, from_zero(1000, "N*m/rad")] = 1.5
    """Stiffness of the shape in torque mode. 0: always position mode, as stiff as the drives are."""

    shape_nm_s_per_rad: Annotated[float, from_zero(1000, "N*m*s/rad")] = 0.1
    """Damping of the shape in torque mode."""

    drive_damping: bool = False
    """True: the torques of torque mode are commanded as position targets, relative to the measured angles. The drives
    then resist fast bending, so that the shape may be stiffer.
    """

    front_correction_m: Annotated[float, from_zero(10, "m")] = 0.0
    """Distance over which the body ahead of all pushing contacts is led back to the path. 0: no such steering."""


class ObstacleAided(Controller[ObstacleAidedParameters]):
    """Controls the speed along the path with all joints."""

    Parameters = ObstacleAidedParameters

    def __init__(self, robot: RobotDescription, parameters: ObstacleAidedParameters) -> None:
        """Create a controller that moves the body along a planned path by pushing off obstacles.

        It starts with all integrals and forces at zero, before the first measurement.

        Args:
            robot: Description of the robot; the joints with a vertical axis bend the body.
            parameters: Gains, limits and time constants of this controller.
        """
        super().__init__(robot, parameters)
        # Models and estimators.
        self._body = PlanarBody(robot)
        self._platform_climb = PlatformClimb(robot)
        self._progress = PathProgress(self._body, speed_filter_s=parameters.speed_filter_s)
        self._measured_contacts = MeasuredContacts()
        # Joints.
        self._yaw_joints = self._body.yaw_joints  # indices of the joints that bend
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._damping = np.array([joint.damping_nm_s_per_rad for joint in robot.joints])
        self._has_torque_mode = all(
            robot.joints[i].supports_mode(JointMode.TORQUE) for i in self._yaw_joints
        )
        self._bumpless_follower = BumplessFollower(robot, parameters.blend_s)
        self._is_holding = False  # the joints hold a pose; the next reference may jump
        self._front_steering = FrontSteering(
            robot,
            self._body,
            correction_m=parameters.front_correction_m,
            blend_s=parameters.blend_s,
        )
        # Look-ahead.
        self._look_ahead_integral_m = 0.0
        # Push along the path.
        self._push_filter = PushLowPassFilter(parameters.push_filter_s)
        self._push_snapshot: PushSnapshot | None = None
        self._unit_torques_nm = np.zeros(len(robot.joints))  # joint torques for 1 N along the path
        # Filtered joint torques of the commanded push.
        self._push_torques_nm = np.zeros(len(robot.joints))
        self._push_integral_n = 0.0
        self._max_push_force_n = 0.0  # what contacts and torque limits allow
        self._push_force_n = 0.0  # commanded push
        self._last_unbalanced_time_s = 0.0  # when the contacts could last not balance a push
        # Supervision.
        # When the body was last faster than MAX_STANDSTILL_SPEED_M_S.
        self._last_motion_time_s = 0.0
        self._contact_search = ContactSearch(
            robot,
            standstill_duration_s=parameters.search_after_s,
            search_duration_s=parameters.search_s,
        )

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the joint setpoints that move the body along the path at the desired speed.

        The joints follow angles of the body further along the path, plus the torques of a push against obstacles. While
        the body can be soft, it commands torques instead of angles. If the body stays stationary, a contact-search gait
        moves it. While its position on the path is unknown, or no motion is desired, the joints hold their pose.

        Args:
            observation: The inputs of this tick.

        Returns:
            Setpoints of all joints, with telemetry about push and contacts.
        """
        location = self._progress.update(observation)
        if isinstance(location, str):  # why the position is unknown
            self._is_holding = True
            return self._bumpless_follower.hold_pose(observation, location)
        self._measured_contacts.add_world(location.world)
        desired_m_s = location.trajectory.speed_m_s
        if desired_m_s == 0.0:  # whatever path is planned meanwhile
            return self._command_rest(observation)
        pitch_rad = self._platform_climb.compute_pitch_angles_rad(
            location.trajectory.rises, location.tail_s_m
        )
        center_w = location.body_points_w.mean(axis=1)
        wave = self._contact_search.choose_wave(
            observation,
            center_w,
            desired_m_s=desired_m_s,
            has_near_obstacles=self._has_near_obstacles(),
        )
        if wave is not None:
            return self._command_search_wave(observation, wave, pitch_rad)

        scale = self.parameters.push_scale * self._get_push_sign(observation.time_s)
        look_ahead_m = self._update_look_ahead(location, observation.period_s)
        if scale < 0:
            look_ahead_m = abs(look_ahead_m)  # a negative scale always pushes backward
        look_ahead_m = scale * look_ahead_m
        theta = self._compute_angles_on_path(location, location.tail_s_m)  # joint angles, rad
        theta_ahead = self._compute_angles_on_path(location, location.tail_s_m + DERIVATIVE_STEP_M)
        # Derivative by the arc length, rad/m.
        theta_prime = (theta_ahead - theta) / DERIVATIVE_STEP_M
        push_torques_nm = scale * self._update_push_torques(observation, location, theta_prime)
        self._front_steering.update(location, self._push_snapshot, observation.period_s)
        theta = theta + self._front_steering.corrections_rad
        if self._can_use_torque_mode(observation.time_s) and not pitch_rad.any():
            return self._command_torques(observation, location, theta, theta_prime, push_torques_nm)
        reference = self._compute_angles_on_path(location, location.tail_s_m + look_ahead_m)
        reference = reference + self._front_steering.corrections_rad
        reference = reference + push_torques_nm / self._stiffness + pitch_rad
        look_ahead_n = look_ahead_m * float(self._stiffness @ theta_prime**2)
        return self._command_positions(observation, location, reference, look_ahead_n)

    def _compute_angles_on_path(self, location: BodyLocation, tail_s_m: float) -> Floats:
        """Compute theta(s), (n_joints,) in rad: the angles of all joints with the tail at an arc length of the path."""
        return self._body.expand_joint_angles(location.body_on_path.compute_pose_at(tail_s_m))

    def _has_near_obstacles(self) -> bool:
        return self._push_snapshot is not None and len(self._push_snapshot.contacts) > 0

    def _get_push_sign(self, time_s: float) -> float:
        """Return the sign of the push at a time: 1, or -1 or 1 at random for control experiments.

        Random signs are the same in every run.
        """
        interval_s = self.parameters.push_sign_s
        if interval_s == 0.0:
            return 1.0
        return float(RANDOM_SIGNS[int(time_s / interval_s) % len(RANDOM_SIGNS)])

    # --- commands ------------------------------------------------------------------------------------------------

    def _can_use_torque_mode(self, time_s: float) -> bool:
        """Return whether the joints can be in torque mode at this time.

        They can if the drives have a torque mode, and obstacles have been able to balance a push for at least
        MIN_BALANCED_DURATION_S.
        """
        if not self._has_torque_mode or self.parameters.shape_nm_per_rad <= 0.0:
            return False
        if (
            self._push_snapshot is None
            or self._push_snapshot.push.balance_residual > MAX_UNBALANCED_RATIO_IN_TORQUE_MODE
        ):
            self._last_unbalanced_time_s = time_s
        return time_s - self._last_unbalanced_time_s > MIN_BALANCED_DURATION_S

    def _command_torques(
        self,
        observation: Observation,
        location: BodyLocation,
        theta: Floats,
        theta_prime: Floats,
        push_torques_nm: Floats,
    ) -> ControllerCommand:
        """Command the torques tau_push + tau_shape to the joints that bend.

        tau_shape = k (theta - q) + d (theta' v - q') holds the shape of the body. Its component along theta', which
        would move the body along the path, is removed. The joints of the front follow theta in position mode instead.

        Args:
            observation: The inputs of this tick, with the joint angles q and velocities q'.
            location: Position of the body on the path, and its speed v.
            theta: (n_joints,) joint angles of the body on the path, rad, with the corrections of the front.
            theta_prime: (n_joints,) their derivatives by the arc length, rad/m.
            push_torques_nm: (n_joints,) tau_push.
        """
        k = self.parameters.shape_nm_per_rad
        d = self.parameters.shape_nm_s_per_rad
        angle_error_rad = theta - np.array(observation.joints.angle_rad)
        velocity_error_rad_s = theta_prime * location.speed_m_s - np.array(
            observation.joints.velocity_rad_s
        )
        shape_nm = k * angle_error_rad + d * velocity_error_rad_s
        pushing_joints = [i for i in self._yaw_joints if i not in self._front_steering.joints]
        slope = theta_prime[pushing_joints]
        # Force of tau_shape along the path, by virtual work.
        along_n = float(slope @ shape_nm[pushing_joints])
        shape_nm = shape_nm - theta_prime * along_n / (slope @ slope + MIN_SLOPE_SQUARED_PER_M2)

        setpoints = self._bumpless_follower.make_setpoints(observation, theta)
        self._bumpless_follower.leave_position_mode()
        self._limit_look_ahead_integral()
        self._is_holding = False
        velocity_rad_s = theta_prime * location.speed_m_s
        front_targets_rad = self._front_steering.compute_targets_rad(
            observation, theta, velocity_rad_s
        )
        for i, target_rad in front_targets_rad.items():
            setpoints.target[i] = target_rad
        # A body that is too fast must be braked by the damping, not driven on.
        damped_speed_m_s = min(location.speed_m_s, location.trajectory.speed_m_s)
        for i in pushing_joints:
            limit_nm = setpoints.torque_limit_nm[i]
            torque_nm = float(shape_nm[i] + push_torques_nm[i])
            torque_nm = min(max(torque_nm, -limit_nm), limit_nm)
            if self.parameters.drive_damping:
                setpoints.target[i] = self._compute_damped_target_rad(
                    i,
                    observation.joints.angle_rad[i],
                    torque_nm,
                    float(theta_prime[i]) * damped_speed_m_s,
                )
            else:
                setpoints.mode[i] = JointMode.TORQUE
                setpoints.target[i] = torque_nm
        return ControllerCommand(setpoints, self._make_telemetry(observation, location, 0.0, theta))

    def _compute_damped_target_rad(
        self, joint: int, angle_rad: float, torque_nm: float, velocity_rad_s: float
    ) -> float:
        """Compute the position target with which the drive of a joint produces a torque.

        The drive works against kp (q(t) - q(t - delay)) + kd q'. This damping is wanted, but not against the motion
        along the path. The torque that it takes at the velocity of the joint on the path is therefore added.

        Args:
            joint: Index of the joint.
            angle_rad: Its measured angle.
            torque_nm: The torque to produce.
            velocity_rad_s: Velocity of the joint on the path.
        """
        stiffness = float(self._stiffness[joint])
        damping = stiffness * ACTUATION_DELAY_S + float(self._damping[joint])
        return angle_rad + (torque_nm + damping * velocity_rad_s) / stiffness

    def _command_positions(
        self,
        observation: Observation,
        location: BodyLocation,
        reference: Floats,
        look_ahead_n: float,
    ) -> ControllerCommand:
        """Command reference angles in position mode, without a jump of the targets.

        Args:
            observation: The inputs of this tick.
            location: Position of the body on the path.
            reference: (n_joints,) reference angles, rad.
            look_ahead_n: Force along the path that the look-ahead of the reference causes, for the telemetry.
        """
        may_have_jumped = (
            location.may_have_jumped or self._is_holding or self._contact_search.has_changed_wave
        )
        last_reference = self._bumpless_follower.reference_rad
        if (
            may_have_jumped
            and last_reference is not None
            and np.abs(reference - last_reference).max() > MAX_CONTINUOUS_CHANGE_RAD
        ):
            self._limit_look_ahead_integral()
        setpoints = self._bumpless_follower.make_setpoints(
            observation, reference, may_have_jumped=may_have_jumped
        )
        self._is_holding = False
        return ControllerCommand(
            setpoints, self._make_telemetry(observation, location, look_ahead_n, reference)
        )

    def _command_search_wave(
        self, observation: Observation, wave: LateralUndulation, pitch_rad: Floats
    ) -> ControllerCommand:
        """Command the next angles of a wave that searches for obstacles to push off.

        Args:
            observation: The inputs of this tick.
            wave: The wave that moves the body.
            pitch_rad: (n_joints,) pitch angles over platforms, which are added to the wave.
        """
        self._reset_push()
        reference = wave.compute_reference_rad(observation, observation.period_s) + pitch_rad
        setpoints = self._bumpless_follower.make_setpoints(
            observation, reference, may_have_jumped=self._contact_search.has_changed_wave
        )
        reason = "the body does not advance: it moves by a wave, in search of contacts"
        return ControllerCommand(
            setpoints, Telemetry(reason=reason, reference_rad=reference.tolist())
        )

    def _command_rest(self, observation: Observation) -> ControllerCommand:
        """Command every joint to stay where it is, and reset push, look-ahead and search: the desired speed is 0."""
        self._reset_push()
        self._look_ahead_integral_m = 0.0
        self._last_motion_time_s = observation.time_s
        self._contact_search.stop()
        if self._is_holding or self._bumpless_follower.reference_rad is None:
            command = self._bumpless_follower.hold_pose(observation, "")
        else:
            reference = np.array(observation.joints.angle_rad)
            setpoints = self._bumpless_follower.make_setpoints(
                observation, reference, may_have_jumped=True
            )
            command = ControllerCommand(setpoints, Telemetry(reference_rad=reference.tolist()))
        self._is_holding = True
        return command

    def _reset_push(self) -> None:
        self._push_torques_nm[:] = 0.0
        self._push_integral_n = 0.0
        self._push_force_n = 0.0

    # --- look-ahead and push -------------------------------------------------------------------------------------

    def _update_look_ahead(self, location: BodyLocation, period_s: float) -> float:
        """Update the integral of the look-ahead, and return l = speed_kp e + integral_per_s integral e dt in m.

        e is the speed error. The integral and the sum are bounded by `max_look_ahead_m`.
        """
        max_m = self.parameters.max_look_ahead_m
        error_m_s = location.trajectory.speed_m_s - location.speed_m_s
        self._look_ahead_integral_m += self.parameters.integral_per_s * error_m_s * period_s
        self._look_ahead_integral_m = min(max(self._look_ahead_integral_m, -max_m), max_m)
        return min(
            max(self._look_ahead_integral_m + self.parameters.speed_kp_s * error_m_s, -max_m), max_m
        )

    def _limit_look_ahead_integral(self) -> None:
        self._look_ahead_integral_m = min(
            self._look_ahead_integral_m, self.parameters.fresh_look_ahead_m
        )

    def _update_push_torques(
        self, observation: Observation, location: BodyLocation, theta_prime: Floats
    ) -> Floats:
        """Return the filtered joint torques tau_push of a force F along the path that controls the speed.

        F = lag_kp * integral of e dt + speed_kp * e, with the speed error e. F is limited to `max_push_n` and to what
        the contacts and the torque limits allow.

        Args:
            observation: The inputs of this tick.
            location: Position and speed of the body on the path.
            theta_prime: (n_joints,) derivatives of the joint angles by the arc length, rad/m.

        Returns:
            (n_joints,) torques in N·m.
        """
        parameters = self.parameters
        desired_m_s = location.trajectory.speed_m_s
        if desired_m_s <= 0.0 or parameters.max_push_n == 0.0:
            self._push_integral_n = 0.0
            self._push_force_n = 0.0
            self._push_snapshot = None
            return np.zeros(len(self.robot.joints))
        error_m_s = desired_m_s - location.speed_m_s
        integral_gain = 1.0
        if abs(location.speed_m_s) < MAX_CREEP_SPEED_M_S:
            integral_gain = CREEP_INTEGRAL_GAIN
        self._push_integral_n += (
            integral_gain * parameters.lag_kp_n_per_m * error_m_s * observation.period_s
        )
        self._push_integral_n = min(max(self._push_integral_n, 0.0), parameters.max_push_n)
        force_n = self._push_integral_n + parameters.speed_kp_n_s_per_m * error_m_s
        force_n = min(max(force_n, 0.0), parameters.max_push_n)
        if location.is_new_world:
            self._update_contacts(observation.time_s, location, theta_prime)
        # Anti-windup: the integral stays within the force that the contacts allow.
        self._push_integral_n = min(self._push_integral_n, self._max_push_force_n)
        self._push_force_n = min(force_n, self._max_push_force_n)
        decay = np.exp(-observation.period_s / parameters.torque_filter_s)  # of a low-pass filter
        self._push_torques_nm = (
            decay * self._push_torques_nm + (1 - decay) * self._push_force_n * self._unit_torques_nm
        )
        return np.clip(self._push_torques_nm, -parameters.max_torque_nm, parameters.max_torque_nm)

    def _update_contacts(self, time_s: float, location: BodyLocation, theta_prime: Floats) -> None:
        """Find the contacts of a new world model, the push that they allow, and the maximum force of that push.

        Args:
            time_s: Time of this tick.
            location: Position of the body, with the new world model.
            theta_prime: (n_joints,) derivatives of the joint angles by the arc length, rad/m.
        """
        parameters = self.parameters
        obstacles = location.world.obstacles
        body_points_w = self._predict_body_points_w(location)
        contacts = find_body_contacts(
            body_points_w,
            self._body.radius_m,
            ObstacleOutlines.from_obstacles(obstacles),
            max_gap_m=parameters.reach_m,
            friction=location.trajectory.assumed_obstacle_friction,
        )
        obstacle_names = [obstacles[k].name for k in contacts.obstacle_index.tolist()]
        push = solve_push(
            body_points_w,
            contacts,
            theta_prime[self._yaw_joints],
            contact_gap_scale_m=parameters.contact_gap_scale_m,
            extra_cost=self._compute_no_contact_costs(obstacle_names),
        )
        push = self._push_filter.update(time_s, push, obstacle_names)
        self._push_snapshot = PushSnapshot(location.world, contacts, push)
        self._unit_torques_nm = np.zeros(len(self.robot.joints))
        self._max_push_force_n = 0.0
        max_lambda = float(push.contact_forces.max(initial=0.0))
        is_balanced = push.balance_residual < MAX_UNBALANCED_RATIO
        # All contact forces (lambdas) may be 0: a body bent into a U has hardly any drag, and needs no push.
        if is_balanced and max_lambda > 0.0:
            self._unit_torques_nm[self._yaw_joints] = push.joint_torques_nm
            max_unit_nm = float(np.abs(push.joint_torques_nm).max(initial=0.0)) + 1e-9
            self._max_push_force_n = min(
                parameters.max_torque_nm / max_unit_nm, parameters.max_contact_n / max_lambda
            )

    def _predict_body_points_w(self, location: BodyLocation) -> Floats:
        """Predict the points of the body, (2, n_points) in m, at the time when the motors act on this tick's command.

        The body is assumed to move on along its path at its speed for ACTUATION_DELAY_S.
        """
        acting_s_m = location.tail_s_m + ACTUATION_DELAY_S * location.speed_m_s
        on_path = location.body_on_path
        return (
            location.body_points_w
            + on_path.compute_pose_at(acting_s_m).body_points_w
            - on_path.compute_pose_at(location.tail_s_at_pose_m).body_points_w
        )

    def _compute_no_contact_costs(self, obstacles: list[str]) -> Floats | float:
        """Compute the extra costs of contacts that have little measured force.

        The extra cost of a contact is no_contact_cost exp(-force / CONTACT_FORCE_SCALE_N).

        Args:
            obstacles: (k,) names of the obstacles of the contacts.

        Returns:
            (k,) extra costs, or 0.0 if no sensor measures contact forces.
        """
        forces_w = self._measured_contacts.compute_mean_forces_w(obstacles)
        if not forces_w:
            return 0.0
        forces_n = np.hypot(*np.array(forces_w).reshape(-1, 2).T)
        return self.parameters.no_contact_cost * np.exp(-forces_n / CONTACT_FORCE_SCALE_N)

    # --- reports -------------------------------------------------------------------------------------------------

    def _make_telemetry(
        self,
        observation: Observation,
        location: BodyLocation,
        look_ahead_n: float,
        reference: Floats,
    ) -> Telemetry:
        """Report the push along the path, and why the body is stationary if it is.

        Args:
            observation: The inputs of this tick.
            location: Position and speed of the body on the path.
            look_ahead_n: Force along the path that the look-ahead causes.
            reference: (n_joints,) reference angles, rad.

        Returns:
            The telemetry of this tick, with desired contact forces in N and joint torques in N·m.
        """
        if abs(location.speed_m_s) > MAX_STANDSTILL_SPEED_M_S:
            self._last_motion_time_s = observation.time_s
        is_stationary = (
            observation.time_s - self._last_motion_time_s > MIN_STANDSTILL_DURATION_S
            and self._push_snapshot is not None
        )
        points = self._make_push_point_messages()
        jammed, reason = self._explain_standstill(location, points)
        return Telemetry(
            reason=reason if is_stationary else "",
            reason_if_stationary=reason if observation.time_s > MIN_STANDSTILL_DURATION_S else "",
            path_s_m=location.tail_s_m,
            propulsion_n=look_ahead_n + self._push_force_n,
            push_points=points,
            desired_force_n=[float(np.hypot(*contact.force_w[:2])) for contact in points],
            bending_torque_nm=self._push_torques_nm.tolist(),
            reference_rad=reference.tolist(),
            torque_headroom_nm=self.parameters.max_torque_nm
            - float(np.abs(self._push_torques_nm).max()),
            saturated=0.0 < self._max_push_force_n <= self._push_force_n,
            jammed=is_stationary and jammed,
        )

    def _make_push_point_messages(self) -> list[WorldContact]:
        snapshot = self._push_snapshot
        if snapshot is None:
            return []
        return make_push_point_messages(
            self._body, snapshot.world, snapshot.contacts, snapshot.push, self._push_force_n
        )

    def _explain_standstill(
        self, location: BodyLocation, points: list[WorldContact]
    ) -> tuple[bool, str]:
        """Explain why the body would be stationary if it does not move.

        Args:
            location: Position of the body on the path.
            points: Push-points with their desired forces.

        Returns:
            Whether the body is jammed, and the reason as text.
        """
        snapshot = self._push_snapshot
        if snapshot is None:
            return False, "standing still: backing out along its own path"
        names = [point.obstacle for point in points if point.obstacle is not None]
        towards_head_w = (location.body_points_w[:, -1] - location.body_points_w[:, 0]).tolist()
        net_force = self._measured_contacts.resolve_along(towards_head_w)
        return explain_push_standstill(
            snapshot.contacts,
            snapshot.push,
            self._push_force_n,
            self._max_push_force_n,
            net_force,
            names,
        )
