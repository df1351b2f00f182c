"""A robot that turns up and down climbs a step that stops it otherwise, and goes on pushing itself off pegs."""

import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.runs.whole_run import load_run_config, run_controller

BEHIND_M = 2.8  # the tail has left the step


@pytest.mark.parametrize("height_m", [0.05, pytest.param(0.1, marks=pytest.mark.slow)])
def test_a_whole_snake_climbs_over_a_step(height_m: float) -> None:
    near = (
        "scene.step.0.position_m=[2.3,0.0]",
        f"scene.step.0.height_m={height_m}",
        "control.search_after_s=0.0",
    )
    whole = run_controller(load_run_config("mamba_step", *near), duration_s=11.0)
    assert whole.advance_m > BEHIND_M
    assert (whole.record.mode == JointMode.TORQUE.value).any()  # on the level it pushes by torque


@pytest.mark.slow
def test_a_step_that_it_may_not_climb_stops_it() -> None:
    low = (
        "mission.max_climb_m=0.04",
        "scene.step.0.position_m=[2.3,0.0]",
        "control.search_after_s=0.0",
    )
    assert run_controller(load_run_config("mamba_step", *low), duration_s=6.0).advance_m < 1.0
