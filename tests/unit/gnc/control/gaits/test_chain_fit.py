"""Tests how chains of alternating joints are fitted to curves in space, and the waves between these fits."""

import numpy as np
import pytest

from snakesim_gnc.control.gaits.backbones import (
    BackboneRolling,
    BackboneRollingParameters,
    BackboneSidewinding,
    BackboneSidewindingParameters,
    compute_arc,
    compute_helix,
    compute_node_fractions,
)
from snakesim_gnc.control.gaits.chain_fit import BackboneCurve, ChainFit, KeyframeWaves
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.kinematics import compute_link_frames
from snakesim_hal.wire.messages import RobotDescription
from snakesim_testing.gnc.stage import make_robot
from snakesim_testing.messages import raises_error

MAX_DISTANCE = 0.012  # of a node from its place on the curve, in body lengths
PARAMETERS = BackboneSidewindingParameters()


def make_alternating_robot(modules: int = 18) -> RobotDescription:
    return make_robot(modules, ("yaw", "pitch"))


def measure_length_m(robot: RobotDescription) -> float:
    return sum(link.length_m for link in robot.links)


def fit_helix(robot: RobotDescription, keyframe_count: int = 16) -> KeyframeWaves:
    fractions = compute_node_fractions(robot)
    length_m = measure_length_m(robot)
    waves = KeyframeWaves(
        robot, lambda phase: compute_helix(fractions, length_m, PARAMETERS, phase), keyframe_count
    )
    assert waves.advance_fit()
    return waves


def measure_max_distance_m(chain: ChainFit, curve_points: Floats) -> float:
    """Return the largest distance of a node of the chain from its place on the curve."""
    return float(np.linalg.norm(chain.compute_node_positions() - curve_points, axis=1).max())


@pytest.mark.parametrize("modules", [16, 18, 24])
def test_chain_fit_of_helix_fits_robots_of_any_length(modules: int) -> None:
    robot = make_alternating_robot(modules)
    waves = fit_helix(robot)
    assert waves.max_deviation_m < MAX_DISTANCE * measure_length_m(robot)


def test_chain_fit_finds_a_chain_that_forms_the_curve_exactly() -> None:
    """The nodes of a chain with known angles are a curve that the chain can reach exactly."""
    robot = make_alternating_robot(10)
    axes = [joint.axis for joint in robot.joints]
    lengths_m = [link.length_m for link in robot.links]
    angles = 0.3 * np.sin(np.arange(10.0))
    origins, rotations = compute_link_frames(np.zeros(3), np.eye(3), angles, axes, lengths_m)
    nodes = np.vstack([origins, origins[-1] + lengths_m[-1] * rotations[-1][:, 0]])
    chain = ChainFit(robot)
    for _ in chain.fit_first(
        BackboneCurve(nodes, np.cross(rotations[5][:, 0], rotations[5][:, 1]))
    ):
        pass
    assert measure_max_distance_m(chain, nodes) < 0.02 * measure_length_m(robot)


