"""The report of runs with missing parts, of runs that ended early or jammed, and of runs with hostile names."""

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.model.scenario import StartPlacement
from snakesim_hal.safety.authority import CommandAuthority
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, Fault, RobotDescription
from snakesim_operator.results.metrics.propulsion import find_propulsion_intervals
from snakesim_operator.results.report import render_report
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
    """The first two seconds of the run."""
    return cut_to_first_seconds(record, 2.0)


POSE_SIGNALS = ("position_w_m", "orientation_wxyz", "angle_rad")


def list_signals(record: RunRecord) -> dict[str, np.ndarray]:
    """Return the arrays of a record by name, each with a row for each tick."""
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


# --- runs with missing parts -----------------------------------------------------------------------------------


def test_report_without_recording_has_all_sections(short_record: RunRecord) -> None:
    page = render_and_check_report(replace_fields(short_record, control_states=[], worlds=[]))
    assert "recording holds no message of the controller" in page.text
    assert "No joint propelled" in page.text
    # The report draws top views, because the pose is known.
    assert len([title for title in page.titles if title.startswith("Top view")]) == 3


@pytest.mark.slow  # the other tests check the size limit, too
def test_report_of_long_run_stays_within_size_limit(record: RunRecord) -> None:
    """The run is repeated for ten minutes; `render_and_check_report` compares the size with its limit."""
    repetitions = 60
    signals = {
        name: np.concatenate([value] * repetitions) for name, value in list_signals(record).items()
    }
    signals["time_s"] = ARMED_S + np.arange(len(signals["time_s"])) / RATE_HZ

    def repeat_messages(messages: Sequence[Any]) -> list[Any]:
        """Return the messages of all repetitions, each with a later timestamp."""
        return [
            msgspec.structs.replace(
                message, timestamp_ns=message.timestamp_ns + round(repetition * DURATION_S * 1e9)
            )
            for repetition in range(repetitions)
            for message in messages
        ]

    long_record = replace_fields(
        record,
        control_states=repeat_messages(record.control_states),
        worlds=repeat_messages(record.worlds),
        **signals,
    )
    page = render_and_check_report(long_record)
    assert len(page.film["frames"]) <= 300
    assert "handed over 419 times among 7 joints" in page.text


def test_report_without_pose_has_all_sections(short_record: RunRecord) -> None:
    tick_count = len(short_record.time_s)
    without_pose = replace_fields(
        short_record,
        position_w_m=np.full((tick_count, 3), np.nan),
        orientation_wxyz=np.full((tick_count, 4), np.nan),
    )
    page = render_and_check_report(without_pose)
    assert "No playback: no valid pose was recorded." in page.text
    assert "pose sensor" not in page.text
    # The verdict does not blame a missing pose sensor, because the robot has one.
    assert "pose sensor" not in judge_run(without_pose).text
    assert not [title for title in page.titles if title.startswith("Top view")]
    # The distance follows from the path position that the controller reports.
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
    empty = {name: value[:0] for name, value in list_signals(short_record).items()}
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
    """The robot file lists a contact sensor, but the running robot has none."""
    sensors = [sensor for sensor in short_record.description.sensors if sensor.key != keys.CONTACTS]
    page = render_and_check_report(
        replace_fields(
            short_record,
            description=msgspec.structs.replace(short_record.description, sensors=sensors),
        )
    )
    assert "No contact forces: the robot has no contact sensor." in page.text


def test_report_of_controller_without_push_points_has_all_sections(short_record: RunRecord) -> None:
    without_pushing = {
        "push_points": [],
        "desired_force_n": [],
        "propulsion_joint": None,
        "propulsion_n": None,
    }
    control_states = [
        msgspec.structs.replace(state, controller="hold", **without_pushing)
        for state in short_record.control_states
    ]
    config = msgspec.structs.replace(short_record.config, controller="hold")
    page = render_and_check_report(
        replace_fields(short_record, control_states=control_states, config=config)
    )
    assert "controller hold published no desired forces" in page.text
    assert "controller hold named no propulsion joint" in page.text
    assert re.search("measured contacts?, in sum", page.text)


