"""The baselines: a wave that travels to the tail, and bends towards the goal."""

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


def references(controller, stage, ticks: int, speed_m_s: float = 0.0) -> np.ndarray:
    observations = [
        stage.make_observation(tick, TAIL_S_M + 0.01 * tick * speed_m_s) for tick in range(ticks)
    ]
    return np.array(
        [controller.update(observation).telemetry.reference_rad for observation in observations]
    )


def test_the_wave_travels_from_head_to_tail() -> None:
    stage = make_stage()
    angles = references(LateralUndulation(stage.robot, LateralUndulationParameters()), stage, 200)
    peaks = angles.argmax(axis=0)
    assert peaks[11] < peaks[10] < peaks[9]


@pytest.mark.parametrize(("lag_rad", "bends"), [(0.9, 1.0), (-0.9, -1.0)])
def test_undulation_head_steers_to_path_and_against_its_bend(lag_rad: float, bends: float) -> None:
    stage = make_stage()
    straight = references(
        LateralUndulation(stage.robot, LateralUndulationParameters(lag_rad=lag_rad)), stage, 1
    )
    stage.route = Route([(0.0, 0.0), (2.0, 0.0), (2.0, 3.0)])
    steered = references(
        HeadSteeredUndulation(stage.robot, HeadSteeredUndulationParameters(lag_rad=lag_rad)),
        stage,
        1,
    )
    assert bends * (np.mean(steered[0]) - np.mean(straight[0])) > 0.01


def test_undulation_standing_body_is_pushed_harder_up_to_limit() -> None:
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
    pushed = np.abs(np.array(last.setpoints.target) - first.setpoints.target)
    assert 0.01 < pushed.max() < 2.0 / 60.0 + 0.25  # of the torque, and of the largest look-ahead
    assert last.telemetry.propulsion_n is not None
    assert first.telemetry.propulsion_n is not None
    assert last.telemetry.propulsion_n > first.telemetry.propulsion_n


@cache
def pushed(push_scale: float, push_sign_s: float = 0.0) -> np.ndarray:
    """References of a body that stays where it is."""
    stage = make_stage()
    parameters = ObstacleAidedParameters(
        push_scale=push_scale,
        push_sign_s=push_sign_s,
        search_after_s=0.0,
        shape_nm_per_rad=POSITION_MODE_NM_PER_RAD,
    )
    return references(ObstacleAided(stage.robot, parameters), stage, 300)


@pytest.mark.slow
def test_a_scaled_push_is_turned_round() -> None:
    still = pushed(0.0)
    forward, back = (pushed(scale)[-1] - still[-1] for scale in (1.0, -1.0))
    assert forward @ back < 0
    assert np.abs(still[-1] - still[0]).max() < 1e-6


def test_undulation_push_uses_friction_of_the_planned_path() -> None:
    tilts: list[float] = []
    for friction in (0.0, 0.2):
        stage = make_stage()
        stage.assumed_obstacle_friction = friction
        controller = ObstacleAided(stage.robot, ObstacleAidedParameters())
        points = [controller.update(stage.make_observation(tick, TAIL_S_M)) for tick in range(50)][
            -1
        ].telemetry.push_points
        assert len(points) >= 3
        # Of the forces, along the way.
        tilts.append(float(np.mean([point.normal_w[0] for point in points])))
    assert tilts[0] - tilts[1] == pytest.approx(0.2, abs=0.05)


def test_a_push_of_random_sign_goes_both_ways() -> None:
    start = pushed(0.0)[0]
    along = (pushed(1.0, push_sign_s=0.5) - start) @ (pushed(1.0)[-1] - start)
    assert along.max() > 0.0 > along.min()


def test_undulation_compliant_wave_shrinks_only_at_resistance() -> None:
    stage, parameters = (
        make_stage(),
        CompliantUndulationParameters(softness_rad_per_nm=0.1, steering=0.0),
    )

    def largest(resistance: float) -> float:
        controller, swing = CompliantUndulation(stage.robot, parameters), 0.0
        for tick in range(400):
            observation = stage.make_observation(tick, TAIL_S_M)
            resisted = [
                resistance * angle for angle in controller.compute_reference_rad(observation, 0.0)
            ]
            joints = msgspec.structs.replace(observation.joints, torque_nm=resisted)
            reference = controller.update(
                dataclasses.replace(observation, joints=joints)
            ).telemetry.reference_rad
            swing = max(swing, float(np.abs(reference).max())) if tick > 200 else 0.0
        return swing

    assert abs(largest(0.0) - parameters.amplitude_rad) < 0.01
    assert largest(4.0) < 0.8 * parameters.amplitude_rad


def test_without_a_path_a_compliant_wave_yields_to_nothing() -> None:
    stage = make_stage()
    controller = CompliantUndulation(stage.robot, CompliantUndulationParameters())
    observations = [
        stage.make_observation(t, TAIL_S_M, without="trajectory", torque_nm=3.0) for t in range(50)
    ]
    held = [controller.update(observation).telemetry.reference_rad for observation in observations]
    assert all(one == held[0] for one in held)


def test_undulation_jammed_wave_reverses_for_a_while() -> None:
    parameters = CompliantUndulationParameters(
        softness_rad_per_nm=0.0, steering=0.0, jam_after_s=0.5, back_s=0.3
    )
    stage = make_stage()
    jammed, free = (
        references(CompliantUndulation(stage.robot, parameters), stage, 200, speed)
        for speed in (0.0, 0.2)
    )
    assert np.abs(jammed[:50] - free[:50]).max() < 1e-9
    assert np.abs(jammed[80] - free[20]).max() < 0.05  # 0.5 s on, 0.3 s back
    assert np.abs(jammed[110] - free[50]).max() < 0.05  # and on again
