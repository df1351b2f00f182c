"""Each gait of the literature moves the robot in the simulator, on a scene that suits the gait."""

import numpy as np
import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.in_process import simulate

ON_PEGS = ("control.wavelength=0.31", "control.winding_angle_rad=0.45")  # the wave of the row


def run_gait(
    gait: str, scenario: str, seconds: float, *options: str
) -> tuple[RunRecord, RunSummary]:
    """Run a gait to the end. The options are as `--set` takes them."""
    texts = (f"controller={gait}", f"duration_s={seconds}", *options)
    result = simulate(load_scenario(scenario, [parse_set_option(text) for text in texts]).config)
    assert result.summary.ended == "complete"
    return result.record, result.summary


def find_displacement_m(record: RunRecord) -> tuple[float, float]:
    """Return how far the center of the body moved along x, its initial direction, and along y."""
    rows = np.flatnonzero(record.has_pose)[[0, -1]]
    first, last = (record.find_body_points_w(int(row)) for row in rows)
    assert first is not None
    assert last is not None
    x, y, _ = (last - first).mean(axis=0)
    return float(x), float(y)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("gait", "scenario", "sets", "min_forward_m"),
    [
        ("serpenoid", "scales", (), 0.15),
        ("cpg", "scales", (), 0.12),
        ("serpenoid", "slope", ("scene.ground.slope_rad=0.0873",), 0.3),
        ("serpenoid", "peg_row", ON_PEGS, 0.8),
        pytest.param("cpg", "peg_row", ON_PEGS, 0.8, marks=pytest.mark.slow),
    ],
)
def test_gait_moves_forward(
    gait: str, scenario: str, sets: tuple[str, ...], min_forward_m: float
) -> None:
    record, _ = run_gait(gait, scenario, 4, *sets)
    forward_m, sideways_m = find_displacement_m(record)
    assert forward_m > min_forward_m
    assert abs(sideways_m) < 0.5 * forward_m


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("gait", "side"),
    [("serpenoid", 1.0)]
    + [
        pytest.param(*row, marks=pytest.mark.slow)
        for row in (("serpenoid", -1.0), ("cpg", 1.0), ("cpg", -1.0))
    ],
)
def test_directional_control_turns_body_towards_its_goal(gait: str, side: float) -> None:
    goal = (
        "mission.goal.kind=heading",
        f"mission.goal.heading_rad={side * 0.8}",
        "mission.goal.distance_m=5",
    )
    record, summary = run_gait(gait, "scales", 10, *goal)
    forward_m, sideways_m = find_displacement_m(record)
    assert forward_m > 0.3
    assert side * sideways_m > 0.08
    assert not summary.limited_commands  # planned paths do not jerk the joints


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("height", "side"), [(0.015, 1.0), pytest.param(-0.015, -1.0, marks=pytest.mark.slow)]
)
def test_backbone_sidewinding_moves_to_the_requested_side(height: float, side: float) -> None:
    record, _ = run_gait("backbone_sidewinding", "mamba_flat", 4, f"control.half_height={height}")
    forward_m, sideways_m = find_displacement_m(record)
    assert side * sideways_m > 0.6
    assert abs(forward_m) < 0.6 * abs(sideways_m)


@pytest.mark.heavy
def test_backbone_rolling_moves_sideways() -> None:
    record, _ = run_gait("backbone_rolling", "mamba_flat", 4)
    forward_m, sideways_m = find_displacement_m(record)
    assert abs(sideways_m) > 0.25
    assert abs(forward_m) < 0.3 * abs(sideways_m)


@pytest.mark.heavy
def test_concertina_in_corridor_advances_and_braces_between_walls() -> None:
    record, summary = run_gait("concertina", "corridor", 8.5)
    forward_m, _ = find_displacement_m(record)
    assert forward_m > 0.12
    assert summary.peak_contact_force_n is not None
    assert summary.peak_contact_force_n > 5.0  # it braces between the walls


@pytest.mark.slow
def test_concertina_without_walls_advances_less_than_in_corridor() -> None:
    free, _ = run_gait("concertina", "corridor", 8.5, "scene.wall=[]")
    braced, _ = run_gait("concertina", "corridor", 8.5)
    free_m, _ = find_displacement_m(free)
    braced_m, _ = find_displacement_m(braced)
    assert braced_m > 1.5 * free_m


@pytest.mark.heavy
def test_rectilinear_motion_moves_body_forward() -> None:
    record, _ = run_gait("rectilinear", "mamba_flat", 5)
    forward_m, _ = find_displacement_m(record)
    assert forward_m > 0.06


@pytest.mark.heavy
def test_sinus_lifting_reverses_the_direction_of_travel() -> None:
    """On isotropic friction, the same wave moves the body backward if all of the body rests on the ground."""
    lifted, _ = run_gait("sinus_lifting", "mamba_flat", 5)
    resting, _ = run_gait("sinus_lifting", "mamba_flat", 5, "control.lift_slope_rad=0")
    lifted_m, sideways_m = find_displacement_m(lifted)
    resting_m, _ = find_displacement_m(resting)
    assert lifted_m > 0.2
    assert abs(sideways_m) < 0.5 * lifted_m
    assert resting_m < -0.05


@pytest.mark.parametrize("gait", ["backbone_sidewinding", "rectilinear"])
def test_gait_on_planar_robot_does_not_move_and_reports_reason(gait: str) -> None:
    record, summary = run_gait(gait, "peg_row", 1)
    forward_m, sideways_m = find_displacement_m(record)
    assert np.hypot(forward_m, sideways_m) < 0.01
    assert summary.reported_reason is not None
    assert "no joints that turn up and down" in summary.reported_reason
