"""Sidewinding and rolling as curves in space, to which the joints are fitted.

Source: R. L. Hatton, H. Choset, "Generating gaits for snake robots: annealed chain fitting and keyframe wave
extraction", Autonomous Robots 28 (2010), for the method (see `chain_fit`); R. L. Hatton, H. Choset, "Sidewinding on
Slopes", IEEE International Conference on Robotics and Automation 2010, for the curve of sidewinding: a helix around a
flattened cylinder, of which the lower side rests on the ground. With the half width A and the half height B of the
helix, both in body lengths,

    c(p, phi) = (p, A sin(2 pi p / Lambda - phi), B cos(2 pi p / Lambda - phi)),   up to the body's length.

Lambda is such that a wave has the length lambda along the curve. The middle link stays upright. The phase phi moves the
helix along its axis, from the head to the tail, so that each part of the body is lifted over in turn.

For rolling the curve is an arc in the ground plane, which does not change. The body turns about its own axis by phi,
the roll of the middle link. In the frames of its links, the arc turns the other way.
"""

import math
from abc import abstractmethod
from typing import Annotated

import numpy as np

from snakesim_gnc.control.gaits.base import Gait, GaitParameters, GaitParametersT, Seconds
from snakesim_gnc.control.gaits.body_curve import CHECKED_PHASES_RAD, BodyCurve
from snakesim_gnc.control.gaits.chain_fit import BackboneCurve, KeyframeWaves, sample_by_arc_length
from snakesim_gnc.control.gaits.serpenoid import Wavelength
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.controller import ControllerCommand, Observation
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import bounded, from_zero

DENSE_POINT_COUNT = 400  # of a curve, for its arc length
MAX_DEVIATION_RATIO = 0.05  # of a node from its place on the curve, in body lengths
FIT_STEPS_PER_TICK = 3  # each takes about 0.5 ms
FITTING_REASON = "it fits its joints to its curve"
MIN_ARC_RAD = 1e-3  # the bend of a straight body, as an arc


class BackboneSidewindingParameters(GaitParameters, frozen=True, kw_only=True):
    """Parameters of the helix, which transfer between robots."""

    half_width: Annotated[float, from_zero(0.3, "body lengths")] = 0.09
    """Half of the width of the helix, in the ground plane (A)."""

    half_height: Annotated[float, bounded(-0.1, 0.1, "body lengths")] = 0.015
    """Half of the height of the helix (B). Negative: the robot travels to the other side."""

    wavelength: Wavelength = 0.75
    """Length of a wave along the body (lambda)."""

    period_s: Seconds = 2.0
    """Period of the wave."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class BackboneRollingParameters(GaitParameters, frozen=True, kw_only=True):
    """Parameters of the arc, which transfer between robots."""

    bend_rad: Annotated[float, bounded(-6, 6, "rad")] = 2.2
    """Bend of the whole body. Negative: the robot rolls to the other side."""

    period_s: Seconds = 2.0
    """Time of one revolution."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class _BackboneGait(Gait[GaitParametersT]):
    """A gait whose joints are fitted to a curve. It holds the pose in the first cycles, until the fit is complete."""

    def __init__(self, robot: RobotDescription, parameters: GaitParametersT) -> None:
        super().__init__(robot, parameters)
        self._point_fractions = compute_node_fractions(robot)
        self._length_m = sum(link.length_m for link in robot.links)
        self._keyframe_waves = KeyframeWaves(robot, self.compute_backbone)

    def update(self, observation: Observation) -> ControllerCommand:
        """Fit first, and then advance the gait while motion is requested."""
        if not self._hold_reason and not self._keyframe_waves.advance_fit(FIT_STEPS_PER_TICK):
            return self.hold_and_report(observation, FITTING_REASON)
        return super().update(observation)

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        return self._keyframe_waves.compute_joint_angles_rad(phase_rad)

    @abstractmethod
    def compute_backbone(self, phase_rad: float) -> BackboneCurve:
        """Return the curve at a phase."""

    def fit_and_validate(self, parameter_label: str) -> None:
        """Fit the joints to the curve immediately, and check that the joints can form the curve.

        Args:
            parameter_label: Name and value of the parameter that bends the body most, for the error message, such as
                "control.bend_rad of 2 rad".

        Raises:
            ConfigError: A point of the body is too far from the curve, or a joint turns beyond its limits.
        """
        if self._hold_reason:
            return  # a robot without the necessary joints holds its pose, so there is nothing to fit
        self._keyframe_waves.advance_fit()
        deviation_m = self._keyframe_waves.max_deviation_m
        max_deviation_m = MAX_DEVIATION_RATIO * self._length_m
        if deviation_m > max_deviation_m:
            raise ConfigError(
                f"{parameter_label} makes a curve that the joints of this robot cannot form: a node of the body is "
                f"{1e3 * deviation_m:.0f} mm from it, and {1e3 * max_deviation_m:.0f} mm "
                "are allowed: reduce this parameter, or make the waves longer",
                code="python/invalid-argument",
            )
        shapes_rad = np.array(
            [self._keyframe_waves.compute_joint_angles_rad(phase) for phase in CHECKED_PHASES_RAD]
        )
        # The limits of all joints are checked, whatever axis the curve has.
        BodyCurve(self.robot, "yaw").check_limits(shapes_rad, parameter_label)


