"""The report on a run of the scenario `triplet`: its sections, figures and texts."""

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
from snakesim_operator.results.report import render_report
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
# When each joint propels, by joint index: first joint_10, whose index is 9.
INTERVALS_S = {9 - k: interval for k, interval in enumerate(itertools.pairwise(HAND_OVERS_S))}
# Index of these parts in a frame of the playback; a force has four numbers.
DESIRED_FORCES = 4
MEASURED_FORCES = 5
FORCE_KINDS = 8
CHARACTER_WIDTH_PX = 6.2  # mean width of a character in a drawing
DRAWING_PATTERN = r'<svg viewBox="[^"]*" class="figure" role.*?</svg>'


@pytest.fixture(scope="module")
def page(record: RunRecord) -> ReportReader:
    """The report on the whole run."""
    return render_and_check_report(record)


# --- a whole run -----------------------------------------------------------------------------------------------


def test_report_verdict_states_distance_and_hand_overs(page: ReportReader) -> None:
    expected = (
        "Moved 0.62 m along the path in 10.0 s; propulsion handed over joint_10 → joint_9 → joint_8 → joint_7 → "
        "joint_6 → joint_5 → joint_4; no fault, 2 commands refused (stale)."
    )
    assert expected in page.text
    assert (
        f"Locomotion ended at 6.3 s of 10.0 s: {LOST_CONTACTS_REASON}; no three push-points on alternating sides."
        in page.text
    )


def test_report_alarming_tiles_state_their_reason(record: RunRecord) -> None:
    late = dataclasses.replace(
        record, host=msgspec.structs.replace(record.host, answered_ticks=100)
    )
    html = render_report(late, summarize_run(late, "complete"))
    alarming_tiles = re.findall(
        r'class="tile alarming">.*?<span>(.*?)</span>(?:<span class="why">(.*?)</span>)?</div>',
        html,
    )
    reasons = {label.partition(";")[0]: reason for label, reason in alarming_tiles}
    assert reasons.keys() >= {
        "of the push-points without contact",
        "commands refused",
        "ticks whose command came in time",
    }
    assert all(reasons.values())
    assert reasons["commands refused"] == "stale 2"
    assert "a tick is 10.0 ms" in reasons["ticks whose command came in time"]
    without_contact = re.fullmatch(
        r"the body was off the obstacle in (\d+) % of them, by [\d.]+ mm \(median\); it touched in (\d+) % of them; "
        r"most often peg_\d_\d, \d+ of \d+",
        reasons["of the push-points without contact"],
    )
    assert without_contact is not None
    assert sum(map(int, without_contact.groups())) == 100
    without_pose = dataclasses.replace(late, position_w_m=late.position_w_m * np.nan)
    reason = explain_push_points_without_contact(without_pose)
    assert "the record does not show why" in reason


def test_report_playback_shows_body_forces_and_propulsion_joint(
    record: RunRecord, page: ReportReader
) -> None:
    frames = page.film["frames"]
    assert frames[0][0] == 0
    assert frames[-1][0] == pytest.approx(DURATION_S, abs=0.02)
    assert 200 < len(frames) < 400
    assert all(len(nodes) == 2 * 15 for _, nodes, *_ in frames)
    propulsion_joints = {joint for _, _, joint, *_ in frames}
    assert propulsion_joints == {-1, *INTERVALS_S}
    desired_counts = {len(frame[DESIRED_FORCES]) for frame in frames}
    measured_counts = {len(frame[MEASURED_FORCES]) for frame in frames}
    assert desired_counts == {0, 16}
    assert measured_counts <= set(range(0, 24, 4))
    assert max(measured_counts) >= 12
    assert not page.film["maps"], "the map of this robot is known"
    assert not page.film["paths"], "the route of this robot is that of the scene"
    assert page.film["captions"][frames[-1][3]].startswith(f"not moving: {LOST_CONTACTS_REASON}")


