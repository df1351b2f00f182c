"""The report: sections, figures and words, on the triplet run."""

import dataclasses
import hashlib
import itertools
import math
import re
import xml.etree.ElementTree as ET

import msgspec
import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.metrics.propulsion import find_propulsion_intervals
from snakesim_operator.results.page.charts import find_strongest_per_bucket, select_rows_to_draw
from snakesim_operator.results.page.html import LIBRARY
from snakesim_operator.results.report import render_report as report_page
from snakesim_operator.results.report.events import find_events, select_snapshots_to_draw
from snakesim_operator.results.report.page import ELSEWHERE
from snakesim_operator.results.report.reasons import explain_push_points_without_contact
from snakesim_operator.results.report.snapshots import find_snapshots_with_force_balance
from snakesim_operator.results.report.timeline import compute_reference_rad, find_state_intervals
from snakesim_operator.results.report.view import find_body_points_xy_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import RunSummary, summarize_run
from snakesim_testing.operator.triplet_report import (
    DURATION_S,
    LOST_CONTACTS_REASON,
    ReportReader,
    render_and_check_report,
    replace_fields,
)

HAND_OVERS_S = (0.0, 0.28, 1.28, 2.42, 3.56, 4.72, 5.78, 6.1)
# 9 is joint_10.
INTERVALS_S = {9 - k: interval for k, interval in enumerate(itertools.pairwise(HAND_OVERS_S))}
DRAWING = r'<svg viewBox="[^"]*" class="figure" role.*?</svg>'


@pytest.fixture(scope="module")
def page(record: RunRecord) -> ReportReader:
    return render_and_check_report(record)


# --- a whole run -----------------------------------------------------------------------------------------------


def test_report_verdict_states_distance_and_hand_overs(page: ReportReader) -> None:
    said = (
        "Moved 0.62 m along the path in 10.0 s; propulsion handed over joint_10 → joint_9 → joint_8 → joint_7 → "
        "joint_6 → joint_5 → joint_4; no fault, 2 commands refused (stale)."
    )
    assert said in page.text
    assert (
        f"Locomotion ended at 6.3 s of 10.0 s: {LOST_CONTACTS_REASON}; no three push-points on alternating sides."
        in page.text
    )


def test_report_alarming_tiles_have_a_reason(record: RunRecord) -> None:
    late = dataclasses.replace(
        record, host=msgspec.structs.replace(record.host, answered_ticks=100)
    )
    html = report_page(late, summarize_run(late, "complete"))
    red = re.findall(
        r'class="tile alarming">.*?<span>(.*?)</span>(?:<span class="why">(.*?)</span>)?</div>',
        html,
    )
    why = {what.partition(";")[0]: reason for what, reason in red}
    assert why.keys() >= {
        "of the push-points without contact",
        "commands refused",
        "ticks whose command came in time",
    }
    assert all(why.values())
    assert why["commands refused"] == "stale 2"
    assert "a tick is 10.0 ms" in why["ticks whose command came in time"]
    apart = re.fullmatch(
        r"the body was off the obstacle in (\d+) % of them, by [\d.]+ mm \(median\); it touched in (\d+) % of them; "
        r"most often peg_\d_\d, \d+ of \d+",
        why["of the push-points without contact"],
    )
    assert apart is not None
    assert sum(map(int, apart.groups())) == 100
    assert "the record does not show why" in explain_push_points_without_contact(
        dataclasses.replace(late, position_w_m=late.position_w_m * np.nan)
    )


