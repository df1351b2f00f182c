"""A central pattern generator: a double chain of coupled phase oscillators, with feedback of contact forces.

Source: A. J. Ijspeert, A. Crespi, D. Ryczko, J.-M. Cabelguen, "From Swimming to Walking with a Salamander Robot Driven
by a Spinal Cord Model", Science 315 (2007), body oscillators; A. Crespi, A. J. Ijspeert, "Online Optimization of
Swimming and Crawling in an Amphibious Snake Robot", IEEE Transactions on Robotics 24 (2008), on a robot of yaw joints.
Oscillator i has a phase theta_i and an amplitude r_i:

    theta_i' = 2 pi nu + sum_j r_j w_ij sin(theta_j - theta_i - phi_ij) + feedback_i
    r_i''    = a (a / 4 (R_i - r_i) - r_i')
    x_i      = r_i (1 + cos(theta_i))

Each joint has an oscillator on its left and one on its right, coupled in antiphase (phi = pi). Its angle is

    q = x_left - x_right.

Neighbors on one side are coupled with the phase bias of the body curve, phi_ij = 2 pi (sigma_i - sigma_j) / lambda, and
the amplitudes are those of the serpenoid curve, R_left + R_right = 2 alpha sin(pi l / lambda), where l is the distance
between the middles of the two pieces at the joint. So the limit cycle is the serpenoid curve, and its parameters
transfer between robots. Steering makes one side stronger: R_left - R_right is the joint's share of the bend.

Feedback: F_i is the contact force on the links at the joint, to the left (on the right side its negative), and

    feedback_i = sigma F_i cos(theta_i - psi),

limited so that no oscillator stops. That contacts act on the phases follows R. Thandiackal and co-authors, "Emergence
of robust self-organized undulatory swimming based on local hydrodynamic force sensing", Science Robotics 6 (2021). The
limit and the phase psi are ours.
"""

import math
from typing import Annotated

import numpy as np

from snakesim_gnc.control.gaits.base import Gait, GaitParameters, Seconds, get_travel_sign
from snakesim_gnc.control.gaits.body_curve import BodyCurve
from snakesim_gnc.control.gaits.heading_control import (
    HeadingControl,
    LookAhead,
    MaxBend,
    SteeringGain,
)
from snakesim_gnc.control.gaits.serpenoid import Wavelength, WindingAngle, check_serpenoid
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription, WorldModel
from snakesim_hal.wire.quantities import above, bounded, from_zero

MAX_FEEDBACK_RATIO = 0.8  # of the feedback to 2 pi nu
MAX_STEP_S = 0.005  # of the integration


