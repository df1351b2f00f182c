"""The report of a body that pushes with all joints: forces, obstacles, stops, and the map against the truth."""

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

SECONDS = 1.5
MOVING = ("position_w_m", "orientation_wxyz", "angle_rad")


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return simulate(
        load_scenario("surveyed_clutter", [parse_set_option(f"duration_s={SECONDS}")]).config
    ).record


@pytest.mark.slow
def test_pushing_forces_are_listed_along_the_body(record: RunRecord) -> None:
    reported = make_pushing_section(record)
    assert reported is not None
    assert reported.map_errors is None  # the map was known
    wanted, felt = (np.array(line["y"], dtype=float) for line in reported.forces["data"])
    assert 2.0 < np.nanmax(wanted) < 60.0
    assert np.nanmax(felt) > 2.0
    (drag,) = [one for one in reported.forces["layout"]["shapes"] if one.get("xref") == "paper"]
    assert drag["y0"] == pytest.approx(
        0.1 * 9.81 * sum(link.mass_kg for link in record.description.links)
    )


def test_every_obstacle_that_was_pushed_has_a_row(record: RunRecord) -> None:
    reported = make_pushing_section(record)
    assert reported is not None
    pushed = {
        p.obstacle
        for state in record.control_states
        for p in state.push_points
        if np.hypot(*p.force_w[:2]) >= 0.5
    }
    assert set(reported.obstacles["data"][0]["y"]) == pushed
    assert len(pushed) >= 3


def test_pushing_stop_has_the_longest_reported_reason(record: RunRecord) -> None:
    control = [
        msgspec.structs.replace(
            one, state="NotLocomoting", reason="contacts lost" if k < 4 else "jam"
        )
        for k, one in enumerate(record.control_states)
    ]
    reported = make_pushing_section(replace_fields(record, control_states=control))
    assert reported is not None and not reported.stops, "it moves, whatever is reported"
    held = {name: getattr(record, name)[:1].repeat(len(record.time_s), axis=0) for name in MOVING}
    reported = make_pushing_section(replace_fields(record, control_states=control, **held))
    assert reported is not None
    assert [one.reason for one in reported.stops] == ["jam"]
    assert reported.stops[0].end_s - reported.stops[0].start_s == pytest.approx(SECONDS, abs=0.11)


def test_a_perceived_map_is_held_against_the_truth(record: RunRecord) -> None:
    config = msgspec.structs.replace(
        record.config, mission=msgspec.structs.replace(record.config.mission, map="perceived")
    )
    truth = [placed.obstacle for placed in place_obstacles(config)]
    shifted = [
        msgspec.structs.replace(
            one, position_w=(one.position_w[0] + 0.01, *one.position_w[1:]), position_sd_m=0.01
        )
        for one in truth
    ]
    worlds = [msgspec.structs.replace(world, obstacles=shifted) for world in record.worlds]
    reported = make_pushing_section(replace_fields(record, config=config, worlds=worlds))
    assert reported is not None
    assert reported.map_score is not None
    assert reported.map_errors is not None
    assert reported.position_error_percentiles_mm == pytest.approx((10.0, 10.0), abs=0.01)
    assert (
        reported.map_score.missed_count
        == reported.map_score.ghost_count
        == 0
        < reported.map_score.visible_count
    )


def test_the_page_has_the_section_only_for_such_a_controller(record: RunRecord) -> None:
    assert "pushing" in ReportReader(render_report(record, summarize_run(record, "complete"))).ids
    one_joint = [
        msgspec.structs.replace(one, propulsion_joint="joint_5") for one in record.control_states
    ]
    assert make_pushing_section(replace_fields(record, control_states=one_joint)) is None