def test_playback_moves_the_snake_over_a_map(record: RunRecord, page: ReportReader) -> None:
    frames = page.film["frames"]
    assert frames[0][0] == 0
    assert frames[-1][0] == pytest.approx(DURATION_S, abs=0.02)
    assert 200 < len(frames) < 400
    assert all(len(nodes) == 2 * 15 for _, nodes, *_ in frames)
    propels = {joint for _, _, joint, *_ in frames}
    assert propels == {-1, *INTERVALS_S}
    solved, felt = ([len(frame[k]) for frame in frames] for k in (4, 5))
    assert set(solved) == {0, 16}
    assert set(felt) <= set(range(0, 24, 4))
    assert max(felt) >= 12
    assert not page.film["maps"]
    assert not page.film["paths"]  # its map is known, its route is the scene's
    assert page.film["captions"][frames[-1][3]].startswith(f"not moving: {LOST_CONTACTS_REASON}")


def test_every_series_of_the_run_is_a_chart(page: ReportReader) -> None:
    assert list(page.charts) == [
        "Advance over time",
        "States and propulsion joint over time",
        *(
            f"{what} of joint_{n} over time"
            for n in (9, 8, 7, 6, 5, 4)
            for what in ("Angle", "Torque")
        ),
        "Torque of every joint over time",
        "Largest torque of any joint as a share of its limit",
        "Strongest contact force over time, mean over 50 ms",
        "Obstacles touched over time",
    ]
    torque = page.charts["Torque of joint_7 over time"]
    assert [line["name"] for line in torque["data"]] == ["measured", "commanded"]
    shade, *_ = torque["layout"]["shapes"]
    assert (shade["x0"], shade["x1"]) == pytest.approx(INTERVALS_S[6], abs=0.051)
    assert shade["fillcolor"] == "--joint-6"
    commanded = dict(zip(torque["data"][1]["x"], torque["data"][1]["y"], strict=True))
    assert commanded[0.0] is None
    assert commanded[3.0] is not None  # unknown is a gap
    (torques,) = page.charts["Torque of every joint over time"]["data"]
    assert len(torques["z"]) == 13
    assert len(torques["z"][0]) == 480


def test_instants_are_events_and_none_looks_like_another(
    record: RunRecord, page: ReportReader
) -> None:
    found = find_events(record, summarize_run(record, "complete"))
    assert [one.joint_index for one in found if one.joint_index is not None] == list(INTERVALS_S)
    assert found[0].description == "Start"
    assert found[-1].description == "Stop"
    assert sum(one.description.startswith("Largest contact force") for one in found) == 1
    drawn = select_snapshots_to_draw(record, found)
    bodies = [find_body_points_xy_w(record, instant.row) for _, instant in drawn]
    assert all(np.abs(a - b).max() > 0.004 for a, b in itertools.combinations(bodies, 2))
    said = "; ".join(event.description for event, _ in drawn)
    for words in (
        "Start",
        "joint_10 begins to propel",
        "Hand-over to joint_4",
        "Largest contact force",
        "Stop",
    ):
        assert words in said
    assert len([title for title in page.titles if title.startswith("Top view at")]) == len(drawn)


def test_forces_balance_and_add_up_to_the_commanded_one(record: RunRecord) -> None:
    found = find_snapshots_with_force_balance(record)
    assert len(found) > 50
    for one in found:
        assert one.force_balance is not None
        assert one.force_balance.closure_error_n < 1e-9
        assert one.state is not None
        assert one.state.propulsion_n is not None
        ahead = one.state.propulsion_n * np.array(one.force_balance.contacts[0].tangent_w[:2])
        assert np.allclose(one.force_balance.resultant_force_n, ahead, atol=1e-9)


def test_all_polygons_have_one_scale_and_show_the_commanded_force(
    page: ReportReader, record: RunRecord
) -> None:
    figure = r'<svg viewBox="[^"]*" class="figure" role="img" aria-label="Force polygon.*?</svg>'
    polygons = re.findall(figure, page.html)
    lengths = [math.dist(*edge) for svg in polygons for edge in drawn_edges(svg, "commanded")]
    drawn = select_snapshots_to_draw(record, find_events(record, summarize_run(record, "complete")))
    forces_n = [
        one.state.propulsion_n
        for _, one in drawn
        if one.force_balance is not None and one.state is not None
    ]
    assert len(lengths) == len(polygons) == len(forces_n) > 2
    assert lengths == pytest.approx(
        [lengths[0] / (forces_n[0] or 0) * (force_n or 0) for force_n in forces_n], abs=0.5
    )
    ring = drawn_edges(polygons[0], "solved")
    assert math.dist(ring[0][0], ring[-1][1]) == pytest.approx(lengths[0], abs=0.5)


