"""The report of runs that lack something, ended early, jammed, or hold names from outside."""

import dataclasses
import math
import re
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.model.scenario import StartPlacement
from snakesim_hal.safety.authority import CommandAuthority
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, RobotDescription
from snakesim_operator.results.metrics.propulsion import find_propulsion_intervals
from snakesim_operator.results.report import render_report as report_page
from snakesim_operator.results.report.verdict import RunVerdict, make_verdict
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.conclusion import add_end_causes
from snakesim_operator.run.ending import RunEnding
from snakesim_testing.operator.triplet_report import (
    ARMED_S,
    DURATION_S,
    LOST_CONTACTS_REASON,
    RATE_HZ,
    ReportReader,
    cut_to_first_seconds,
    render_and_check_report,
    replace_fields,
)


@pytest.fixture(scope="module")
def short_record(record: RunRecord) -> RunRecord:
    return cut_to_first_seconds(record, 2.0)


MOVING = ("position_w_m", "orientation_wxyz", "angle_rad")


# --- runs with something missing -------------------------------------------------------------------------------


def test_report_without_recording_has_all_sections(short_record: RunRecord) -> None:
    page = render_and_check_report(replace_fields(short_record, control_states=[], worlds=[]))
    assert "recording holds no message of the controller" in page.text
    assert "No joint propelled" in page.text
    # The pose is known.
    assert len([title for title in page.titles if title.startswith("Top view")]) == 3


@pytest.mark.slow  # the limit of its size holds above, too
def test_report_of_a_long_run_is_not_larger(record: RunRecord) -> None:
    """Ten runs a minute, for ten minutes."""
    times = 60
    reported = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    long = {
        name: np.concatenate([one] * times)
        for name, one in reported.items()
        if isinstance(one, np.ndarray)
    }
    long["time_s"] = ARMED_S + np.arange(len(long["time_s"])) / RATE_HZ
    later = [
        [
            msgspec.structs.replace(
                one, timestamp_ns=one.timestamp_ns + round(k * DURATION_S * 1e9)
            )
            for k in range(times)
            for one in reported
        ]
        for reported in (record.control_states, record.worlds)
    ]
    # Holds the size against the limit.
    page = render_and_check_report(
        replace_fields(record, control_states=later[0], worlds=later[1], **long)
    )
    assert len(page.film["frames"]) <= 300
    assert "handed over 419 times among 7 joints" in page.text


def test_report_without_pose_has_all_sections(short_record: RunRecord) -> None:
    count = len(short_record.time_s)
    blind = replace_fields(
        short_record,
        position_w_m=np.full((count, 3), np.nan),
        orientation_wxyz=np.full((count, 4), np.nan),
    )
    page = render_and_check_report(blind)
    assert "No playback: no valid pose was recorded." in page.text
    assert "pose sensor" not in page.text
    # The robot has one.
    assert "pose sensor" not in make_verdict(blind, summarize_run(blind, "complete")).text
    assert not [title for title in page.titles if title.startswith("Top view")]
    # Distance from the controller's own place on the path.
    assert "as the controller knew it" in page.text


def test_report_without_route_has_all_sections(short_record: RunRecord) -> None:
    scene = msgspec.structs.replace(short_record.config.scene, route=None, pegs_along_route=[])
    start = StartPlacement(on_route=False, position_m=(-5.0, 0.0))
    page = render_and_check_report(
        replace_fields(
            short_record,
            config=msgspec.structs.replace(short_record.config, scene=scene, start=start),
        )
    )
    assert "distance of the tail end" in page.text
    assert "net displacement" in page.text


def test_report_without_ticks_names_the_end(short_record: RunRecord) -> None:
    fields = [field.name for field in dataclasses.fields(short_record)]
    empty = {
        name: getattr(short_record, name)[:0]
        for name in fields
        if isinstance(getattr(short_record, name), np.ndarray)
    }
    host = msgspec.structs.replace(short_record.host, ticks=0, armed_ticks=0, answered_ticks=0)
    page = render_and_check_report(
        replace_fields(short_record, control_states=[], worlds=[], host=host, **empty),
        "the host never became ready",
    )
    assert (
        "Nothing was recorded: the robot was never armed (the host never became ready)."
        in page.text
    )


