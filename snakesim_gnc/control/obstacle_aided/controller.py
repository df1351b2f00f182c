"""Obstacle-aided propulsion with all joints: forces on the obstacles, and the shape slightly further along the path.

A body that obstacles hold on its path has one degree of freedom, its arc length s on the path. A force F along the path
controls its speed (`push_control.py`). F is distributed to the obstacles near the body, and the joint torques tau_push
produce these forces (`push.py`).

If the obstacles can balance the push and the drives have a torque mode, the joints are in torque mode:

    tau = tau_push + tau_shape,    tau_shape = k (theta(s) - q) + d (theta' v - q')

without the component of tau_shape along the path, so that the desired forces are reached (`torque_mode.py`). With
`drive_damping`, the drives damp these torques: they are in position mode, with the targets q + tau / kp. The joints
ahead of all pushing contacts may follow the path more strictly (`front_steering.py`).

Otherwise the joints are in position mode, with the target theta(s + l) + tau_push / kp. The torques then only close
gaps, and the shape itself pushes, by its look-ahead l (`look_ahead.py`): tau_i = kp_i (theta_i(s + l) - theta_i(s)),
hence by virtual work with the force l sum_i kp_i theta_i'^2.

A negative speed moves the body backward along its own path. A body that does not advance moves by a wave until it lies
where it can push (`contact_search.py`). See `docs/concepts/propulsion-control.md`.
"""

import numpy as np

from snakesim_gnc.control.bumpless import BumplessFollower
from snakesim_gnc.control.climb import PlatformClimb
from snakesim_gnc.control.obstacle_aided.contact_search import ContactSearch
from snakesim_gnc.control.obstacle_aided.front_steering import FrontSteering
from snakesim_gnc.control.obstacle_aided.look_ahead import LookAhead
from snakesim_gnc.control.obstacle_aided.parameters import ObstacleAidedParameters
from snakesim_gnc.control.obstacle_aided.push_control import PushControl
from snakesim_gnc.control.obstacle_aided.push_report import PushReporter
from snakesim_gnc.control.obstacle_aided.torque_mode import (
    compute_damped_target_rad,
    compute_shape_torques_nm,
)
from snakesim_gnc.control.progress import BodyLocation, PathProgress
from snakesim_gnc.control.undulation import LateralUndulation
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry
from snakesim_hal.wire.messages import JointMode, RobotDescription

# A new path whose reference differs more than this starts with a small look-ahead.
MAX_CONTINUOUS_CHANGE_RAD = 0.1
DERIVATIVE_STEP_M = 0.02  # step of the finite difference for theta'
RANDOM_SIGNS = np.random.default_rng(1).choice((-1.0, 1.0), 4096)  # the same in every run

