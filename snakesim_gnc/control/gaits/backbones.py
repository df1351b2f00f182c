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
from snakesim_gnc.control.gaits.body_curve import PHASES, BodyCurve
from snakesim_gnc.control.gaits.chain_fit import Backbone, KeyframeWaves, sample_by_arc_length
from snakesim_gnc.control.gaits.serpenoid import Wavelength
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.controller import ControllerCommand, Observation
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import bounded, from_zero

DENSE_POINTS = 400  # of a curve, for its arc length
MAX_DISTANCE = 0.05  # of a node from its place on the curve, in body lengths
FIT_STEPS_PER_TICK = 3  # each takes about 0.5 ms
FITTING = "it fits its joints to its curve"
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

    def __init__(self, robot: Description, parameters: GaitParametersT) -> None:
        super().__init__(robot, parameters)
        self._places = find_node_fractions(robot)
        self._length_m = sum(link.length_m for link in robot.links)
        self._waves = KeyframeWaves(robot, self.find_backbone)

    def update(self, observation: Observation) -> ControllerCommand:
        """Fit first, and then advance the gait while motion is requested."""
        if not self._reason_to_hold and not self._waves.fit(FIT_STEPS_PER_TICK):
            return self.hold(observation, FITTING)
        return super().update(observation)

    def find_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        return self._waves.find_angles_rad(phase_rad)

    @abstractmethod
    def find_backbone(self, phase_rad: float) -> Backbone:
        """Return the curve at a phase."""

    def check_fit(self, setting: str) -> None:
        """Fit at once, and check that the joints can form the curve.

        Args:
            setting: what bends the body most, for the error, such as "control.bend_rad of 2 rad".

        Raises:
            ConfigError: a node is far from the curve, or a joint turns beyond its limits.
        """
        if self._reason_to_hold:
            return
        self._waves.fit()
        if self._waves.max_distance_m > MAX_DISTANCE * self._length_m:
            raise ConfigError(
                f"{setting} makes a curve that the joints of this robot cannot form: a node of the body is "
                f"{1e3 * self._waves.max_distance_m:.0f} mm from it, and {1e3 * MAX_DISTANCE * self._length_m:.0f} mm "
                "are allowed: reduce this parameter, or make the waves longer",
                code="python/invalid-argument",
            )
        shapes_rad = np.array([self._waves.find_angles_rad(phase) for phase in PHASES])
        BodyCurve(self.robot, "yaw").check_limits(shapes_rad, setting)


class BackboneSidewinding(_BackboneGait[BackboneSidewindingParameters]):
    """Travels sideways on level ground: two or three parts of the body rest, and those between them are lifted over."""

    Parameters = BackboneSidewindingParameters

    @classmethod
    def check(cls, robot: Description, parameters: BackboneSidewindingParameters) -> None:
        """Check that the joints can form the helix. Raises ConfigError."""
        for axis in cls._required_axes:
            curve = BodyCurve(robot, axis)
            curve.check_wavelength(
                parameters.wavelength, f"control.wavelength of {parameters.wavelength:g}", "increase it"
            )
        cls(robot, parameters).check_fit(f"control.half_width of {parameters.half_width:g}")

    def find_backbone(self, phase_rad: float) -> Backbone:
        return find_helix(self._places, self._length_m, self.parameters, phase_rad)


class BackboneRolling(_BackboneGait[BackboneRollingParameters]):
    """Rolls sideways on level ground: the body lies in an arc and turns about its own axis."""

    Parameters = BackboneRollingParameters

    @classmethod
    def check(cls, robot: Description, parameters: BackboneRollingParameters) -> None:
        """Check that the joints can form the arc. Raises ConfigError."""
        cls(robot, parameters).check_fit(f"control.bend_rad of {parameters.bend_rad:g} rad")

    def find_backbone(self, phase_rad: float) -> Backbone:
        return find_arc(self._places, self._length_m, self.parameters.bend_rad, phase_rad)


def find_node_fractions(robot: Description) -> Floats:
    """Return where the tail end, the joints and the head end are, as fractions of the body from the tail."""
    ends_m = np.cumsum([link.length_m for link in robot.links])
    return np.concatenate(([0.0], ends_m / ends_m[-1]))


def find_helix(
    places: Floats, length_m: float, parameters: BackboneSidewindingParameters, phase_rad: float
) -> Backbone:
    """Return the helix of sidewinding, from the tail to the head.

    Args:
        places: (n,) fractions of the body from the tail.
        length_m: of the body.
        parameters: of the helix.
        phase_rad: phi.
    """
    width = parameters.half_width
    height = parameters.half_height
    # Along one wave of arc length lambda: find the wavelength along the axis by bisection on the mean stretch.
    axis_wavelength = _find_axis_wavelength(parameters.wavelength, width, height)
    axis_length = axis_wavelength / parameters.wavelength
    p = np.linspace(-0.6, 0.6, DENSE_POINTS) * axis_length
    angle = math.tau * p / axis_wavelength + phase_rad
    dense = np.stack([p, width * np.sin(angle), height * np.cos(angle)], axis=1)
    steps = np.linalg.norm(np.diff(dense, axis=0), axis=1)
    arc = np.concatenate(([0.0], np.cumsum(steps)))
    begin = 0.5 * (arc[-1] - 1.0)
    nodes = sample_by_arc_length(dense, (begin + places) / arc[-1])
    return Backbone(length_m * nodes, np.array([0.0, 0.0, 1.0]))


def find_arc(places: Floats, length_m: float, bend_rad: float, phase_rad: float) -> Backbone:
    """Return the arc of rolling, from the tail to the head, and the roll of its middle.

    Args:
        places: (n,) fractions of the body from the tail.
        length_m: of the body.
        bend_rad: of the whole body.
        phase_rad: phi, the roll of the middle link.
    """
    arc_rad = max(abs(bend_rad), MIN_ARC_RAD)
    radius_m = length_m / arc_rad
    angles = arc_rad * (places - 0.5)
    nodes = np.stack([radius_m * np.sin(angles), radius_m * (1.0 - np.cos(angles)), np.zeros_like(angles)], axis=1)
    roll_rad = math.copysign(phase_rad, bend_rad)
    roll_normal = np.array([0.0, -math.sin(roll_rad), math.cos(roll_rad)])
    return Backbone(nodes, roll_normal)


def _find_axis_wavelength(arc_wavelength: float, width: float, height: float) -> float:
    """Return the wavelength along the axis of a helix, by that along its arc. Both are fractions of the body."""
    angles = np.linspace(0.0, math.tau, DENSE_POINTS)
    low = 0.0
    high = arc_wavelength
    for _ in range(40):
        middle = 0.5 * (low + high)
        loop = np.stack([middle * angles / math.tau, width * np.sin(angles), height * np.cos(angles)], axis=1)
        if np.linalg.norm(np.diff(loop, axis=0), axis=1).sum() > arc_wavelength:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)