def test_report_has_chart_for_every_time_series(page: ReportReader) -> None:
    assert list(page.charts) == [
        "Advance over time",
        "States and propulsion joint over time",
        *(
            f"{quantity} of joint_{joint} over time"
            for joint in (9, 8, 7, 6, 5, 4)
            for quantity in ("Angle", "Torque")
        ),
        "Torque of every joint over time",
        "Largest torque of any joint as a share of its limit",
        "Strongest contact force over time, mean over 50 ms",
        "Obstacles touched over time",
    ]
    torque = page.charts["Torque of joint_7 over time"]
    assert [line["name"] for line in torque["data"]] == ["measured", "commanded"]
    band, *_ = torque["layout"]["shapes"]
    assert (band["x0"], band["x1"]) == pytest.approx(INTERVALS_S[6], abs=0.051)
    assert band["fillcolor"] == "--joint-6"
    commanded = dict(zip(torque["data"][1]["x"], torque["data"][1]["y"], strict=True))
    assert commanded[0.0] is None  # an unknown value is a gap in the line
    assert commanded[3.0] is not None
    (torques,) = page.charts["Torque of every joint over time"]["data"]
    assert len(torques["z"]) == 13
    assert len(torques["z"][0]) == 480


def test_report_top_views_show_events_with_different_bodies(
    record: RunRecord, page: ReportReader
) -> None:
    events = find_events(record, summarize_run(record, "complete"))
    propulsion_joints = [event.joint_index for event in events if event.joint_index is not None]
    assert propulsion_joints == list(INTERVALS_S)
    assert events[0].description == "Start"
    assert events[-1].description == "Stop"
    assert sum(event.description.startswith("Largest contact force") for event in events) == 1
    drawn = select_snapshots_to_draw(record, events)
    bodies = [find_body_points_xy_w(record, snapshot.row) for _, snapshot in drawn]
    assert all(np.abs(a - b).max() > 0.004 for a, b in itertools.combinations(bodies, 2))
    descriptions = "; ".join(event.description for event, _ in drawn)
    for description in (
        "Start",
        "joint_10 begins to propel",
        "Hand-over to joint_4",
        "Largest contact force",
        "Stop",
    ):
        assert description in descriptions
    assert len([title for title in page.titles if title.startswith("Top view at")]) == len(drawn)


def test_report_forces_balance_and_add_up_to_propulsion(record: RunRecord) -> None:
    snapshots = find_snapshots_with_force_balance(record)
    assert len(snapshots) > 50
    for snapshot in snapshots:
        balance = snapshot.force_balance
        assert balance is not None
        assert balance.closure_error_n < 1e-9
        assert snapshot.state is not None
        assert snapshot.state.propulsion_n is not None
        forward = np.array(balance.contacts[0].tangent_w[:2])
        expected_n = snapshot.state.propulsion_n * forward
        assert np.allclose(balance.resultant_force_n, expected_n, atol=1e-9)


def test_report_force_polygons_have_one_scale_and_show_propulsion(
    page: ReportReader, record: RunRecord
) -> None:
    pattern = r'<svg viewBox="[^"]*" class="figure" role="img" aria-label="Force polygon.*?</svg>'
    polygons = re.findall(pattern, page.html)
    lengths = [math.dist(*edge) for svg in polygons for edge in find_edges(svg, "commanded")]
    drawn = select_snapshots_to_draw(record, find_events(record, summarize_run(record, "complete")))
    forces_n = [
        snapshot.state.propulsion_n
        for _, snapshot in drawn
        if snapshot.force_balance is not None and snapshot.state is not None
    ]
    assert len(lengths) == len(polygons) == len(forces_n) > 2
    scale = lengths[0] / (forces_n[0] or 0)
    assert lengths == pytest.approx([scale * (force_n or 0) for force_n in forces_n], abs=0.5)
    edges = find_edges(polygons[0], "solved")
    polygon_start = edges[0][0]
    polygon_end = edges[-1][1]
    assert math.dist(polygon_start, polygon_end) == pytest.approx(lengths[0], abs=0.5)


def list_force_kinds(page: ReportReader) -> set[str]:
    """Return the kinds of all forces in the playback of a report."""
    return {kind for frame in page.film["frames"] for kind in frame[FORCE_KINDS]}


