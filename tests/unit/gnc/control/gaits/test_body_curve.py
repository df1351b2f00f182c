"""Tests that the parameters of a curve mean the same on robots with other numbers of joints.

Curves that the joints of a robot cannot form are refused.
"""

import math

import numpy as np
import pytest

from snakesim_gnc.control.gaits.body_curve import BodyCurve
from snakesim_gnc.control.gaits.concertina import Concertina, ConcertinaParameters
from snakesim_gnc.control.gaits.cpg import Cpg, CpgParameters
from snakesim_gnc.control.gaits.rectilinear import Rectilinear, RectilinearParameters
from snakesim_gnc.control.gaits.serpenoid import (
    Serpenoid,
    SerpenoidParameters,
    compute_serpenoid_headings,
)
from snakesim_gnc.control.gaits.sinus_lifting import SinusLifting, SinusLiftingParameters
from snakesim_gnc.geometry.body_on_path import compute_chain_points
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_testing.gnc.stage import make_robot
from snakesim_testing.messages import raises_error

# Distance of a node from the continuous curve, in body lengths: 8 joints are coarser than 20.
MAX_DISTANCES = {8: 0.02, 13: 0.008, 20: 0.004}
PHASES_RAD = (0.0, 1.0, 2.5, 4.0)


def find_continuous_nodes(
    phase_rad: float, parameters: SerpenoidParameters, places: Floats
) -> Floats:
    """Return points (2, n) of the serpenoid curve at fractions of the body from the tail, by numerical integration."""
    s = np.linspace(0.0, 1.0, 4001)
    middles = 0.5 * (s[1:] + s[:-1])
    headings = compute_serpenoid_headings(
        1.0 - middles, phase_rad, parameters.winding_angle_rad, parameters.wavelength
    )
    steps = np.diff(s) * np.array([np.cos(headings), np.sin(headings)])
    curve = np.concatenate([np.zeros((2, 1)), steps.cumsum(axis=1)], axis=1)
    return np.array([np.interp(places, s, row) for row in curve])


def find_robot_nodes(modules: int, angles_rad: Floats) -> tuple[Floats, Floats]:
    """Return the nodes of a planar robot (2, n) in body lengths, and their fractions of the body from the tail."""
    lengths = [link.length_m for link in make_robot(modules).links]
    total_m = sum(lengths)
    nodes = compute_chain_points(
        (0.0, 0.0), 0.0, angles_rad.tolist(), [length / total_m for length in lengths]
    )
    return nodes, np.concatenate(([0.0], np.cumsum(lengths) / total_m))


def measure_distance(nodes: Floats, curve: Floats) -> float:
    """Return the largest distance of corresponding points after the best motion of one set in the plane."""
    # Points are complex numbers, so that a rotation is a multiplication.
    node_points = np.array([1, 1j]) @ nodes
    curve_points = np.array([1, 1j]) @ curve
    node_points = node_points - node_points.mean()
    curve_points = curve_points - curve_points.mean()
    rotation = np.exp(1j * np.angle(np.vdot(node_points, curve_points)))
    return float(np.abs(node_points * rotation - curve_points).max())


@pytest.mark.parametrize("modules", [8, 13, 20])
@pytest.mark.parametrize("phase_rad", PHASES_RAD)
def test_body_curve_parameters_give_same_curve_on_any_planar_robot(
    modules: int, phase_rad: float
) -> None:
    parameters = SerpenoidParameters()
    robot = make_robot(modules)
    curve = BodyCurve(robot, "yaw")
    headings = compute_serpenoid_headings(
        curve.head_distance_fractions,
        phase_rad,
        parameters.winding_angle_rad,
        parameters.wavelength,
    )
    nodes, places = find_robot_nodes(modules, curve.compute_joint_angles_rad(headings))
    distance = measure_distance(nodes, find_continuous_nodes(phase_rad, parameters, places))
    assert distance < MAX_DISTANCES[modules]


def test_body_curve_joint_angles_are_larger_with_fewer_joints() -> None:
    """A controller that copied joint angles would fail: 8 joints bend more than twice as far as 20."""
    max_angles_rad: dict[int, float] = {}
    for modules in (8, 20):
        curve = BodyCurve(make_robot(modules), "yaw")
        angles_rad = [
            curve.compute_joint_angles_rad(
                compute_serpenoid_headings(curve.head_distance_fractions, phase_rad, 0.7, 0.67)
            )
            for phase_rad in PHASES_RAD
        ]
        max_angles_rad[modules] = float(np.abs(angles_rad).max())
    assert max_angles_rad[8] > 2.0 * max_angles_rad[20]


def test_body_curve_equal_links_form_the_discrete_serpenoid_curve() -> None:
    """phi_i = A sin(...) with A = 2 alpha sin(delta / 2) and a lag of delta = 2 pi l / lambda from joint to joint."""
    alpha = 0.6
    wavelength = 0.5
    curve = BodyCurve(make_robot(20), "yaw")
    delta = (
        math.tau
        * (curve.head_distance_fractions[3] - curve.head_distance_fractions[4])
        / wavelength
    )
    shapes = np.array(
        [
            curve.compute_joint_angles_rad(
                compute_serpenoid_headings(
                    curve.head_distance_fractions, phase_rad, alpha, wavelength
                )
            )
            for phase_rad in np.linspace(0.0, math.tau, 64, endpoint=False)
        ]
    )
    amplitudes = np.fft.rfft(shapes, axis=0)[1] / 32  # complex, of the first harmonic
    inner = amplitudes[2:-2]  # the pieces at both ends have other lengths
    assert np.abs(inner) == pytest.approx(2.0 * alpha * math.sin(0.5 * delta))
    assert np.angle(inner[1:] / inner[:-1]) == pytest.approx(delta)


def test_body_curve_bend_is_shared_by_any_number_of_joints() -> None:
    for modules in (8, 20):
        curve = BodyCurve(make_robot(modules), "yaw")
        bend_rad = curve.compute_joint_angles_rad(curve.make_bend_headings_rad(1.0)).sum()
        # The middles of both end pieces are not at the ends.
        assert bend_rad == pytest.approx(1.0, abs=1.2 / modules)


@pytest.mark.parametrize(
    ("gait", "parameters"),
    [
        (Serpenoid, SerpenoidParameters(wavelength=0.2)),
        (Serpenoid, SerpenoidParameters(winding_angle_rad=2.2, wavelength=0.4)),
        (Cpg, CpgParameters(winding_angle_rad=2.2, wavelength=0.4)),
        (Concertina, ConcertinaParameters(folds=2)),
    ],
    ids=["short wave", "winding", "winding of oscillators", "folds"],
)
def test_gait_with_curve_beyond_joint_limits_is_refused(gait, parameters) -> None:
    with raises_error(ConfigError):
        gait.check(make_robot(8), parameters)


@pytest.mark.parametrize(
    ("gait", "parameters"),
    [(Rectilinear, RectilinearParameters()), (SinusLifting, SinusLiftingParameters())],
    ids=["rectilinear", "sinus_lifting"],
)
def test_gait_of_robot_without_pitch_joints_is_accepted(gait, parameters) -> None:
    """The gait holds the pose of the robot and reports the reason, as the other gaits do."""
    gait.check(make_robot(13), parameters)
