"""Tests the undulating baselines, whose wave travels to the tail and bends towards the goal, and pushes by waves."""

import dataclasses
from functools import cache

import msgspec
import numpy as np
import pytest

from snakesim_gnc.control.obstacle_aided import ObstacleAided, ObstacleAidedParameters
from snakesim_gnc.control.undulation import (
    CompliantUndulation,
    CompliantUndulationParameters,
    HeadSteeredUndulation,
    HeadSteeredUndulationParameters,
    LateralUndulation,
    LateralUndulationParameters,
)
from snakesim_hal.model.geometry.route import Route
from snakesim_testing.gnc.stage import make_stage

TAIL_S_M = 0.3
# With this stiffness of the shape, all joints are in position mode, and their targets show the push.
POSITION_MODE_NM_PER_RAD = 0.0


def list_references_rad(controller, stage, ticks: int, speed_m_s: float = 0.0) -> np.ndarray:
    """Return the reference angles of each tick for a body that advances on its path at constant speed."""
    observations = [
        stage.make_observation(tick, TAIL_S_M + 0.01 * tick * speed_m_s) for tick in range(ticks)
    ]
    return np.array(
        [controller.update(observation).telemetry.reference_rad for observation in observations]
    )


def test_undulation_wave_travels_from_head_to_tail() -> None:
    stage = make_stage()
    angles = list_references_rad(
        LateralUndulation(stage.robot, LateralUndulationParameters()), stage, 200
    )
    peaks = angles.argmax(axis=0)
    assert peaks[11] < peaks[10] < peaks[9]


@pytest.mark.parametrize(("lag_rad", "sign"), [(0.9, 1.0), (-0.9, -1.0)])
def test_undulation_head_steers_to_path_and_against_its_bend(lag_rad: float, sign: float) -> None:
    stage = make_stage()
    straight = list_references_rad(
        LateralUndulation(stage.robot, LateralUndulationParameters(lag_rad=lag_rad)), stage, 1
    )
    stage.route = Route([(0.0, 0.0), (2.0, 0.0), (2.0, 3.0)])
    steered = list_references_rad(
        HeadSteeredUndulation(stage.robot, HeadSteeredUndulationParameters(lag_rad=lag_rad)),
        stage,
        1,
    )
    assert sign * (np.mean(steered[0]) - np.mean(straight[0])) > 0.01


def test_obstacle_aided_pushes_standing_body_harder_up_to_limit() -> None:
    stage = make_stage()
    controller = ObstacleAided(
        stage.robot,
        ObstacleAidedParameters(
            max_torque_nm=2.0, search_after_s=0.0, shape_nm_per_rad=POSITION_MODE_NM_PER_RAD
        ),
    )
    first, *_, last = [
        controller.update(stage.make_observation(tick, TAIL_S_M)) for tick in range(400)
    ]
    moved_rad = np.abs(np.array(last.setpoints.target) - first.setpoints.target)
    # The limit has a part of the torque limit over the stiffness, and one of the largest look-ahead.
    assert 0.01 < moved_rad.max() < 2.0 / 60.0 + 0.25
    assert last.telemetry.propulsion_n is not None
    assert first.telemetry.propulsion_n is not None
    assert last.telemetry.propulsion_n > first.telemetry.propulsion_n


@cache
def list_pushing_references_rad(push_scale: float, push_sign_s: float = 0.0) -> np.ndarray:
    """Return the reference angles of each tick while a controller pushes a body that does not move."""
    stage = make_stage()
    parameters = ObstacleAidedParameters(
        push_scale=push_scale,
        push_sign_s=push_sign_s,
        search_after_s=0.0,
        shape_nm_per_rad=POSITION_MODE_NM_PER_RAD,
    )
    return list_references_rad(ObstacleAided(stage.robot, parameters), stage, 300)