def test_report_force_without_contact_is_drawn_as_requested(
    page: ReportReader, record: RunRecord
) -> None:
    worlds = [msgspec.structs.replace(world, contacts=[]) for world in record.worlds]
    page_without_contacts = render_and_check_report(replace_fields(record, worlds=worlds))
    kinds = list_force_kinds(page)
    assert kinds == {"solved", "resultant", "solved unmeasured", "resultant unmeasured"}
    kinds_without_contacts = list_force_kinds(page_without_contacts)
    assert kinds_without_contacts == {"solved unmeasured", "resultant unmeasured"}
    drawings = re.findall(DRAWING_PATTERN, page_without_contacts.html)
    classes = {
        css_class
        for svg in drawings
        for css_class in re.findall(r'class="((?:solved|resultant)[^"]*)"', svg)
    }
    assert {
        "solved unmeasured shaft",
        "solved unmeasured head",
        "resultant unmeasured shaft",
    } <= classes
    assert not {"solved shaft", "solved head", "resultant shaft", "resultant head"} & classes
    assert "desired, but no contact was measured there" in page_without_contacts.text


def test_report_drawing_texts_do_not_overlap_or_cut_obstacles(page: ReportReader) -> None:
    drawings = [ET.fromstring(svg) for svg in re.findall(DRAWING_PATTERN, page.html)]
    assert len(drawings) > 8
    for drawing in drawings:
        labels = [(element.text, estimate_text_box(element)) for element in drawing.iter("text")]
        for (text_a, box_a), (text_b, box_b) in itertools.combinations(labels, 2):
            overlap_x = min(box_a[2], box_b[2]) - max(box_a[0], box_b[0])
            overlap_y = min(box_a[3], box_b[3]) - max(box_a[1], box_b[1])
            assert overlap_x <= 1 or overlap_y <= 2, (
                f"{text_a!r} and {text_b!r} in {drawing.get('aria-label')}"
            )
        width, height = map(float, drawing.attrib["viewBox"].split()[2:])
        for circle in drawing.iter("circle"):
            x, y, radius = (float(circle.attrib[name]) for name in ("cx", "cy", "r"))
            assert radius <= x <= width - radius
            assert radius <= y <= height - radius


def estimate_text_box(element: ET.Element) -> tuple[float, float, float, float]:
    """Estimate left, top, right and bottom of a text in an SVG drawing."""
    x = float(element.attrib["x"])
    y = float(element.attrib["y"])
    width = CHARACTER_WIDTH_PX * len(element.text or "")
    left_by_anchor = {"start": x, "middle": x - width / 2, "end": x - width}
    left = left_by_anchor[element.get("text-anchor", "start")]
    return left, y - 10, left + width, y + 1