def test_report_force_without_contact_is_drawn_as_requested(
    page: ReportReader, record: RunRecord
) -> None:
    clear = replace_fields(
        record, worlds=[msgspec.structs.replace(one, contacts=[]) for one in record.worlds]
    )
    pages = page, render_and_check_report(clear)
    kinds = [{kind for frame in one.film["frames"] for kind in frame[8]} for one in pages]
    assert {"solved", "resultant", "solved unmeasured", "resultant unmeasured"} == kinds[0]
    assert {"solved unmeasured", "resultant unmeasured"} == kinds[1]
    drawings = re.findall(DRAWING, pages[1].html)
    classes = {
        found
        for svg in drawings
        for found in re.findall(r'class="((?:solved|resultant)[^"]*)"', svg)
    }
    assert {
        "solved unmeasured shaft",
        "solved unmeasured head",
        "resultant unmeasured shaft",
    } <= classes
    assert not {"solved shaft", "solved head", "resultant shaft", "resultant head"} & classes
    assert "desired, but no contact was measured there" in pages[1].text


def test_report_drawing_texts_do_not_overlap_or_cut_obstacles(page: ReportReader) -> None:
    drawings = [ET.fromstring(found) for found in re.findall(DRAWING, page.html)]
    assert len(drawings) > 8
    for drawing in drawings:
        for (a, first), (b, second) in itertools.combinations(
            [(t.text, box_of(t)) for t in drawing.iter("text")], 2
        ):
            wide = min(first[2], second[2]) - max(first[0], second[0])
            high = min(first[3], second[3]) - max(first[1], second[1])
            assert wide <= 1 or high <= 2, f"{a!r} and {b!r} in {drawing.get('aria-label')}"
        width, height = map(float, drawing.attrib["viewBox"].split()[2:])
        for x, y, r in [
            [float(c.attrib[k]) for k in ("cx", "cy", "r")] for c in drawing.iter("circle")
        ]:
            assert r <= x <= width - r
            assert r <= y <= height - r


def box_of(item: ET.Element) -> tuple[float, float, float, float]:
    x, y, width = float(item.attrib["x"]), float(item.attrib["y"]), 6.2 * len(item.text or "")
    left = {"start": x, "middle": x - width / 2, "end": x - width}[item.get("text-anchor", "start")]
    return left, y - 10, left + width, y + 1


def drawn_edges(svg: str, kind: str) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """From where a shaft starts to where its head ends, in the order of drawing."""
    items = [
        item for item in ET.fromstring(svg).iter() if item.get("class", "").startswith(f"{kind} ")
    ]
    tips = [item.attrib["points"].split()[0].split(",") for item in items[1::2]]
    starts = [(float(item.attrib["x1"]), float(item.attrib["y1"])) for item in items[::2]]
    return [(start, (float(x), float(y))) for start, (x, y) in zip(starts, tips, strict=True)]


def test_a_polygon_that_does_not_close_is_no_instant(record: RunRecord) -> None:
    more = [
        msgspec.structs.replace(one, desired_force_n=[1.3 * f for f in one.desired_force_n])
        for one in record.control_states
    ]
    wrong = replace_fields(record, control_states=more)
    assert find_snapshots_with_force_balance(wrong) == []
    assert "whose forces balance" in render_and_check_report(wrong).text


