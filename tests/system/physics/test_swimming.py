"""Snakes swim: a shipped gait advances, and waves drift as an integrator without MuJoCo computes."""

import numpy as np
import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate
from snakesim_testing.sim.swimming import WATER, swim_wave, swim_without_mujoco
from snakesim_testing.sim.waves import JointWave

TOLERANCE_MM_S = 3.0
SLOW_WAVE = JointWave(0.3, 0.7, 4.0)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("controller", "min_forward_m"),
    [("serpenoid", 0.7), pytest.param("cpg", 0.7, marks=pytest.mark.slow)],
)
def test_undulation_swims_forward_at_its_depth(controller: str, min_forward_m: float) -> None:
    texts = (f"controller={controller}", "duration_s=4")
    result = simulate(load_scenario("swimming", [parse_set_option(text) for text in texts]).config)
    assert result.summary.ended == "complete"
    record = result.record
    rows = np.flatnonzero(record.has_pose)[[0, -1]]
    first, last = (record.find_body_points_w(int(row)) for row in rows)
    assert first is not None
    assert last is not None
    forward_m, sideways_m, up_m = (last - first).mean(axis=0)
    assert forward_m > min_forward_m
    assert abs(sideways_m) < 0.2 * forward_m
    assert abs(up_m) < 0.02


@pytest.mark.heavy
@pytest.mark.parametrize(
    "wave",
    [SLOW_WAVE, pytest.param(SLOW_WAVE.reversed, marks=pytest.mark.slow)],
    ids=["wave", "its reverse"],
)
def test_wave_in_water_drifts_as_momentum_balance_computes(wave: JointWave) -> None:
    drift_mm_s = swim_wave(wave, WATER).drift_mm_s
    assert abs(drift_mm_s) > 150.0
    expected_mm_s = swim_without_mujoco(wave, WATER, 0.002).drift_mm_s
    assert drift_mm_s == pytest.approx(expected_mm_s, abs=TOLERANCE_MM_S)