# Fraction of a push that may be unbalanced in torque mode.
MAX_UNBALANCED_RATIO_IN_TORQUE_MODE = 0.03
MIN_BALANCED_DURATION_S = 0.1  # how long contacts must have been able to balance a push before


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
        # The body, and where it is.
        self._body = PlanarBody(robot)
        self._yaw_joints = self._body.yaw_joints  # indices of the joints that bend
        self._platform_climb = PlatformClimb(robot)
        self._progress = PathProgress(self._body, speed_filter_s=parameters.speed_filter_s)
        # How it pushes along its path.
        self._look_ahead = LookAhead(parameters)
        self._push_control = PushControl(self._body, len(robot.joints), parameters)
        self._push_reporter = PushReporter(self._body, parameters.max_torque_nm)
        # Joints in position mode.
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._bumpless_follower = BumplessFollower(robot, parameters.blend_s)
        self._is_holding = False  # the joints hold a pose; the next reference may jump
        self._front_steering = FrontSteering(
            robot,
            self._body,
            correction_m=parameters.front_correction_m,
            blend_s=parameters.blend_s,
        )
        # Joints in torque mode.
        self._has_torque_mode = all(
            robot.joints[i].supports_mode(JointMode.TORQUE) for i in self._yaw_joints
        )
        self._last_unbalanced_time_s = 0.0  # when the contacts could last not balance a push
        # What moves a body that does not advance.
        self._contact_search = ContactSearch(
            robot,
            standstill_duration_s=parameters.search_after_s,
            search_duration_s=parameters.search_s,
        )

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the joint setpoints that move the body along the path at the desired speed.

        While its position on the path is unknown, or no motion is desired, the joints hold their pose. If the body
        stays stationary, a contact-search gait moves it. Otherwise it follows its path, and pushes off obstacles.

        Args:
            observation: The inputs of this tick.

        Returns:
            Setpoints of all joints, with telemetry about push and contacts.
        """
        location = self._progress.update(observation)
        if isinstance(location, str):  # why the position is unknown
            self._is_holding = True
            return self._bumpless_follower.hold_pose(observation, location)
        self._push_control.measured_contacts.add_world(location.world)
        desired_m_s = location.trajectory.speed_m_s
        if desired_m_s == 0.0:  # whatever path is planned meanwhile
            return self._command_rest(observation)
        pitch_rad = self._platform_climb.compute_pitch_angles_rad(
            location.trajectory.rises, location.tail_s_m
        )
        wave = self._contact_search.choose_wave(
            observation,
            location.body_points_w.mean(axis=1),
            desired_m_s=desired_m_s,
            has_near_obstacles=self._push_control.has_near_obstacles,
        )
        if wave is not None:
            return self._command_search_wave(observation, wave, pitch_rad)
        return self._command_push(observation, location, pitch_rad)

    # --- along the path ------------------------------------------------------------------------------------------

    def _command_push(
        self, observation: Observation, location: BodyLocation, pitch_rad: Floats
    ) -> ControllerCommand:
        """Command the body to follow its path and to push off obstacles, in torque mode if it can.

        The joints follow angles of the body further along the path, plus the torques of a push against obstacles. While
        the body can be soft, torques are commanded instead of angles.

        Args:
            observation: The inputs of this tick.
            location: Position and speed of the body on the path.
            pitch_rad: (n_joints,) pitch angles over platforms, which are added to the angles on the path.
        """
        scale = self.parameters.push_scale * self._get_push_sign(observation.time_s)
        look_ahead_m = self._look_ahead.update(location, observation.period_s)
        if scale < 0:
            look_ahead_m = abs(look_ahead_m)  # a negative scale always pushes backward
        look_ahead_m = scale * look_ahead_m
        theta = self._compute_angles_on_path(location, location.tail_s_m)  # joint angles, rad
        theta_ahead = self._compute_angles_on_path(location, location.tail_s_m + DERIVATIVE_STEP_M)
        # Derivative by the arc length, rad/m.
        theta_prime = (theta_ahead - theta) / DERIVATIVE_STEP_M
        push_torques_nm = scale * self._push_control.update(observation, location, theta_prime)
        self._front_steering.update(location, self._push_control.snapshot, observation.period_s)
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

    def _get_push_sign(self, time_s: float) -> float:
        """Return the sign of the push at a time: 1, or -1 or 1 at random for control experiments.

        Random signs are the same in every run.
        """
        interval_s = self.parameters.push_sign_s
        if interval_s == 0.0:
            return 1.0
        return float(RANDOM_SIGNS[int(time_s / interval_s) % len(RANDOM_SIGNS)])

    def _can_use_torque_mode(self, time_s: float) -> bool:
        """Return whether the joints can be in torque mode at this time.

        They can if the drives have a torque mode, and obstacles have been able to balance a push for at least
        MIN_BALANCED_DURATION_S.
        """
        if not self._has_torque_mode or self.parameters.shape_nm_per_rad <= 0.0:
            return False
        snapshot = self._push_control.snapshot
        if snapshot is None or snapshot.push.balance_residual > MAX_UNBALANCED_RATIO_IN_TORQUE_MODE:
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
        """Command the torques tau_push + tau_shape to the joints that bend; the front follows theta in position mode.

        Args:
            observation: The inputs of this tick, with the joint angles q and velocities q'.
            location: Position of the body on the path, and its speed v.
            theta: (n_joints,) joint angles of the body on the path, rad, with the corrections of the front.
            theta_prime: (n_joints,) their derivatives by the arc length, rad/m.
            push_torques_nm: (n_joints,) tau_push.
        """
        pushing_joints = [i for i in self._yaw_joints if i not in self._front_steering.joints]
        shape_nm = compute_shape_torques_nm(
            observation, theta, theta_prime, location.speed_m_s, pushing_joints, self.parameters
        )
        setpoints = self._bumpless_follower.make_setpoints(observation, theta)
        self._bumpless_follower.leave_position_mode()
        self._look_ahead.limit_for_new_path()
        self._is_holding = False
        front_targets_rad = self._front_steering.compute_targets_rad(
            observation, theta, theta_prime * location.speed_m_s
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
                setpoints.target[i] = compute_damped_target_rad(
                    self.robot.joints[i],
                    observation.joints.angle_rad[i],
                    torque_nm,
                    float(theta_prime[i]) * damped_speed_m_s,
                )
            else:
                setpoints.mode[i] = JointMode.TORQUE
                setpoints.target[i] = torque_nm
        return ControllerCommand(setpoints, self._report_push(observation, location, 0.0, theta))

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
            self._look_ahead.limit_for_new_path()
        setpoints = self._bumpless_follower.make_setpoints(
            observation, reference, may_have_jumped=may_have_jumped
        )
        self._is_holding = False
        return ControllerCommand(
            setpoints, self._report_push(observation, location, look_ahead_n, reference)
        )

    def _report_push(
        self,
        observation: Observation,
        location: BodyLocation,
        look_ahead_n: float,
        reference: Floats,
    ) -> Telemetry:
        return self._push_reporter.make_telemetry(
            observation, location, self._push_control, look_ahead_n, reference
        )

    # --- without a push ------------------------------------------------------------------------------------------

    def _command_search_wave(
        self, observation: Observation, wave: LateralUndulation, pitch_rad: Floats
    ) -> ControllerCommand:
        """Command the next angles of a wave that searches for obstacles to push off.

        Args:
            observation: The inputs of this tick.
            wave: The wave that moves the body.
            pitch_rad: (n_joints,) pitch angles over platforms, which are added to the wave.
        """
        self._push_control.reset()
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
        self._push_control.reset()
        self._look_ahead.reset()
        self._push_reporter.start_rest(observation.time_s)
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