def test_report_table_has_every_summary_number_with_unit(
    record: RunRecord, page: ReportReader
) -> None:
    for field in msgspec.structs.fields(RunSummary):
        if field.name not in ELSEWHERE:
            assert field.name in page.text_parts, field.name
    assert {"N·m", "m/s", "µs", "J", "Hz"} <= set(page.text_parts)
    assert "torque_rate" in page.text_parts
    assert "41" in page.text_parts  # limited by the limiter
    assert "stale" in page.text_parts


def test_report_contains_the_command_of_the_run(page: ReportReader, record: RunRecord) -> None:
    assert f"snakesim run {record.path}/config.json --backend sim --seed 1" in page.html
    assert "&#34;amplitude_m&#34;: 0.045" in page.html


# --- parts -----------------------------------------------------------------------------------------------------


def test_intervals_and_bands_follow_the_telemetry(record: RunRecord) -> None:
    intervals = find_propulsion_intervals(record)
    assert [one.joint_index for one in intervals] == list(INTERVALS_S)
    for one in intervals:
        assert (one.start_s, one.end_s) == pytest.approx(INTERVALS_S[one.joint_index], abs=0.051)
    assert [band.label for band in find_state_intervals(record)] == [
        "NotLocomoting",
        "Locomoting",
        "NotLocomoting",
    ]
    assert find_state_intervals(record)[-1].end_s == pytest.approx(DURATION_S)


def test_report_reference_depends_on_mode_of_joint(
    record: RunRecord,
) -> None:
    reference = compute_reference_rad(record, 6)
    free = record.mode[:, 6] == JointMode.TORQUE
    assert np.array_equal(reference[~free], record.target[~free, 6])
    # No torque is taken for an angle.
    assert np.abs(reference[free] - record.target[free, 6]).max() > 1
    steps = np.abs(np.diff(reference))[np.diff(free.astype(int)) == 0]
    # Smooth, but where the limiter moves the target to what the torque implies.
    assert steps.max() < 0.02


def test_thinning_keeps_extremes_and_gaps() -> None:
    values = np.sin(np.linspace(0.0, 100.0, 100_000))
    values[54_321], values[12_345], values[70_000:71_000] = 9.0, -9.0, np.nan
    kept = values[select_rows_to_draw(values)]
    assert len(kept) <= 1510
    assert np.nanmax(kept) == 9.0
    assert np.nanmin(kept) == -9.0
    assert np.isnan(kept).any()
    columns = find_strongest_per_bucket(
        np.stack([values, np.full_like(values, np.nan)], axis=1), 480
    )
    assert columns.shape == (480, 2)
    assert np.nanmax(columns) == 9.0
    assert np.nanmin(columns) == -9.0


def test_the_plotting_library_is_the_one_that_its_note_names() -> None:
    digest = hashlib.sha256(LIBRARY.read_bytes()).hexdigest()
    assert f"`{LIBRARY.name}`" in (note := (LIBRARY.parent / "README.md").read_text())
    assert digest in note
    assert (LIBRARY.parent / "LICENSE-plotly.txt").is_file()


def test_report_yielding_obstacle_is_dashed_and_described(
    page: ReportReader, record: RunRecord
) -> None:
    row = record.config.scene.pegs_along_route[0]
    made = msgspec.structs.replace(
        row, lean_rad=0.2, stiffness_n_per_m=800.0, mass_kg=2.0, base_friction=0.5
    )
    scene = msgspec.structs.replace(record.config.scene, pegs_along_route=[made])
    loose = dataclasses.replace(record, config=msgspec.structs.replace(record.config, scene=scene))
    html = report_page(loose, summarize_run(loose, "complete"))
    assert 'class="peg yields"' in html
    assert 'class="peg yields"' not in page.html
    said = (
        "leans by 0.2 rad, springs back with 800 N/m, slides from 9.81 N on, and is "
        "drawn where it stood at the start"
    )
    assert f"<title>peg_0_1, {said}</title>" in html