def find_edges(svg: str, kind: str) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return the start of the shaft and the tip of the head of each arrow of a kind, in the order of drawing."""
    elements = [
        element
        for element in ET.fromstring(svg).iter()
        if element.get("class", "").startswith(f"{kind} ")
    ]
    shafts = elements[::2]
    heads = elements[1::2]
    starts = [(float(shaft.attrib["x1"]), float(shaft.attrib["y1"])) for shaft in shafts]
    tips = [head.attrib["points"].split()[0].split(",") for head in heads]
    return [(start, (float(x), float(y))) for start, (x, y) in zip(starts, tips, strict=True)]


def test_report_snapshots_exclude_forces_that_do_not_balance(record: RunRecord) -> None:
    control_states = [
        msgspec.structs.replace(
            state, desired_force_n=[1.3 * force for force in state.desired_force_n]
        )
        for state in record.control_states
    ]
    unbalanced = replace_fields(record, control_states=control_states)
    assert find_snapshots_with_force_balance(unbalanced) == []
    assert "whose forces balance" in render_and_check_report(unbalanced).text


def test_report_table_has_every_summary_number_with_unit(
    record: RunRecord, page: ReportReader
) -> None:
    for field in msgspec.structs.fields(RunSummary):
        if field.name not in ELSEWHERE:
            assert field.name in page.text_parts, field.name
    assert {"N·m", "m/s", "µs", "J", "Hz"} <= set(page.text_parts)
    assert "torque_rate" in page.text_parts
    assert "41" in page.text_parts  # setpoints that the command limiter changed
    assert "stale" in page.text_parts


def test_report_contains_the_command_of_the_run(page: ReportReader, record: RunRecord) -> None:
    assert f"snakesim run {record.path}/config.json --backend sim --seed 1" in page.html
    assert "&#34;amplitude_m&#34;: 0.045" in page.html


# --- parts -----------------------------------------------------------------------------------------------------


def test_report_intervals_follow_telemetry(record: RunRecord) -> None:
    propulsion_intervals = find_propulsion_intervals(record)
    assert [interval.joint_index for interval in propulsion_intervals] == list(INTERVALS_S)
    for interval in propulsion_intervals:
        expected_s = INTERVALS_S[interval.joint_index]
        assert (interval.start_s, interval.end_s) == pytest.approx(expected_s, abs=0.051)
    state_intervals = find_state_intervals(record)
    states = [interval.label for interval in state_intervals]
    assert states == ["NotLocomoting", "Locomoting", "NotLocomoting"]
    assert state_intervals[-1].end_s == pytest.approx(DURATION_S)


def test_report_reference_depends_on_mode_of_joint(
    record: RunRecord,
) -> None:
    joint = 6
    reference_rad = compute_reference_rad(record, joint)
    has_torque_mode = record.mode[:, joint] == JointMode.TORQUE
    targets = record.target[:, joint]
    assert np.array_equal(reference_rad[~has_torque_mode], targets[~has_torque_mode])
    # In torque mode the target is a torque, which the reference does not use as an angle.
    assert np.abs(reference_rad[has_torque_mode] - targets[has_torque_mode]).max() > 1
    # The reference is smooth, except where the mode changes.
    has_same_mode = np.diff(has_torque_mode.astype(int)) == 0
    steps_rad = np.abs(np.diff(reference_rad))[has_same_mode]
    assert steps_rad.max() < 0.02


def test_report_chart_thinning_keeps_extremes_and_gaps() -> None:
    values = np.sin(np.linspace(0.0, 100.0, 100_000))
    values[54_321] = 9.0
    values[12_345] = -9.0
    values[70_000:71_000] = np.nan
    kept = values[select_rows_to_draw(values)]
    assert len(kept) <= 1510
    assert np.nanmax(kept) == 9.0
    assert np.nanmin(kept) == -9.0
    assert np.isnan(kept).any()
    two_columns = np.stack([values, np.full_like(values, np.nan)], axis=1)
    strongest = find_strongest_per_bucket(two_columns, 480)
    assert strongest.shape == (480, 2)
    assert np.nanmax(strongest) == 9.0
    assert np.nanmin(strongest) == -9.0


def test_report_plotting_library_has_the_digest_of_its_note() -> None:
    digest = hashlib.sha256(LIBRARY.read_bytes()).hexdigest()
    note = (LIBRARY.parent / "README.md").read_text()
    assert f"`{LIBRARY.name}`" in note
    assert digest in note
    assert (LIBRARY.parent / "LICENSE-plotly.txt").is_file()


def test_report_yielding_obstacle_is_dashed_and_described(
    page: ReportReader, record: RunRecord
) -> None:
    peg = record.config.scene.pegs_along_route[0]
    yielding_peg = msgspec.structs.replace(
        peg, lean_rad=0.2, stiffness_n_per_m=800.0, mass_kg=2.0, base_friction=0.5
    )
    scene = msgspec.structs.replace(record.config.scene, pegs_along_route=[yielding_peg])
    with_yielding_peg = dataclasses.replace(
        record, config=msgspec.structs.replace(record.config, scene=scene)
    )
    html = render_report(with_yielding_peg, summarize_run(with_yielding_peg, "complete"))
    assert 'class="peg yields"' in html
    assert 'class="peg yields"' not in page.html
    description = (
        "leans by 0.2 rad, springs back with 800 N/m, slides from 9.81 N on, and is "
        "drawn where it stood at the start"
    )
    assert f"<title>peg_0_1, {description}</title>" in html