def test_report_without_contact_sensor_has_all_sections(short_record: RunRecord) -> None:
    """Whatever the robot file lists: its drives have none."""
    sensors = [sensor for sensor in short_record.description.sensors if sensor.key != keys.CONTACTS]
    page = render_and_check_report(
        replace_fields(
            short_record,
            description=msgspec.structs.replace(short_record.description, sensors=sensors),
        )
    )
    assert "No contact forces: the robot has no contact sensor." in page.text


def test_report_of_controller_without_push_points_has_all_sections(short_record: RunRecord) -> None:
    nothing = {
        "push_points": [],
        "desired_force_n": [],
        "propulsion_joint": None,
        "propulsion_n": None,
    }
    plain = [
        msgspec.structs.replace(state, controller="hold", **nothing)
        for state in short_record.control_states
    ]
    config_ = msgspec.structs.replace(short_record.config, controller="hold")
    page = render_and_check_report(
        replace_fields(short_record, control_states=plain, config=config_)
    )
    assert "controller hold published no desired forces" in page.text
    assert "controller hold named no propulsion joint" in page.text
    assert re.search("measured contacts?, in sum", page.text)


@pytest.mark.slow
def test_report_of_run_with_isolated_joint_names_it(record: RunRecord) -> None:
    lost = Fault(
        tick=537,
        what="joint_frozen",
        cause="joint_3 repeats itself",
        joint="joint_3",
        scope="joint",
    )
    page = render_and_check_report(
        replace_fields(
            record, host=msgspec.structs.replace(record.host, faults=[lost], isolated=["joint_3"])
        )
    )
    assert "went on without joint_3, 2 commands refused" in page.text
    assert "Stopped by a fault" not in page.text
    stop = Fault(tick=600, what="leak", cause="joint_4 reports water inside", joint="joint_4")
    page = render_and_check_report(
        replace_fields(record, host=msgspec.structs.replace(record.host, faults=[lost, stop])),
        stop.cause,
    )
    assert "Stopped by a fault" in page.text
    assert "at joint_4: joint_4 reports water inside." in page.text


@pytest.mark.parametrize("joint", [None, "joint_3"])
def test_report_of_harmless_fault_says_run_continued(
    short_record: RunRecord, joint: str | None
) -> None:
    """The host noted it before the first arming; the run was complete."""
    noting = CommandAuthority(short_record.description)
    noting.log_fault(
        Fault(
            tick=0,
            what="power_unknown",
            cause="supply and heat are unknown, and ignored",
            joint=joint,
        )
    )
    host = msgspec.structs.replace(short_record.host, faults=noting.faults, ended="complete")
    page = render_and_check_report(replace_fields(short_record, host=host))
    assert "Stopped by a fault" not in page.text
    assert "went on without" not in page.text
    assert "a fault (supply and heat are unknown, and ignored), 2 commands refused" in page.text
    ending = RunEnding()
    add_end_causes(ending, host, short_record.config)
    assert ending.reason is None, "or `snakesim run` ends with exit code 1"


def test_report_of_run_ended_by_fault_explains_it(record: RunRecord) -> None:
    fault = Fault(tick=537, what="diverged", cause="joint_3 at 1e9 rad/s", joint="joint_3")
    page = render_and_check_report(
        replace_fields(record, host=msgspec.structs.replace(record.host, faults=[fault])),
        fault.cause,
    )
    assert "Stopped by a fault after 5.0 s at joint_3: joint_3 at 1e9 rad/s." in page.text
    assert "diverged" in page.text_parts
    marks = [shape for chart in page.charts.values() for shape in chart["layout"]["shapes"]]
    assert [mark["line"].get("color") for mark in marks].count("--bad") == 2 + 12 + 3


@pytest.mark.slow
def test_report_of_jammed_run_says_so(record: RunRecord) -> None:
    page = render_and_check_report(stopped_at(record, 0.0, jammed=True, reason="jammed at peg_2"))
    assert (
        "Jammed: jammed at peg_2. Moved 0.00 m along the path in 10.0 s; no fault, 2 commands refused"
        in page.text
    )
    assert "jam" in page.charts["States and propulsion joint over time"]["data"][0]["y"]


@pytest.mark.slow
def test_report_of_run_jammed_later_says_jammed(record: RunRecord) -> None:
    stuck = [
        msgspec.structs.replace(state, jammed=True, reason="jammed: wedged")
        if state.timestamp_ns > (ARMED_S + 6.09) * 1e9
        else state
        for state in record.control_states
    ]
    page = render_and_check_report(replace_fields(record, control_states=stuck))
    assert "Jammed at 6.3 s of 10.0 s: wedged. Moved 0.62 m along the path" in page.text


