"""The report section about a controller that pushes with all joints: forces, obstacles, stops, and map errors."""

import msgspec
import numpy as np
import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option, place_obstacles
from snakesim_operator.results.report import render_report
from snakesim_operator.results.report.pushing import make_pushing_section
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.in_process import simulate
from snakesim_testing.operator.triplet_report import ReportReader, replace_fields

DURATION_S = 1.5
GROUND_FRICTION = 0.1
MIN_PUSH_N = 0.5  # weaker push-points are not in the report
POSE_SIGNALS = ("position_w_m", "orientation_wxyz", "angle_rad")


@pytest.fixture(scope="module")
def record() -> RunRecord:
    """A run in clutter whose map is known."""
    return simulate(
        load_scenario("surveyed_clutter", [parse_set_option(f"duration_s={DURATION_S}")]).config
    ).record


@pytest.mark.slow
def test_pushing_section_lists_forces_along_the_body(record: RunRecord) -> None:
    section = make_pushing_section(record)
    assert section is not None
    assert section.map_errors is None, "a known map has no errors"
    desired_n, measured_n = (np.array(line["y"], dtype=float) for line in section.forces["data"])
    assert 2.0 < np.nanmax(desired_n) < 60.0
    assert np.nanmax(measured_n) > 2.0
    shapes = section.forces["layout"]["shapes"]
    (drag_line,) = [shape for shape in shapes if shape.get("xref") == "paper"]
    weight_n = 9.81 * sum(link.mass_kg for link in record.description.links)
    assert drag_line["y0"] == pytest.approx(GROUND_FRICTION * weight_n)


def test_pushing_section_has_row_for_every_pushed_obstacle(record: RunRecord) -> None:
    section = make_pushing_section(record)
    assert section is not None
    pushed = {
        point.obstacle
        for state in record.control_states
        for point in state.push_points
        if np.hypot(*point.force_w[:2]) >= MIN_PUSH_N
    }
    assert set(section.obstacles["data"][0]["y"]) == pushed
    assert len(pushed) >= 3


def test_pushing_stop_has_the_longest_reported_reason(record: RunRecord) -> None:
    control_states = [
        msgspec.structs.replace(
            state, state="NotLocomoting", reason="contacts lost" if i < 4 else "jam"
        )
        for i, state in enumerate(record.control_states)
    ]
    moving = make_pushing_section(replace_fields(record, control_states=control_states))
    assert moving is not None and not moving.stops, "the body moves, whatever control reports"
    first_pose = {
        name: getattr(record, name)[:1].repeat(len(record.time_s), axis=0) for name in POSE_SIGNALS
    }
    stopped = make_pushing_section(
        replace_fields(record, control_states=control_states, **first_pose)
    )
    assert stopped is not None
    (stop,) = stopped.stops
    assert stop.reason == "jam"
    assert stop.end_s - stop.start_s == pytest.approx(DURATION_S, abs=0.11)


def test_pushing_section_compares_perceived_map_with_truth(record: RunRecord) -> None:
    config = msgspec.structs.replace(
        record.config, mission=msgspec.structs.replace(record.config.mission, map="perceived")
    )
    truth = [placed.obstacle for placed in place_obstacles(config)]
    shifted = [
        msgspec.structs.replace(
            obstacle,
            position_w=(obstacle.position_w[0] + 0.01, *obstacle.position_w[1:]),
            position_sd_m=0.01,
        )
        for obstacle in truth
    ]
    worlds = [msgspec.structs.replace(world, obstacles=shifted) for world in record.worlds]
    section = make_pushing_section(replace_fields(record, config=config, worlds=worlds))
    assert section is not None
    assert section.map_score is not None
    assert section.map_errors is not None
    assert section.position_error_percentiles_mm == pytest.approx((10.0, 10.0), abs=0.01)
    assert section.map_score.missed_count == 0
    assert section.map_score.ghost_count == 0
    assert section.map_score.visible_count > 0


def test_pushing_section_is_only_for_controllers_without_propulsion_joint(
    record: RunRecord,
) -> None:
    page = ReportReader(render_report(record, summarize_run(record, "complete")))
    assert "pushing" in page.ids
    control_states = [
        msgspec.structs.replace(state, propulsion_joint="joint_5")
        for state in record.control_states
    ]
    assert make_pushing_section(replace_fields(record, control_states=control_states)) is None
