"""A robot with pitch joints climbs a step, and pushes itself off pegs before and behind it."""

import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.runs.whole_run import load_run_config, run_controller

BEHIND_STEP_M = 2.8  # after this advance, the tail has left the step


@pytest.mark.heavy
@pytest.mark.parametrize("height_m", [0.05, pytest.param(0.1, marks=pytest.mark.slow)])
def test_snake_with_pitch_joints_climbs_over_a_step(height_m: float) -> None:
    settings = (
        "scene.step.0.position_m=[2.3,0.0]",
        f"scene.step.0.height_m={height_m}",
        "control.search_after_s=0.0",
    )
    run = run_controller(load_run_config("mamba_step", *settings), duration_s=11.0)
    assert run.advance_m > BEHIND_STEP_M
    # On level ground the controller pushes with joints in torque mode.
    assert (run.record.mode == JointMode.TORQUE.value).any()


@pytest.mark.slow
def test_snake_with_low_climb_limit_is_stopped_by_step() -> None:
    settings = (
        "mission.max_climb_m=0.04",
        "scene.step.0.position_m=[2.3,0.0]",
        "control.search_after_s=0.0",
    )
    run = run_controller(load_run_config("mamba_step", *settings), duration_s=6.0)
    assert run.advance_m < 1.0
