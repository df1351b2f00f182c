"""Controls the speed along the path by a force on the obstacles, and finds the joint torques of this force.

A bounded PI law of the speed error e = v_wanted - v gives the force F along the path:

    F = lag_kp integral e dt + speed_kp e,    0 <= F <= what contacts and torque limits allow

`push.py` distributes a force of 1 N to the obstacles near the body, once for each new world model. The joint torques of
this solution times F, through a low-pass filter, are the torques of the push.
"""

import numpy as np

from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.obstacle_aided.parameters import ObstacleAidedParameters
from snakesim_gnc.control.obstacle_aided.push import (
    PushLowPassFilter,
    PushSnapshot,
    find_body_contacts,
    solve_push,
)
from snakesim_gnc.control.progress import BodyLocation
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.model.geometry.outlines import ObstacleOutlines

# Fraction of a push that may be unbalanced; it turns the body a little, until it touches other obstacles.
MAX_UNBALANCED_RATIO = 0.3
# At this measured force, the extra cost of a contact without force has fallen to 1/e.
CONTACT_FORCE_SCALE_N = 0.5
ACTUATION_DELAY_S = 0.03  # from a measurement until the motors act on it
# Below this speed, the integral of the push grows CREEP_INTEGRAL_GAIN times as fast.
MAX_CREEP_SPEED_M_S = 0.05
CREEP_INTEGRAL_GAIN = 2.0


class PushControl:
    """Decides how hard the body pushes along its path, and with which joint torques.

    Attributes:
        measured_contacts: Measured contact forces; the controller adds each world model to them.
        snapshot: Contacts of the newest world model and the push that they allow; None while nothing is known.
        force_n: Commanded force along the path.
        max_force_n: Largest force that the contacts and the torque limits allow.
        torques_nm: (n_joints,) filtered joint torques of the commanded force, before their limit.
    """

    def __init__(
        self, body: PlanarBody, joint_count: int, parameters: ObstacleAidedParameters
    ) -> None:
        """Start without a push, before the first world model.

        Args:
            body: The robot as a planar chain.
            joint_count: Number of all joints, with those that do not bend the body.
            parameters: Gains, limits and time constants of the push.
        """
        self._body = body
        self._joint_count = joint_count
        self._parameters = parameters
        # Contacts.
        self.snapshot: PushSnapshot | None = None
        self.measured_contacts = MeasuredContacts()
        self._push_filter = PushLowPassFilter(parameters.push_filter_s)
        # Force along the path.
        self.force_n = 0.0
        self.max_force_n = 0.0
        self._integral_n = 0.0
        # Joint torques.
        self.torques_nm = np.zeros(joint_count)
        self._unit_torques_nm = np.zeros(joint_count)  # for 1 N along the path

    @property
    def has_near_obstacles(self) -> bool:
        """Whether obstacles are within reach of the body."""
        return self.snapshot is not None and len(self.snapshot.contacts) > 0

    def update(
        self, observation: Observation, location: BodyLocation, theta_prime: Floats
    ) -> Floats:
        """Compute the joint torques of the push at this tick.

        Args:
            observation: The inputs of this tick.
            location: Position and speed of the body on the path.
            theta_prime: (n_joints,) derivatives of the joint angles by the arc length, rad/m.

        Returns:
            (n_joints,) torques in N·m, each at most `max_torque_nm`.
        """
        parameters = self._parameters
        desired_m_s = location.trajectory.speed_m_s
        if desired_m_s <= 0.0 or parameters.max_push_n == 0.0:
            self._integral_n = 0.0
            self.force_n = 0.0
            self.snapshot = None
            return np.zeros(self._joint_count)
        desired_force_n = self._compute_desired_force(location, observation.period_s)
        if location.is_new_world:
            self._update_contacts(observation.time_s, location, theta_prime)
        # Anti-windup: the integral stays within the force that the contacts allow.
        self._integral_n = min(self._integral_n, self.max_force_n)
        self.force_n = min(desired_force_n, self.max_force_n)
        decay = np.exp(-observation.period_s / parameters.torque_filter_s)  # of a low-pass filter
        self.torques_nm = (
            decay * self.torques_nm + (1 - decay) * self.force_n * self._unit_torques_nm
        )
        return np.clip(self.torques_nm, -parameters.max_torque_nm, parameters.max_torque_nm)

    def reset(self) -> None:
        """Set the force, its integral and the torques to zero, and keep the contacts."""
        self.torques_nm[:] = 0.0
        self._integral_n = 0.0
        self.force_n = 0.0

    def _compute_desired_force(self, location: BodyLocation, period_s: float) -> float:
        """Update the integral of the speed error, and return F in N, at most `max_push_n`."""
        parameters = self._parameters
        error_m_s = location.trajectory.speed_m_s - location.speed_m_s
        integral_gain = 1.0
        if abs(location.speed_m_s) < MAX_CREEP_SPEED_M_S:
            integral_gain = CREEP_INTEGRAL_GAIN
        self._integral_n += integral_gain * parameters.lag_kp_n_per_m * error_m_s * period_s
        self._integral_n = min(max(self._integral_n, 0.0), parameters.max_push_n)
        force_n = self._integral_n + parameters.speed_kp_n_s_per_m * error_m_s
        return min(max(force_n, 0.0), parameters.max_push_n)

    def _update_contacts(self, time_s: float, location: BodyLocation, theta_prime: Floats) -> None:
        """Find the contacts of a new world model, the push that they allow, and the maximum force of that push.

        Args:
            time_s: Time of this tick.
            location: Position of the body, with the new world model.
            theta_prime: (n_joints,) derivatives of the joint angles by the arc length, rad/m.
        """
        parameters = self._parameters
        yaw_joints = self._body.yaw_joints
        obstacles = location.world.obstacles
        body_points_w = _predict_body_points_w(location)
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
            theta_prime[yaw_joints],
            contact_gap_scale_m=parameters.contact_gap_scale_m,
            extra_cost=self._compute_no_contact_costs(obstacle_names),
        )
        push = self._push_filter.update(time_s, push, obstacle_names)
        self.snapshot = PushSnapshot(location.world, contacts, push)
        self._unit_torques_nm = np.zeros(self._joint_count)
        self.max_force_n = 0.0
        max_lambda = float(push.contact_forces.max(initial=0.0))
        is_balanced = push.balance_residual < MAX_UNBALANCED_RATIO
        # All contact forces (lambdas) may be 0: a body bent into a U has hardly any drag, and needs no push.
        if is_balanced and max_lambda > 0.0:
            self._unit_torques_nm[yaw_joints] = push.joint_torques_nm
            max_unit_nm = float(np.abs(push.joint_torques_nm).max(initial=0.0)) + 1e-9
            self.max_force_n = min(
                parameters.max_torque_nm / max_unit_nm, parameters.max_contact_n / max_lambda
            )

    def _compute_no_contact_costs(self, obstacles: list[str]) -> Floats | float:
        """Compute the extra costs of contacts that have little measured force.

        The extra cost of a contact is no_contact_cost exp(-force / CONTACT_FORCE_SCALE_N).

        Args:
            obstacles: (k,) names of the obstacles of the contacts.

        Returns:
            (k,) extra costs, or 0.0 if no sensor measures contact forces.
        """
        forces_w = self.measured_contacts.compute_mean_forces_w(obstacles)
        if not forces_w:
            return 0.0
        forces_n = np.hypot(*np.array(forces_w).reshape(-1, 2).T)
        return self._parameters.no_contact_cost * np.exp(-forces_n / CONTACT_FORCE_SCALE_N)


def _predict_body_points_w(location: BodyLocation) -> Floats:
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