class CpgParameters(GaitParameters, frozen=True, kw_only=True):
    """Parameters of the curve on the limit cycle, of the oscillators, of the feedback and of the steering."""

    winding_angle_rad: WindingAngle = 0.9
    """Angle between the curve's axis and its steepest tangent on the limit cycle (alpha)."""

    wavelength: Wavelength = 0.8
    """Length of a wave along the body (lambda)."""

    period_s: Seconds = 1.6
    """Period of an oscillator without feedback (1 / nu)."""

    coupling: Annotated[float, from_zero(1000, "1/(rad*s)")] = 30.0
    """Weight of the coupling to the neighbors (w)."""

    amplitude_rate: Annotated[float, above(100, "1/s")] = 10.0
    """Rate at which amplitudes approach their limit (a)."""

    force_gain: Annotated[float, bounded(-10, 10, "rad/(N*s)")] = -0.3
    """Change of a phase for the contact force at its joint (sigma); 0: no feedback."""

    force_phase_rad: Annotated[float, bounded(-3.2, 3.2, "rad")] = 0.0
    """Phase of an oscillator at which a force to its side changes it most (psi)."""

    k_theta: SteeringGain = 2.0
    """Bend of the whole body for each radian of heading error; 0: no directional control."""

    look_ahead: LookAhead = 1.0
    """Look-ahead distance of the line-of-sight guidance (Delta)."""

    max_bend_rad: MaxBend = 1.5
    """Maximum bend of the whole body by the directional control."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class OscillatorChains:
    """Two chains of oscillators, left and right. All arrays are (2, n_joints): left and right, tail to head."""

    def __init__(self, phase_bias_rad: Floats, coupling: float, amplitude_rate: float) -> None:
        """Create the oscillators of all joints with the phases of the traveling wave, and with amplitudes of zero.

        Args:
            phase_bias_rad: (n_joints,) phases of the left chain on the limit cycle.
            coupling: Weight w of the coupling, 1/(rad s).
            amplitude_rate: Rate a at which amplitudes approach their limits, 1/s.
        """
        self.theta_rad = np.stack([phase_bias_rad, phase_bias_rad + math.pi])
        self.r_rad = np.zeros_like(self.theta_rad)
        self._r_velocity_rad_s = np.zeros_like(self.theta_rad)
        self._bias_step_rad = np.diff(phase_bias_rad)  # from each joint to the one ahead of it
        self._w = coupling
        self._a = amplitude_rate

    def integrate(
        self,
        elapsed_s: float,
        intrinsic_frequency_rad_s: float,
        amplitude_limit_rad: Floats,
        feedback_rad_s: Floats,
    ) -> None:
        """Integrate the equations of the oscillators over a time, in Euler steps of at most MAX_STEP_S.

        Args:
            elapsed_s: Time since the last call.
            intrinsic_frequency_rad_s: Frequency 2 pi nu without coupling; negative for a wave that travels to the head.
            amplitude_limit_rad: (2, n_joints) amplitudes R that the amplitudes r approach.
            feedback_rad_s: (2, n_joints) terms feedback_i that are added to the phase rates.
        """
        step_count = math.ceil(elapsed_s / MAX_STEP_S)
        for _ in range(step_count):
            step_s = elapsed_s / step_count
            r_acceleration = self._a * (
                0.25 * self._a * (amplitude_limit_rad - self.r_rad) - self._r_velocity_rad_s
            )
            self.theta_rad = self.theta_rad + step_s * (
                intrinsic_frequency_rad_s + self._compute_coupling_rad_s() + feedback_rad_s
            )
            self._r_velocity_rad_s = self._r_velocity_rad_s + step_s * r_acceleration
            self.r_rad = self.r_rad + step_s * self._r_velocity_rad_s

    def compute_joint_angles_rad(self) -> Floats:
        """Return the joint angles x_left - x_right, (n_joints,) in rad."""
        left_rad, right_rad = self.r_rad * (1.0 + np.cos(self.theta_rad))
        return left_rad - right_rad

    def _compute_coupling_rad_s(self) -> Floats:
        """Return the coupling terms sum_j r_j w_ij sin(theta_j - theta_i - phi_ij), (2, n_joints) in rad/s.

        j are the neighbors of oscillator i on its side, and the oscillator on the other side of its joint.
        """
        theta = self.theta_rad
        r = self.r_rad
        # Of the joint ahead, as seen from each joint.
        ahead_terms = np.sin(np.diff(theta, axis=1) - self._bias_step_rad)
        across_terms = np.sin(theta[::-1] - theta - math.pi)
        coupling_terms = r[::-1] * across_terms
        coupling_terms[:, :-1] += r[:, 1:] * ahead_terms
        coupling_terms[:, 1:] -= r[:, :-1] * ahead_terms
        return self._w * coupling_terms


class Cpg(Gait[CpgParameters]):
    """Moves as `serpenoid` does. Contacts shift the phases of the joints beside them."""

    Parameters = CpgParameters
    _required_axes = ("yaw",)

    @classmethod
    def check(cls, robot: RobotDescription, parameters: CpgParameters) -> None:
        """Check that the joints can form the curve of the limit cycle. Raises ConfigError."""
        check_serpenoid(robot, parameters.winding_angle_rad, parameters.wavelength)

    def __init__(self, robot: RobotDescription, parameters: CpgParameters) -> None:
        """Create the oscillators whose limit cycle is the serpenoid curve, and the heading control.

        Args:
            robot: Description of the robot, whose yaw joints get two oscillators each.
            parameters: Parameters of the curve, the oscillators, the feedback and the steering.
        """
        super().__init__(robot, parameters)
        self._curve = BodyCurve(robot, "yaw")
        self._heading_control = HeadingControl(
            robot,
            k_theta=parameters.k_theta,
            look_ahead=parameters.look_ahead,
            max_bend_rad=parameters.max_bend_rad,
            time_constant_s=parameters.period_s,
        )
        from_head = self._curve.head_distance_fractions
        piece_distance = from_head[:-1] - from_head[1:]  # (n_yaw,) l of every joint
        joint_from_head = 0.5 * (from_head[:-1] + from_head[1:])
        wave_number = math.tau / parameters.wavelength
        self._amplitude_rad = (
            2.0 * parameters.winding_angle_rad * np.sin(0.5 * wave_number * piece_distance)
        )
        self._bend_fraction = piece_distance  # of the bend of the whole body, in each joint
        phase_bias_rad = 0.5 * math.pi - wave_number * joint_from_head
        self._oscillators = OscillatorChains(
            phase_bias_rad, parameters.coupling, parameters.amplitude_rate
        )

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        intrinsic_frequency_rad_s = (
            get_travel_sign(observation) * math.tau / self.parameters.period_s
        )
        bend_rad = self._bend_fraction * self._heading_control.compute_bend_rad(observation)
        # No oscillator below zero.
        bend_rad = np.clip(bend_rad, -self._amplitude_rad, self._amplitude_rad)
        amplitude_limit_rad = 0.5 * np.stack(
            [self._amplitude_rad + bend_rad, self._amplitude_rad - bend_rad]
        )
        feedback_rad_s = self._compute_feedback_rad_s(observation.world)
        self._oscillators.integrate(
            observation.period_s, intrinsic_frequency_rad_s, amplitude_limit_rad, feedback_rad_s
        )
        reference_rad = self.make_straight_angles_rad()
        reference_rad[self._curve.joint_indices] = self._oscillators.compute_joint_angles_rad()
        return reference_rad

    def list_custom_telemetry(self) -> dict[str, float]:
        return {
            "heading_error_rad": self._heading_control.error_rad,
            "oscillator_amplitude_rad": float(self._oscillators.r_rad.mean()),
        }

    def _compute_feedback_rad_s(self, world: WorldModel | None) -> Floats:
        """Compute the feedback of contact forces, sigma F_i cos(theta_i - psi), limited so that no oscillator stops.

        Args:
            world: World model with the contacts; None if there is none, then the feedback is zero.

        Returns:
            (2, n_yaw) changes of the phase rates in rad/s.
        """
        theta_rad = self._oscillators.theta_rad
        if world is None or self.parameters.force_gain == 0.0:
            return np.zeros_like(theta_rad)
        forces_n = np.zeros(len(self.robot.links))  # to the left, on each link
        for contact in world.contacts:
            tangent_x, tangent_y, _ = contact.tangent_w
            force_x, force_y, _ = contact.force_w
            forces_n[contact.link] += tangent_x * force_y - tangent_y * force_x
        at_joints_n = (forces_n[:-1] + forces_n[1:])[self._curve.joint_indices]
        signed_n = np.stack([at_joints_n, -at_joints_n])
        feedback = (
            self.parameters.force_gain
            * signed_n
            * np.cos(theta_rad - self.parameters.force_phase_rad)
        )
        max_rad_s = MAX_FEEDBACK_RATIO * math.tau / self.parameters.period_s
        return np.clip(feedback, -max_rad_s, max_rad_s)