@pytest.mark.slow
def test_report_of_run_with_isolated_joint_names_it(record: RunRecord) -> None:
    joint_fault = Fault(
        tick=537,
        what="joint_frozen",
        cause="joint_3 repeats itself",
        joint="joint_3",
        scope="joint",
    )
    page = render_and_check_report(
        replace_fields(
            record,
            host=msgspec.structs.replace(record.host, faults=[joint_fault], isolated=["joint_3"]),
        )
    )
    assert "went on without joint_3, 2 commands refused" in page.text
    assert "Stopped by a fault" not in page.text
    robot_fault = Fault(
        tick=600, what="leak", cause="joint_4 reports water inside", joint="joint_4"
    )
    page = render_and_check_report(
        replace_fields(
            record, host=msgspec.structs.replace(record.host, faults=[joint_fault, robot_fault])
        ),
        robot_fault.cause,
    )
    assert "Stopped by a fault" in page.text
    assert "at joint_4: joint_4 reports water inside." in page.text


@pytest.mark.parametrize("joint", [None, "joint_3"])
def test_report_of_harmless_fault_states_that_run_continued(
    short_record: RunRecord, joint: str | None
) -> None:
    """The host logged the fault before the first arming; the run was complete."""
    authority = CommandAuthority(short_record.description)
    harmless_fault = Fault(
        tick=0,
        what="power_unknown",
        cause="supply and heat are unknown, and ignored",
        joint=joint,
    )
    authority.log_fault(harmless_fault)
    host = msgspec.structs.replace(short_record.host, faults=authority.faults, ended="complete")
    page = render_and_check_report(replace_fields(short_record, host=host))
    assert "Stopped by a fault" not in page.text
    assert "went on without" not in page.text
    assert "a fault (supply and heat are unknown, and ignored), 2 commands refused" in page.text
    ending = RunEnding()
    add_end_causes(ending, host, short_record.config)
    assert ending.reason is None, "otherwise `snakesim run` would end with exit code 1"


def test_report_of_run_ended_by_fault_explains_it(record: RunRecord) -> None:
    fault = Fault(tick=537, what="diverged", cause="joint_3 at 1e9 rad/s", joint="joint_3")
    page = render_and_check_report(
        replace_fields(record, host=msgspec.structs.replace(record.host, faults=[fault])),
        fault.cause,
    )
    assert "Stopped by a fault after 5.0 s at joint_3: joint_3 at 1e9 rad/s." in page.text
    assert "diverged" in page.text_parts
    shapes = [shape for chart in page.charts.values() for shape in chart["layout"]["shapes"]]
    assert [shape["line"].get("color") for shape in shapes].count("--bad") == 2 + 12 + 3


@pytest.mark.slow
def test_report_of_jammed_run_names_place_and_reason(record: RunRecord) -> None:
    page = render_and_check_report(stop_robot(record, 0.0, jammed=True, reason="jammed at peg_2"))
    assert (
        "Jammed: jammed at peg_2. Moved 0.00 m along the path in 10.0 s; no fault, 2 commands refused"
        in page.text
    )
    assert "jam" in page.charts["States and propulsion joint over time"]["data"][0]["y"]


@pytest.mark.slow
def test_report_of_run_jammed_later_names_time_and_reason(record: RunRecord) -> None:
    control_states = change_states_after(record, 6.09, jammed=True, reason="jammed: wedged")
    page = render_and_check_report(replace_fields(record, control_states=control_states))
    assert "Jammed at 6.3 s of 10.0 s: wedged. Moved 0.62 m along the path" in page.text


def change_states_after(record: RunRecord, time_s: float, **fields: Any) -> list[ControlState]:
    """Return the control states of a run, with these fields in all states after a time in the run."""
    start_ns = (float(record.time_s[0]) + time_s) * 1e9
    return [
        msgspec.structs.replace(state, **fields) if state.timestamp_ns > start_ns else state
        for state in record.control_states
    ]