def stopped_at(record: RunRecord, at_s: float, **state: Any) -> RunRecord:
    """The same run, in which nothing moves any more from a time on, and control reports this."""
    row = record.find_nearest_row(float(record.time_s[0]) + at_s)
    held = {name: getattr(record, name).copy() for name in MOVING}
    for column in held.values():
        column[row:] = column[row]
    since_ns = (float(record.time_s[0]) + at_s) * 1e9
    control = [
        msgspec.structs.replace(one, **state) if one.timestamp_ns > since_ns else one
        for one in record.control_states
    ]
    return replace_fields(record, control_states=control, **held)


def judged(record: RunRecord) -> RunVerdict:
    return make_verdict(record, summarize_run(record, "complete"))


def test_report_of_mostly_standing_run_is_not_good(record: RunRecord) -> None:
    assert judged(record).rating == "good"
    lost = judged(stopped_at(record, 4.0, state="NotLocomoting", reason=LOST_CONTACTS_REASON))
    assert lost.rating == "poor"
    assert lost.text.startswith(f"Stopped at 4.0 s of 10.0 s: {LOST_CONTACTS_REASON}. Moved 0.")
    late = judged(stopped_at(record, 5.5, state="NotLocomoting", reason=LOST_CONTACTS_REASON))
    assert late.rating == "good"
    assert f"Locomotion ended at 5.4 s of 10.0 s: {LOST_CONTACTS_REASON}" in late.text


def test_report_of_jam_ignores_last_control_message(record: RunRecord) -> None:
    """A controller that tries again and again, and each time says for a moment that it moves."""
    stuck = stopped_at(record, 6.0, state="NotLocomoting", reason="jammed: wedged", jammed=True)
    trying = [
        *stuck.control_states[:-1],
        msgspec.structs.replace(stuck.control_states[-1], state="Locomoting", reason="pushing"),
    ]
    found = judged(replace_fields(stuck, control_states=trying))
    assert found.rating == "poor"
    assert found.text.startswith("Jammed at 6.0 s of 10.0 s: wedged. Moved")
    claims = judged(stopped_at(record, 4.0, state="Locomoting", reason="pushing"))
    assert claims.rating == "poor"
    assert claims.text.startswith(
        "Stopped at 4.0 s of 10.0 s: standing still: less than 20 mm in 1 s. Moved 0."
    )
    assert "reported" not in claims.text, (
        "`pushing` is what control measured, not a report of the controller"
    )


def test_report_of_rest_at_path_end_is_no_failure(record: RunRecord) -> None:
    rests = judged(
        stopped_at(record, 4.0, state="Idle", reason="no motion intended: the path is finished")
    )
    assert rests.rating == "good"
    assert "Locomotion ended at 4.0 s" in rests.text


def test_report_motion_is_measured_despite_control_reports(record: RunRecord) -> None:
    """State and share of time are the same for a controller that reports nothing, falls silent, or claims to stand."""
    whole = summarize_run(record, "complete")
    assert whole.locomoting_fraction == pytest.approx(0.63, abs=0.01)
    silent = [
        state for state in record.control_states if state.timestamp_ns < (ARMED_S + 4.0) * 1e9
    ]
    claims = [
        msgspec.structs.replace(one, state="NotLocomoting", reason="lost")
        for one in record.control_states
    ]
    for control in (silent, [], claims):
        reported = summarize_run(replace_fields(record, control_states=control), "complete")
        assert reported.locomoting_fraction == whole.locomoting_fraction
        assert reported.last_state == "NotLocomoting"
    moving = summarize_run(replace_fields(record, control_states=[]), "complete")
    assert moving.last_reason == "standing still: less than 20 mm in 1 s"
    assert moving.reported_state is None


def test_report_of_standing_run_contradicts_its_controller(record: RunRecord) -> None:
    stands = stopped_at(record, 0.0, state="Locomoting", reason="moving")
    found = judged(stands)
    assert "Did not locomote: standing still: less than 20 mm in 1 s." in found.text
    reported = summarize_run(stands, "complete")
    assert reported.last_state == "NotLocomoting"
    assert reported.reported_state == "Locomoting"
    assert reported.locomoting_fraction == 0
    assert reported.stalled_s == pytest.approx(9.0, abs=0.2)