@pytest.mark.slow
def test_obstacle_aided_negative_push_scale_reverses_the_push() -> None:
    without_push_rad = list_pushing_references_rad(0.0)
    forward_rad = list_pushing_references_rad(1.0)[-1] - without_push_rad[-1]
    backward_rad = list_pushing_references_rad(-1.0)[-1] - without_push_rad[-1]
    assert forward_rad @ backward_rad < 0
    assert np.abs(without_push_rad[-1] - without_push_rad[0]).max() < 1e-6


def test_obstacle_aided_push_uses_friction_of_the_planned_path() -> None:
    mean_normals_x: list[float] = []
    for friction in (0.0, 0.2):
        stage = make_stage()
        stage.assumed_obstacle_friction = friction
        controller = ObstacleAided(stage.robot, ObstacleAidedParameters())
        commands = [controller.update(stage.make_observation(tick, TAIL_S_M)) for tick in range(50)]
        push_points = commands[-1].telemetry.push_points
        assert len(push_points) >= 3
        mean_normals_x.append(float(np.mean([point.normal_w[0] for point in push_points])))
    # Friction tilts the forces backward.
    without_friction, with_friction = mean_normals_x
    assert without_friction - with_friction == pytest.approx(0.2, abs=0.05)


def test_obstacle_aided_push_of_random_sign_acts_both_ways() -> None:
    start_rad = list_pushing_references_rad(0.0)[0]
    random_sign_rad = list_pushing_references_rad(1.0, push_sign_s=0.5) - start_rad
    forward_rad = list_pushing_references_rad(1.0)[-1] - start_rad
    projections = random_sign_rad @ forward_rad
    assert projections.max() > 0.0 > projections.min()


def test_undulation_compliant_wave_shrinks_only_at_resistance() -> None:
    stage = make_stage()
    parameters = CompliantUndulationParameters(softness_rad_per_nm=0.1, steering=0.0)

    def measure_amplitude_rad(resistance_nm_per_rad: float) -> float:
        """Return the largest reference angle while springs resist the joints."""
        controller = CompliantUndulation(stage.robot, parameters)
        amplitude_rad = 0.0
        for tick in range(400):
            observation = stage.make_observation(tick, TAIL_S_M)
            torques_nm = [
                resistance_nm_per_rad * angle_rad
                for angle_rad in controller.compute_reference_rad(observation, 0.0)
            ]
            joints = msgspec.structs.replace(observation.joints, torque_nm=torques_nm)
            command = controller.update(dataclasses.replace(observation, joints=joints))
            if tick > 200:
                reference_rad = float(np.abs(command.telemetry.reference_rad).max())
                amplitude_rad = max(amplitude_rad, reference_rad)
        return amplitude_rad

    assert abs(measure_amplitude_rad(0.0) - parameters.amplitude_rad) < 0.01
    assert measure_amplitude_rad(4.0) < 0.8 * parameters.amplitude_rad


def test_undulation_compliant_wave_without_path_ignores_resistance() -> None:
    stage = make_stage()
    controller = CompliantUndulation(stage.robot, CompliantUndulationParameters())
    observations = [
        stage.make_observation(tick, TAIL_S_M, without="trajectory", torque_nm=3.0)
        for tick in range(50)
    ]
    references_rad = [
        controller.update(observation).telemetry.reference_rad for observation in observations
    ]
    assert all(reference_rad == references_rad[0] for reference_rad in references_rad)


def test_undulation_jammed_wave_reverses_for_a_while() -> None:
    parameters = CompliantUndulationParameters(
        softness_rad_per_nm=0.0, steering=0.0, jam_after_s=0.5, back_s=0.3
    )
    stage = make_stage()
    jammed, free = (
        list_references_rad(CompliantUndulation(stage.robot, parameters), stage, 200, speed)
        for speed in (0.0, 0.2)
    )
    assert np.abs(jammed[:50] - free[:50]).max() < 1e-9
    # After 0.5 s forward and 0.3 s backward, the wave is where it was after 0.2 s.
    assert np.abs(jammed[80] - free[20]).max() < 0.05
    # Another 0.3 s later, it is where the reversal began.
    assert np.abs(jammed[110] - free[50]).max() < 0.05