def stop_robot(record: RunRecord, time_s: float, **fields: Any) -> RunRecord:
    """Return the run with a robot that does not move after a time in the run.

    Args:
        record: the run.
        time_s: when the robot stops, in s from the start of the run.
        fields: of the control states after this time.
    """
    row = record.find_nearest_row(float(record.time_s[0]) + time_s)
    signals = {name: getattr(record, name).copy() for name in POSE_SIGNALS}
    for values in signals.values():
        values[row:] = values[row]
    control_states = change_states_after(record, time_s, **fields)
    return replace_fields(record, control_states=control_states, **signals)


def judge_run(record: RunRecord) -> RunVerdict:
    """Return the verdict of the report on a run that was complete."""
    return make_verdict(record, summarize_run(record, "complete"))


def test_report_of_mostly_stationary_run_is_not_good(record: RunRecord) -> None:
    assert judge_run(record).rating == "good"
    lost = {"state": "NotLocomoting", "reason": LOST_CONTACTS_REASON}
    early_stop = judge_run(stop_robot(record, 4.0, **lost))
    assert early_stop.rating == "poor"
    assert early_stop.text.startswith(
        f"Stopped at 4.0 s of 10.0 s: {LOST_CONTACTS_REASON}. Moved 0."
    )
    late_stop = judge_run(stop_robot(record, 5.5, **lost))
    assert late_stop.rating == "good"
    assert f"Locomotion ended at 5.4 s of 10.0 s: {LOST_CONTACTS_REASON}" in late_stop.text


def test_report_of_jam_ignores_last_control_message(record: RunRecord) -> None:
    """A jammed controller retries, and reports for a short time in each attempt that it locomotes."""
    jammed = stop_robot(record, 6.0, state="NotLocomoting", reason="jammed: wedged", jammed=True)
    *earlier_states, last_state = jammed.control_states
    retry = msgspec.structs.replace(last_state, state="Locomoting", reason="pushing")
    verdict = judge_run(replace_fields(jammed, control_states=[*earlier_states, retry]))
    assert verdict.rating == "poor"
    assert verdict.text.startswith("Jammed at 6.0 s of 10.0 s: wedged. Moved")
    stationary = judge_run(stop_robot(record, 4.0, state="Locomoting", reason="pushing"))
    assert stationary.rating == "poor"
    assert stationary.text.startswith(
        "Stopped at 4.0 s of 10.0 s: standing still: less than 20 mm in 1 s. Moved 0."
    )
    assert "reported" not in stationary.text, (
        "`pushing` is what control measured, not a report of the controller"
    )


def test_report_of_rest_at_path_end_is_no_failure(record: RunRecord) -> None:
    resting = stop_robot(
        record, 4.0, state="Idle", reason="no motion intended: the path is finished"
    )
    verdict = judge_run(resting)
    assert verdict.rating == "good"
    assert "Locomotion ended at 4.0 s" in verdict.text


def test_report_motion_is_measured_despite_control_reports(record: RunRecord) -> None:
    """The reports of control change neither the state nor the fraction of time in motion."""
    original = summarize_run(record, "complete")
    assert original.locomoting_fraction == pytest.approx(0.63, abs=0.01)
    silent_after_4_s = [
        state for state in record.control_states if state.timestamp_ns < (ARMED_S + 4.0) * 1e9
    ]
    always_stationary = [
        msgspec.structs.replace(state, state="NotLocomoting", reason="lost")
        for state in record.control_states
    ]
    for control_states in (silent_after_4_s, [], always_stationary):
        changed = replace_fields(record, control_states=control_states)
        summary = summarize_run(changed, "complete")
        assert summary.locomoting_fraction == original.locomoting_fraction
        assert summary.last_state == "NotLocomoting"
    without_reports = summarize_run(replace_fields(record, control_states=[]), "complete")
    assert without_reports.last_reason == "standing still: less than 20 mm in 1 s"
    assert without_reports.reported_state is None


def test_report_of_stationary_run_contradicts_its_controller(record: RunRecord) -> None:
    stationary = stop_robot(record, 0.0, state="Locomoting", reason="moving")
    verdict = judge_run(stationary)
    assert "Did not locomote: standing still: less than 20 mm in 1 s." in verdict.text
    summary = summarize_run(stationary, "complete")
    assert summary.last_state == "NotLocomoting"
    assert summary.reported_state == "Locomoting"
    assert summary.locomoting_fraction == 0
    assert summary.stalled_s == pytest.approx(9.0, abs=0.2)