def test_chain_fit_by_groups_is_better_than_by_single_links(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every second link cannot follow the curve if links are laid one by one."""
    robot = make_alternating_robot()
    backbone = compute_helix(
        compute_node_fractions(robot), measure_length_m(robot), PARAMETERS, 0.0
    )
    distances_m: list[float] = []
    for group_links in (6, 1):
        monkeypatch.setattr("snakesim_gnc.control.gaits.chain_fit.GROUP_LINKS", group_links)
        monkeypatch.setattr("snakesim_gnc.control.gaits.chain_fit.FINAL_STEPS", 0)
        chain = ChainFit(robot)
        for _ in chain.fit_first(backbone):
            pass
        distances_m.append(measure_max_distance_m(chain, backbone.node_positions))
    together_m, one_by_one_m = distances_m
    assert together_m < 0.7 * one_by_one_m


def test_keyframe_waves_pass_through_keyframes_and_are_periodic() -> None:
    waves = fit_helix(make_alternating_robot())
    phases_rad = 2.0 * np.pi * np.arange(16) / 16
    angles_at_keyframes_rad = np.array(
        [waves.compute_joint_angles_rad(phase_rad) for phase_rad in phases_rad]
    )
    assert angles_at_keyframes_rad == pytest.approx(waves.keyframes_rad, abs=1e-9)
    assert waves.compute_joint_angles_rad(2.0 * np.pi) == pytest.approx(
        waves.compute_joint_angles_rad(0.0)
    )
    angles_between_rad = np.array(
        [
            waves.compute_joint_angles_rad(phase_rad)
            for phase_rad in np.linspace(0.0, 2.0 * np.pi, 200)
        ]
    )
    assert np.abs(np.diff(angles_between_rad, axis=0)).max() < 0.1


def test_keyframe_waves_between_keyframes_are_near_the_curve() -> None:
    robot = make_alternating_robot()
    coarse = fit_helix(robot, 16)
    fine = fit_helix(robot, 32)
    angles_between_rad = [
        coarse.compute_joint_angles_rad(2.0 * np.pi * (k + 0.5) / 16) for k in range(16)
    ]
    assert np.array(angles_between_rad) == pytest.approx(fine.keyframes_rad[1::2], abs=0.05)


def test_keyframe_fit_in_several_calls_is_the_same_fit() -> None:
    robot = make_alternating_robot()
    fractions = compute_node_fractions(robot)
    length_m = measure_length_m(robot)
    waves = KeyframeWaves(
        robot, lambda phase: compute_helix(fractions, length_m, PARAMETERS, phase)
    )
    calls = 1
    while not waves.advance_fit(3):
        calls += 1
    assert 10 < calls < 25
    assert (waves.keyframes_rad == fit_helix(robot).keyframes_rad).all()


@pytest.mark.parametrize("bend_rad", [2.0, -2.0])
def test_keyframe_waves_of_rolling_arc_equal_the_closed_form(bend_rad: float) -> None:
    """All yaw joints follow one cosine, and all pitch joints one sine, as in the closed form of rolling."""
    robot = make_alternating_robot()
    fractions = compute_node_fractions(robot)
    length_m = measure_length_m(robot)
    waves = KeyframeWaves(robot, lambda phase: compute_arc(fractions, length_m, bend_rad, phase))
    waves.advance_fit()
    amplitudes = np.fft.rfft(waves.keyframes_rad, axis=0)[1] / 8  # complex, of the first harmonic
    inner = amplitudes[2:-2]
    pair_bend_rad = 2.0 * 2.0 / 19.0  # of two links, in one of the two planes
    assert np.abs(inner) == pytest.approx(pair_bend_rad, rel=0.12)
    lead_rad = np.angle(inner[1::2] / inner[0::2])  # of pitch before yaw
    assert lead_rad == pytest.approx(
        np.full(len(lead_rad), np.sign(bend_rad) * lead_rad[0] * np.sign(bend_rad)), abs=0.2
    )
    assert np.abs(lead_rad) == pytest.approx(0.5 * np.pi, abs=0.2)


@pytest.mark.parametrize(
    ("gait", "parameters"),
    [
        (BackboneSidewinding, BackboneSidewindingParameters(half_width=0.25, wavelength=0.75)),
        (BackboneSidewinding, BackboneSidewindingParameters(wavelength=0.2)),
    ],
    ids=["wide", "short"],
)
def test_backbone_gait_with_helix_beyond_joint_limits_is_refused(gait, parameters) -> None:
    with raises_error(ConfigError):
        gait.check(make_alternating_robot(), parameters)


@pytest.mark.parametrize(
    "robot", [make_alternating_robot(), make_robot(13)], ids=["alternating", "planar"]
)
def test_backbone_gaits_with_default_parameters_are_accepted(robot: RobotDescription) -> None:
    """A planar robot is not refused: it holds its pose and reports the reason."""
    BackboneSidewinding.check(robot, PARAMETERS)
    BackboneRolling.check(robot, BackboneRollingParameters())