def test_report_of_moving_run_contradicts_its_controller(record: RunRecord) -> None:
    """The verdict is that of the motion; what control reported is beside it, as a report."""
    since_ns = (ARMED_S + 2.2) * 1e9
    lost = [
        msgspec.structs.replace(one, state="NotLocomoting", reason="contacts lost")
        if one.timestamp_ns > since_ns
        else one
        for one in record.control_states
    ]
    found = judged(replace_fields(record, control_states=lost))
    assert found.rating == "good"
    assert found.text.startswith("Moved 0.62 m along the path in 10.0 s;")
    assert "Locomotion ended at 6.3 s of 10.0 s: contacts lost." in found.text
    said = re.search(r'For (\d\.\d) s of its motion control reported "contacts lost"\.', found.text)
    assert said is not None
    assert float(said[1]) == pytest.approx(6.3 - 2.2, abs=0.15)


def test_report_of_run_moving_to_its_end_says_so(record: RunRecord) -> None:
    rows = slice(0, 500)
    fields = [field.name for field in dataclasses.fields(record)]
    short = {
        name: getattr(record, name)[rows]
        for name in fields
        if isinstance(getattr(record, name), np.ndarray)
    }
    cut = replace_fields(
        record,
        **short,
        control_states=[
            one for one in record.control_states if one.timestamp_ns < (ARMED_S + 5.0) * 1e9
        ],
    )
    found = judged(cut)
    assert found.rating == "good"
    assert "along the path in 10.0 s, and was still moving at the end;" in found.text
    assert summarize_run(cut, "complete").locomoting_fraction == 1.0


def test_report_escapes_text_of_the_run(short_record: RunRecord) -> None:
    nasty = '<script>alert("x")</script>&'
    config_ = msgspec.structs.replace(short_record.config, title=nasty)
    reported = [
        msgspec.structs.replace(state, reason=nasty, state="NotLocomoting")
        for state in short_record.control_states
    ]
    host = msgspec.structs.replace(
        short_record.host, faults=[Fault(tick=90, what=nasty, cause=nasty)]
    )
    hurt = replace_fields(short_record, config=config_, control_states=reported, host=host)
    page = report_page(hurt, summarize_run(hurt, nasty))
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert") >= 5
    assert nasty in ReportReader(page).text


def test_report_escapes_names_and_direction_marks(short_record: RunRecord) -> None:
    nasty = "</title><script>alert(1)\u202e\x9b31m\x1b[31m\u2028"
    encoded = msgspec.json.encode(short_record.description).replace(
        b"joint_", msgspec.json.encode(nasty)[1:-1]
    )
    reported = [
        msgspec.structs.replace(one, propulsion_joint=one.propulsion_joint.replace("joint_", nasty))
        if one.propulsion_joint
        else one
        for one in short_record.control_states
    ]
    pegs_ = [
        msgspec.structs.replace(peg, name=f"{nasty}{i}")
        for i, peg in enumerate(short_record.config.scene.cylinder)
    ]
    scene = msgspec.structs.replace(short_record.config.scene, cylinder=pegs_)
    config_ = msgspec.structs.replace(short_record.config, scene=scene)
    hurt = replace_fields(
        short_record,
        description=msgspec.json.decode(encoded, type=RobotDescription),
        control_states=reported,
        config=config_,
    )
    page = report_page(hurt, summarize_run(hurt, "complete"))
    assert find_propulsion_intervals(hurt)
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page
    assert not {"\u202e", "\x9b", "\x1b", "\u2028"} & set(page)
    assert "\\u202e\\u009b31m" in page


def test_report_map_of_upward_snake_is_rotated(short_record: RunRecord) -> None:
    count = len(short_record.time_s)
    up = replace_fields(
        short_record,
        position_w_m=short_record.position_w_m[:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0]),
        orientation_wxyz=np.tile(quaternion_from_yaw(math.pi / 2 + 0.4), (count, 1)),
        worlds=[],
        control_states=[],
    )
    sizes = [
        [float(n) for n in value.split()][2:]
        for _, name, value in render_and_check_report(up).attributes
        if name == "viewbox" and value and value.startswith("0 0 500 ")
    ]
    assert len(sizes) == 3
    assert all(height < width for width, height in sizes)
