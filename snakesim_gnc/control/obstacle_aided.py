"""Obstacle-aided propulsion with all joints: forces on the obstacles, and the shape slightly further along the path.

A body that obstacles hold on its path has one degree of freedom, its arc length s on the path. A bounded PI law of the
speed error e = v_wanted - v gives the force F along the path:

    F = lag_kp integral e dt + speed_kp e,    0 <= F <= what contacts and torque limits allow

`push.py` distributes F to the obstacles near the body, and finds the joint torques tau_push that produce these forces.

If the obstacles can balance the push and the drives have a torque mode, the joints are in torque mode:

    tau = tau_push + tau_shape,    tau_shape = k (theta(s) - q) + d (theta' v - q')

with gains k and d so low that obstacles decide the shape. The component of tau_shape along theta' is removed, so that
the shape does not push along the path and the desired forces are reached.

Otherwise the joints are in position mode, with the target theta(s + l) + tau_push / kp. The torques then only close
gaps, and the shape itself pushes, by its look-ahead l: tau_i = kp_i (theta_i(s + l) - theta_i(s)), hence by virtual
work with the force l sum_i kp_i theta_i'^2. The look-ahead follows a PI law of e, too.

A negative speed moves the body backward along its own path. A body that does not advance moves by a wave until it lies
where it can push (`contact_search.py`). See `docs/concepts/propulsion-control.md`.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from snakesim_gnc.control.bumpless import Blend, BumplessReference
from snakesim_gnc.control.climb import Climb
from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.contact_search import ContactSearch
from snakesim_gnc.control.progress import Located, PathProgress, SpeedFilter
from snakesim_gnc.control.push import PushFilter, Touches, UnitPush, find_touches, push_forward
from snakesim_gnc.control.push_report import explain_push_standstill, push_points
from snakesim_gnc.control.undulation import LateralUndulation
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Description, Mode, World, WorldContact
from snakesim_hal.wire.quantities import above, from_zero

OTHER_SHAPE_RAD = 0.1  # a new path whose reference differs more than this starts with a small look-ahead
SLOPE_STEP_M = 0.02  # step of the finite difference for theta'
RANDOM_SIGNS = np.random.default_rng(1).choice((-1.0, 1.0), 4096)  # the same in every run

# Which contacts push, and how hard.
MAX_UNBALANCED = 0.3  # fraction of a push; the rest turns the body a little, until it touches other obstacles
CONTACT_FORCE_SCALE_N = 0.5  # at this measured force, the extra cost of a contact without force has fallen to 1/e
ACTUATION_DELAY_S = 0.03  # from a measurement until the motors act on it
CREEP_SPEED_M_S = 0.05  # below it, the integral of the push grows CREEP_GAIN times as fast
CREEP_GAIN = 2.0

# Torque mode.
MAX_UNBALANCED_SOFT = 0.03  # fraction of a push that may be unbalanced in torque mode
SOFT_AFTER_S = 0.1  # how long contacts must have been able to balance a push before
MIN_SLOPE_SQUARED_PER_M2 = 20.0  # sum of theta'^2 below which the shape hardly depends on the place on the path

# Reports.
STANDSTILL_SPEED_M_S = 0.01  # a body that was slower than this for STANDSTILL_S is reported as stationary
STANDSTILL_S = 0.5


@dataclass(frozen=True)
class PushSnapshot:
    """The contacts of a world model, and the push that they allow."""

    world: World
    touches: Touches
    push: UnitPush


class ObstacleAidedParameters(FileStruct, frozen=True, kw_only=True):
    """Parameters; the bound of the look-ahead limits how hard the shape pushes."""

    speed_kp_s: Annotated[float, from_zero(5, "s")] = 0.2
    """Look-ahead of the shape for each m/s that the speed is too low."""

    integral_per_s: Annotated[float, from_zero(50, "1/s")] = 0.4
    """Rate at which the look-ahead grows while the speed stays too low."""

    max_look_ahead_m: Annotated[float, from_zero(1, "m")] = 0.05
    """Maximum look-ahead of the shape along its path; it limits how hard the shape pushes."""

    fresh_look_ahead_m: Annotated[float, from_zero(1, "m")] = 0.01
    """Look-ahead at the start of a new path."""

    push_scale: Annotated[float, Meta(ge=-1, le=1)] = 1.0
    """Factor of both pushing terms, for control experiments; negative: backward."""

    push_sign_s: Annotated[float, from_zero(100, "s")] = 0.0
    """Time after which the sign of the push is drawn at random again, for control experiments; 0: never."""

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
    """Time with less than 2 cm of advance after which the body searches for contacts by a wave; 0: never."""

    search_s: Annotated[float, above(1000, "s")] = 30.0
    """Duration of a search, after which the body tries its path again."""

    blend_s: Blend = 0.3
    """Time over which the command changes smoothly to a new reference."""

    speed_filter_s: SpeedFilter = 0.05
    """Time constant of the filter of the speed along the path; 0: no filter."""

    no_contact_cost: Annotated[float, from_zero(1000, "1")] = 10.0
    """Additional cost of a force on an obstacle without measured contact; 0: it costs as much as on others."""

    shape_nm_per_rad: Annotated[float, from_zero(1000, "N*m/rad")] = 1.5
    """Stiffness of the shape in torque mode; 0: always position mode, as stiff as the drives are."""

    shape_nm_s_per_rad: Annotated[float, from_zero(1000, "N*m*s/rad")] = 0.1
    """Damping of the shape in torque mode."""


class ObstacleAided(Controller[ObstacleAidedParameters]):
    """Controls the speed along the path with all joints."""

    Parameters = ObstacleAidedParameters

    def __init__(self, robot: Description, parameters: ObstacleAidedParameters) -> None:
        """Create a controller that moves the body along a planned path by pushing off obstacles.

        It starts with all integrals and forces at zero, before the first measurement.

        Args:
            robot: description of the robot; the joints with a vertical axis bend the body.
            parameters: gains, limits and time constants of this controller.
        """
        super().__init__(robot, parameters)
        # Models and estimators.
        self._body = PlanarBody(robot)
        self._climb = Climb(robot)
        self._progress = PathProgress(self._body, speed_filter_s=parameters.speed_filter_s)
        self._contacts = MeasuredContacts()
        # Joints.
        self._bends = self._body.bends  # indices of the joints that bend
        self._stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        self._has_torque_mode = all(robot.joints[i].supports_mode(Mode.TORQUE) for i in self._bends)
        self._bumpless = BumplessReference(robot, parameters.blend_s)
        self._holding = False  # the joints hold a pose; the next reference may jump
        # Look-ahead.
        self._look_ahead_integral_m = 0.0
        # Push along the path.
        self._push_filter = PushFilter(parameters.push_filter_s)
        self._snapshot: PushSnapshot | None = None
        self._unit_torques_nm = np.zeros(len(robot.joints))  # joint torques for 1 N along the path
        self._torques_nm = np.zeros(len(robot.joints))  # filtered joint torques of the commanded push
        self._push_integral_n = 0.0
        self._max_force_n = 0.0  # what contacts and torque limits allow
        self._force_n = 0.0  # commanded push
        self._unbalanced_at_s = 0.0  # when the contacts could last not balance a push
        # Supervision.
        self._moved_at_s = 0.0  # when the body was last faster than STANDSTILL_SPEED_M_S
        self._search = ContactSearch(robot, after_s=parameters.search_after_s, for_s=parameters.search_s)

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the joint setpoints that move the body along the path at the desired speed.

        The joints follow angles of the body further along the path, plus the torques of a push against obstacles. While
        the body can be soft, it commands torques instead of angles. If the body stays stationary, a contact-search gait
        moves it. While its position on the path is unknown, or no motion is desired, the joints hold their pose.

        Args:
            observation: the inputs of this tick.

        Returns:
            Setpoints of all joints, with telemetry about push and contacts.
        """
        located = self._progress.update(observation)
        if isinstance(located, str):
            self._holding = True
            return self._bumpless.hold_pose(observation, located)
        self._contacts.add_world(located.world)
        desired_m_s = located.trajectory.speed_m_s
        if desired_m_s == 0.0:  # whatever path is planned meanwhile
            return self._rest_in_pose(observation)
        lift_rad = self._climb.angles_rad(located.trajectory.rises, located.tail_s_m)
        center_w = located.nodes_w.mean(axis=1)
        wave = self._search.decide(
            observation, center_w, desired_m_s=desired_m_s, has_near_obstacles=self._has_near_obstacles()
        )
        if wave is not None:
            return self._undulate(observation, wave, lift_rad)

        scale = self.parameters.push_scale * self._push_sign(observation.time_s)
        look_ahead_m = self._update_look_ahead(located, observation.period_s)
        if scale < 0:
            look_ahead_m = abs(look_ahead_m)  # a negative scale always pushes backward
        look_ahead_m = scale * look_ahead_m
        theta = self._angles_on_path(located, located.tail_s_m)  # joint angles, rad
        theta_ahead = self._angles_on_path(located, located.tail_s_m + SLOPE_STEP_M)
        theta_prime = (theta_ahead - theta) / SLOPE_STEP_M  # derivative by the arc length, rad/m
        push_torques_nm = scale * self._update_push_torques(observation, located, theta_prime)
        if self._can_be_soft(observation.time_s) and not lift_rad.any():
            return self._command_torques(observation, located, theta, theta_prime, push_torques_nm)
        reference = self._angles_on_path(located, located.tail_s_m + look_ahead_m)
        reference = reference + push_torques_nm / self._stiffness + lift_rad
        look_ahead_n = look_ahead_m * float(self._stiffness @ theta_prime**2)
        return self._command_positions(observation, located, reference, look_ahead_n)

    def _angles_on_path(self, located: Located, tail_s_m: float) -> Floats:
        """Return theta(s): the angles of all joints, (n_joints,), with the tail at an arc length of the path."""
        return self._body.all_angles(located.on_path.pose_at(tail_s_m))

    def _has_near_obstacles(self) -> bool:
        return self._snapshot is not None and len(self._snapshot.touches) > 0

    def _push_sign(self, time_s: float) -> float:
        """Return the sign of the push at a time; random signs are the same in every run."""
        interval_s = self.parameters.push_sign_s
        if interval_s == 0.0:
            return 1.0
        return float(RANDOM_SIGNS[int(time_s / interval_s) % len(RANDOM_SIGNS)])

    # --- commands ------------------------------------------------------------------------------------------------

    def _can_be_soft(self, time_s: float) -> bool:
        """Whether the joints can be in torque mode: obstacles have been able to balance a push for a while."""
        if not self._has_torque_mode or self.parameters.shape_nm_per_rad <= 0.0:
            return False
        if self._snapshot is None or self._snapshot.push.residual > MAX_UNBALANCED_SOFT:
            self._unbalanced_at_s = time_s
        return time_s - self._unbalanced_at_s > SOFT_AFTER_S

    def _command_torques(
        self, observation: Observation, located: Located, theta: Floats, theta_prime: Floats, push_torques_nm: Floats
    ) -> ControllerCommand:
        """Command the torques tau_push + tau_shape to the joints that bend.

        tau_shape = k (theta - q) + d (theta' v - q') holds the shape of the body. Its component along theta', which
        would move the body along the path, is removed.

        Args:
            observation: the inputs of this tick, with the joint angles q and velocities q'.
            located: position of the body on the path, and its speed v.
            theta: (n_joints,) joint angles of the body on the path, rad.
            theta_prime: (n_joints,) their derivatives by the arc length, rad/m.
            push_torques_nm: (n_joints,) tau_push.
        """
        k = self.parameters.shape_nm_per_rad
        d = self.parameters.shape_nm_s_per_rad
        angle_error_rad = theta - np.array(observation.joints.angle_rad)
        velocity_error_rad_s = theta_prime * located.speed_m_s - np.array(observation.joints.velocity_rad_s)
        shape_nm = k * angle_error_rad + d * velocity_error_rad_s
        slope = theta_prime[self._bends]
        along_n = float(slope @ shape_nm[self._bends])  # force of tau_shape along the path, by virtual work
        shape_nm = shape_nm - theta_prime * along_n / (slope @ slope + MIN_SLOPE_SQUARED_PER_M2)

        setpoints = self._bumpless.follow(observation, theta)
        self._bumpless.forget_reference()
        self._limit_look_ahead_integral()
        self._holding = False
        for i in self._bends:
            limit_nm = setpoints.torque_limit_nm[i]
            torque_nm = float(shape_nm[i] + push_torques_nm[i])
            setpoints.mode[i] = Mode.TORQUE
            setpoints.target[i] = min(max(torque_nm, -limit_nm), limit_nm)
        return ControllerCommand(setpoints, self._make_telemetry(observation, located, 0.0, theta))

    def _command_positions(
        self, observation: Observation, located: Located, reference: Floats, look_ahead_n: float
    ) -> ControllerCommand:
        """Command a reference in position mode; look_ahead_n: the force of its look-ahead."""
        restarted = located.restarted or self._holding or self._search.changed
        last_reference = self._bumpless.reference_rad
        if restarted and last_reference is not None and np.abs(reference - last_reference).max() > OTHER_SHAPE_RAD:
            self._limit_look_ahead_integral()
        setpoints = self._bumpless.follow(observation, reference, restarted=restarted)
        self._holding = False
        return ControllerCommand(setpoints, self._make_telemetry(observation, located, look_ahead_n, reference))

    def _undulate(self, observation: Observation, wave: LateralUndulation, lift_rad: Floats) -> ControllerCommand:
        """Move by a wave, in search of obstacles to push off."""
        self._stop_pushing()
        reference = wave.reference_rad(observation, observation.period_s) + lift_rad
        setpoints = self._bumpless.follow(observation, reference, restarted=self._search.changed)
        why = "it does not come on: it moves by a wave, in search of contacts"
        return ControllerCommand(setpoints, Telemetry(reason=why, reference_rad=reference.tolist()))

    def _rest_in_pose(self, observation: Observation) -> ControllerCommand:
        """Keep every joint where it is, without a push: the desired speed is 0."""
        self._stop_pushing()
        self._look_ahead_integral_m = 0.0
        self._moved_at_s = observation.time_s
        self._search.stop()
        if self._holding or self._bumpless.reference_rad is None:
            command = self._bumpless.hold_pose(observation, "")
        else:
            reference = np.array(observation.joints.angle_rad)
            setpoints = self._bumpless.follow(observation, reference, restarted=True)
            command = ControllerCommand(setpoints, Telemetry(reference_rad=reference.tolist()))
        self._holding = True
        return command

    def _stop_pushing(self) -> None:
        self._torques_nm[:] = 0.0
        self._push_integral_n = 0.0
        self._force_n = 0.0

    # --- look-ahead and push -------------------------------------------------------------------------------------

    def _update_look_ahead(self, located: Located, period_s: float) -> float:
        """Return the look-ahead l = speed_kp e + integral_per_s integral e dt in m; both are bounded."""
        max_m = self.parameters.max_look_ahead_m
        error_m_s = located.trajectory.speed_m_s - located.speed_m_s
        self._look_ahead_integral_m += self.parameters.integral_per_s * error_m_s * period_s
        self._look_ahead_integral_m = min(max(self._look_ahead_integral_m, -max_m), max_m)
        return min(max(self._look_ahead_integral_m + self.parameters.speed_kp_s * error_m_s, -max_m), max_m)

    def _limit_look_ahead_integral(self) -> None:
        self._look_ahead_integral_m = min(self._look_ahead_integral_m, self.parameters.fresh_look_ahead_m)

    def _update_push_torques(self, observation: Observation, located: Located, theta_prime: Floats) -> Floats:
        """Return the filtered joint torques tau_push of a force F along the path that controls the speed.

        F = lag_kp * integral of e dt + speed_kp * e, with the speed error e. F is limited to `max_push_n` and to what
        the contacts and the torque limits allow.

        Args:
            observation: the inputs of this tick.
            located: position and speed of the body on the path.
            theta_prime: (n_joints,) derivatives of the joint angles by the arc length, rad/m.

        Returns:
            (n_joints,) torques in N·m.
        """
        parameters = self.parameters
        desired_m_s = located.trajectory.speed_m_s
        if desired_m_s <= 0.0 or parameters.max_push_n == 0.0:
            self._push_integral_n = 0.0
            self._force_n = 0.0
            self._snapshot = None
            return np.zeros(len(self.robot.joints))
        error_m_s = desired_m_s - located.speed_m_s
        integral_gain = 1.0
        if abs(located.speed_m_s) < CREEP_SPEED_M_S:
            integral_gain = CREEP_GAIN
        self._push_integral_n += integral_gain * parameters.lag_kp_n_per_m * error_m_s * observation.period_s
        self._push_integral_n = min(max(self._push_integral_n, 0.0), parameters.max_push_n)
        force_n = self._push_integral_n + parameters.speed_kp_n_s_per_m * error_m_s
        force_n = min(max(force_n, 0.0), parameters.max_push_n)
        if located.fresh:
            self._update_contacts(observation.time_s, located, theta_prime)
        # Anti-windup: the integral stays within the force that the contacts allow.
        self._push_integral_n = min(self._push_integral_n, self._max_force_n)
        self._force_n = min(force_n, self._max_force_n)
        last_gain = np.exp(-observation.period_s / parameters.torque_filter_s)  # of a low-pass filter
        self._torques_nm = last_gain * self._torques_nm + (1 - last_gain) * self._force_n * self._unit_torques_nm
        return np.clip(self._torques_nm, -parameters.max_torque_nm, parameters.max_torque_nm)

    def _update_contacts(self, time_s: float, located: Located, theta_prime: Floats) -> None:
        """Find the contacts of a new world model, the push that they allow, and the maximum force of that push.

        Args:
            time_s: time of this tick.
            located: position of the body, with the new world model.
            theta_prime: (n_joints,) derivatives of the joint angles by the arc length, rad/m.
        """
        parameters = self.parameters
        obstacles = located.world.obstacles
        nodes_w = self._predict_nodes(located)
        touches = find_touches(
            nodes_w,
            self._body.radius_m,
            Outlines.from_obstacles(obstacles),
            reach_m=parameters.reach_m,
            friction=located.trajectory.assumed_obstacle_friction,
        )
        names = [obstacles[k].name for k in touches.obstacle.tolist()]
        push = push_forward(
            nodes_w,
            touches,
            theta_prime[self._bends],
            contact_gap_scale_m=parameters.contact_gap_scale_m,
            extra_cost=self._no_contact_costs(names),
        )
        push = self._push_filter.update(time_s, push, names)
        self._snapshot = PushSnapshot(located.world, touches, push)
        self._unit_torques_nm = np.zeros(len(self.robot.joints))
        self._max_force_n = 0.0
        max_lambda = float(push.lambdas.max(initial=0.0))
        is_balanced = push.residual < MAX_UNBALANCED
        # All contact forces (lambdas) may be 0: a body bent into a U has hardly any drag, and needs no push.
        if is_balanced and max_lambda > 0.0:
            self._unit_torques_nm[self._bends] = push.torques_nm
            max_unit_nm = float(np.abs(push.torques_nm).max(initial=0.0)) + 1e-9
            self._max_force_n = min(parameters.max_torque_nm / max_unit_nm, parameters.max_contact_n / max_lambda)

    def _predict_nodes(self, located: Located) -> Floats:
        """Return the nodes of the body, (2, n_nodes), when the motors will act: moved on along the path."""
        acting_s_m = located.tail_s_m + ACTUATION_DELAY_S * located.speed_m_s
        on_path = located.on_path
        return located.nodes_w + on_path.pose_at(acting_s_m).nodes_w - on_path.pose_at(located.measured_s_m).nodes_w

    def _no_contact_costs(self, obstacles: list[str]) -> Floats | float:
        """Return the extra cost of each contact, (k,): no_contact_cost exp(-force / CONTACT_FORCE_SCALE_N).

        Without a sensor of contact forces there is no extra cost.
        """
        forces_w = self._contacts.mean_forces_w(obstacles)
        if not forces_w:
            return 0.0
        forces_n = np.hypot(*np.array(forces_w).reshape(-1, 2).T)
        return self.parameters.no_contact_cost * np.exp(-forces_n / CONTACT_FORCE_SCALE_N)

    # --- reports -------------------------------------------------------------------------------------------------

    def _make_telemetry(
        self, observation: Observation, located: Located, look_ahead_n: float, reference: Floats
    ) -> Telemetry:
        """Report the push along the path, and why the body is stationary if it is.

        Args:
            observation: the inputs of this tick.
            located: position and speed of the body on the path.
            look_ahead_n: force along the path that the look-ahead causes.
            reference: (n_joints,) reference angles, rad.

        Returns:
            The telemetry of this tick, with desired contact forces in N and joint torques in N·m.
        """
        if abs(located.speed_m_s) > STANDSTILL_SPEED_M_S:
            self._moved_at_s = observation.time_s
        is_stationary = observation.time_s - self._moved_at_s > STANDSTILL_S and self._snapshot is not None
        points = self._report_push_points()
        jammed, reason = self._explain_standstill(located, points)
        return Telemetry(
            reason=reason if is_stationary else "",
            reason_if_stationary=reason if observation.time_s > STANDSTILL_S else "",
            path_s_m=located.tail_s_m,
            propulsion_n=look_ahead_n + self._force_n,
            push_points=points,
            desired_force_n=[float(np.hypot(*contact.force_w[:2])) for contact in points],
            bending_torque_nm=self._torques_nm.tolist(),
            reference_rad=reference.tolist(),
            torque_headroom_nm=self.parameters.max_torque_nm - float(np.abs(self._torques_nm).max()),
            saturated=0.0 < self._max_force_n <= self._force_n,
            jammed=is_stationary and jammed,
        )

    def _report_push_points(self) -> list[WorldContact]:
        found = self._snapshot
        if found is None:
            return []
        return push_points(self._body, found.world, found.touches, found.push, self._force_n)

    def _explain_standstill(self, located: Located, points: list[WorldContact]) -> tuple[bool, str]:
        """Return whether a stationary body would be jammed, and why it would be stationary."""
        found = self._snapshot
        if found is None:
            return False, "standing still: backing out along its own path"
        names = [point.obstacle for point in points if point.obstacle is not None]
        towards_head_w = (located.nodes_w[:, -1] - located.nodes_w[:, 0]).tolist()
        net_force = self._contacts.resolve_along(towards_head_w)
        return explain_push_standstill(found.touches, found.push, self._force_n, self._max_force_n, net_force, names)