class BackboneSidewinding(_BackboneGait[BackboneSidewindingParameters]):
    """Travels sideways on level ground: two or three parts of the body rest, and those between them are lifted over."""

    Parameters = BackboneSidewindingParameters

    @classmethod
    def check(cls, robot: RobotDescription, parameters: BackboneSidewindingParameters) -> None:
        """Check that the joints can form the helix. Raises ConfigError."""
        for axis in cls._required_axes:
            curve = BodyCurve(robot, axis)
            curve.check_wavelength(
                parameters.wavelength,
                f"control.wavelength of {parameters.wavelength:g}",
                "increase it",
            )
        cls(robot, parameters).fit_and_validate(f"control.half_width of {parameters.half_width:g}")

    def compute_backbone(self, phase_rad: float) -> BackboneCurve:
        return compute_helix(self._point_fractions, self._length_m, self.parameters, phase_rad)


class BackboneRolling(_BackboneGait[BackboneRollingParameters]):
    """Rolls sideways on level ground: the body lies in an arc and turns about its own axis."""

    Parameters = BackboneRollingParameters

    @classmethod
    def check(cls, robot: RobotDescription, parameters: BackboneRollingParameters) -> None:
        """Check that the joints can form the arc. Raises ConfigError."""
        cls(robot, parameters).fit_and_validate(f"control.bend_rad of {parameters.bend_rad:g} rad")

    def compute_backbone(self, phase_rad: float) -> BackboneCurve:
        return compute_arc(
            self._point_fractions, self._length_m, self.parameters.bend_rad, phase_rad
        )


def compute_node_fractions(robot: RobotDescription) -> Floats:
    """Return where the tail end, the joints and the head end are, as fractions of the body from the tail."""
    ends_m = np.cumsum([link.length_m for link in robot.links])
    return np.concatenate(([0.0], ends_m / ends_m[-1]))


def compute_helix(
    point_fractions: Floats,
    length_m: float,
    parameters: BackboneSidewindingParameters,
    phase_rad: float,
) -> BackboneCurve:
    """Return the helix of sidewinding, from the tail to the head.

    Args:
        point_fractions: (n,) fractions of the body from the tail.
        length_m: Length of the body.
        parameters: Width, height and wavelength of the helix.
        phase_rad: phi, the phase of the gait.
    """
    width = parameters.half_width
    height = parameters.half_height
    # Along one wave of arc length lambda: find the wavelength along the axis by bisection on the mean stretch.
    axis_wavelength = _find_axis_wavelength(parameters.wavelength, width, height)
    axis_length = axis_wavelength / parameters.wavelength
    p = np.linspace(-0.6, 0.6, DENSE_POINT_COUNT) * axis_length
    angles_rad = math.tau * p / axis_wavelength + phase_rad
    dense_points = np.stack([p, width * np.sin(angles_rad), height * np.cos(angles_rad)], axis=1)
    segment_lengths = np.linalg.norm(np.diff(dense_points, axis=0), axis=1)
    arc_lengths = np.concatenate(([0.0], np.cumsum(segment_lengths)))
    start_arc_length = 0.5 * (arc_lengths[-1] - 1.0)
    points = sample_by_arc_length(
        dense_points, (start_arc_length + point_fractions) / arc_lengths[-1]
    )
    return BackboneCurve(length_m * points, np.array([0.0, 0.0, 1.0]))


def compute_arc(
    point_fractions: Floats, length_m: float, bend_rad: float, phase_rad: float
) -> BackboneCurve:
    """Return the arc of rolling, from the tail to the head, and the roll of its middle.

    Args:
        point_fractions: (n,) fractions of the body from the tail.
        length_m: Length of the body.
        bend_rad: Angle between the tangents at tail and head; negative to roll to the other side.
        phase_rad: phi, the roll of the middle link.
    """
    arc_rad = max(abs(bend_rad), MIN_ARC_RAD)
    radius_m = length_m / arc_rad
    angles_rad = arc_rad * (point_fractions - 0.5)
    points = np.stack(
        [
            radius_m * np.sin(angles_rad),
            radius_m * (1.0 - np.cos(angles_rad)),
            np.zeros_like(angles_rad),
        ],
        axis=1,
    )
    roll_rad = math.copysign(phase_rad, bend_rad)
    roll_normal = np.array([0.0, -math.sin(roll_rad), math.cos(roll_rad)])
    return BackboneCurve(points, roll_normal)


def _find_axis_wavelength(arc_wavelength: float, width: float, height: float) -> float:
    """Find the wavelength along the axis of a helix from the wavelength along its arc, by bisection.

    Args:
        arc_wavelength: Wavelength along the arc, as a fraction of the body length.
        width: Half width of the helix, as a fraction of the body length.
        height: Half height of the helix, as a fraction of the body length.

    Returns:
        Wavelength along the axis, as a fraction of the body length.
    """
    angles_rad = np.linspace(0.0, math.tau, DENSE_POINT_COUNT)
    min_wavelength = 0.0
    max_wavelength = arc_wavelength
    for _ in range(40):
        middle_wavelength = 0.5 * (min_wavelength + max_wavelength)
        wave_points = np.stack(
            [
                middle_wavelength * angles_rad / math.tau,
                width * np.sin(angles_rad),
                height * np.cos(angles_rad),
            ],
            axis=1,
        )
        if np.linalg.norm(np.diff(wave_points, axis=0), axis=1).sum() > arc_wavelength:
            max_wavelength = middle_wavelength
        else:
            min_wavelength = middle_wavelength
    return 0.5 * (min_wavelength + max_wavelength)