def test_report_of_moving_run_contradicts_its_controller(record: RunRecord) -> None:
    """The verdict follows from the measured motion, and mentions what control reported."""
    control_states = change_states_after(record, 2.2, state="NotLocomoting", reason="contacts lost")
    verdict = judge_run(replace_fields(record, control_states=control_states))
    assert verdict.rating == "good"
    assert verdict.text.startswith("Moved 0.62 m along the path in 10.0 s;")
    assert "Locomotion ended at 6.3 s of 10.0 s: contacts lost." in verdict.text
    reported = re.search(
        r'For (\d\.\d) s of its motion control reported "contacts lost"\.', verdict.text
    )
    assert reported is not None
    assert float(reported[1]) == pytest.approx(6.3 - 2.2, abs=0.15)


def test_report_of_run_moving_at_its_end_states_it(record: RunRecord) -> None:
    first_half = {name: value[:500] for name, value in list_signals(record).items()}
    control_states = [
        state for state in record.control_states if state.timestamp_ns < (ARMED_S + 5.0) * 1e9
    ]
    moving = replace_fields(record, **first_half, control_states=control_states)
    verdict = judge_run(moving)
    assert verdict.rating == "good"
    assert "along the path in 10.0 s, and was still moving at the end;" in verdict.text
    assert summarize_run(moving, "complete").locomoting_fraction == 1.0


def test_report_escapes_text_of_the_run(short_record: RunRecord) -> None:
    hostile_text = '<script>alert("x")</script>&'
    config = msgspec.structs.replace(short_record.config, title=hostile_text)
    control_states = [
        msgspec.structs.replace(state, reason=hostile_text, state="NotLocomoting")
        for state in short_record.control_states
    ]
    host = msgspec.structs.replace(
        short_record.host, faults=[Fault(tick=90, what=hostile_text, cause=hostile_text)]
    )
    changed = replace_fields(short_record, config=config, control_states=control_states, host=host)
    page = render_report(changed, summarize_run(changed, hostile_text))
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert") >= 5
    assert hostile_text in ReportReader(page).text


def test_report_escapes_names_and_direction_marks(short_record: RunRecord) -> None:
    hostile_name = "</title><script>alert(1)\u202e\x9b31m\x1b[31m\u2028"
    encoded = msgspec.json.encode(short_record.description).replace(
        b"joint_", msgspec.json.encode(hostile_name)[1:-1]
    )
    control_states = [
        msgspec.structs.replace(
            state, propulsion_joint=state.propulsion_joint.replace("joint_", hostile_name)
        )
        if state.propulsion_joint
        else state
        for state in short_record.control_states
    ]
    pegs = [
        msgspec.structs.replace(peg, name=f"{hostile_name}{i}")
        for i, peg in enumerate(short_record.config.scene.cylinder)
    ]
    scene = msgspec.structs.replace(short_record.config.scene, cylinder=pegs)
    config = msgspec.structs.replace(short_record.config, scene=scene)
    changed = replace_fields(
        short_record,
        description=msgspec.json.decode(encoded, type=RobotDescription),
        control_states=control_states,
        config=config,
    )
    page = render_report(changed, summarize_run(changed, "complete"))
    assert find_propulsion_intervals(changed)
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page
    assert not {"\u202e", "\x9b", "\x1b", "\u2028"} & set(page)
    assert "\\u202e\\u009b31m" in page


def test_report_map_of_upward_snake_is_rotated(short_record: RunRecord) -> None:
    tick_count = len(short_record.time_s)
    upward = replace_fields(
        short_record,
        position_w_m=short_record.position_w_m[:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0]),
        orientation_wxyz=np.tile(quaternion_from_yaw(math.pi / 2 + 0.4), (tick_count, 1)),
        worlds=[],
        control_states=[],
    )
    sizes = [
        [float(number) for number in value.split()][2:]
        for _, name, value in render_and_check_report(upward).attributes
        if name == "viewbox" and value and value.startswith("0 0 500 ")
    ]
    assert len(sizes) == 3
    assert all(height < width for width, height in sizes)
