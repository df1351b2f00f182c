"""Whether a body moved: the measurement, and its agreement in summary, terminal and verdict."""

import re

import msgspec
import numpy as np
import pytest

from snakesim_operator.results.metrics.motion import find_stops
from snakesim_operator.results.report.verdict import make_verdict
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.conclusion import print_summary
from snakesim_testing.operator.triplet_report import DURATION_S, replace_fields


def set_motion_along_x(record: RunRecord, x_m: np.ndarray) -> RunRecord:
    """Return the run of the same body that moves along x like this, and does not bend."""
    position = np.repeat(record.position_w_m[:1], len(x_m), axis=0)
    position[:, 0] += x_m
    constant = {
        name: np.repeat(getattr(record, name)[:1], len(x_m), axis=0)
        for name in ("orientation_wxyz", "angle_rad")
    }
    return replace_fields(record, position_w_m=position, **constant)


def test_motion_stop_between_and_rest_at_end_are_located(record: RunRecord) -> None:
    time_s = record.time_s - record.time_s[0]
    x_m = 0.1 * np.interp(time_s, [0, 2, 4.5, 7, 10], [0, 2, 2, 4.5, 4.5])
    motion = find_stops(set_motion_along_x(record, x_m))
    assert motion is not None
    spans = [(span.start_s, span.end_s) for span in motion.stops]
    assert np.array(spans) == pytest.approx(np.array([[2.0, 4.5], [7.0, DURATION_S]]), abs=0.15)
    assert motion.moving_fraction == pytest.approx(4.5 / DURATION_S, abs=0.03)
    assert motion.final_stop == motion.stops[-1]
    assert [span.label for span in motion.all_intervals] == ["moving", "standing still"] * 2


@pytest.mark.parametrize(("amplitude_m", "moves"), [(0.004, False), (0.06, True)])
def test_motion_back_and_forth_of_few_millimeters_is_none(
    record: RunRecord, amplitude_m: float, moves: bool
) -> None:
    time_s = record.time_s - record.time_s[0]
    x_m = amplitude_m * np.sin(2 * np.pi * time_s / 1.6)
    motion = find_stops(set_motion_along_x(record, x_m))
    assert motion is not None
    assert motion.moving_fraction == (1.0 if moves else 0.0)


def test_motion_without_pose_is_unknown(record: RunRecord) -> None:
    without_pose = replace_fields(record, position_w_m=record.position_w_m * np.nan, worlds=[])
    assert find_stops(without_pose) is None
    summary = summarize_run(without_pose, "complete")
    assert summary.locomoting_fraction is None
    assert summary.last_state is None
    assert summary.last_reason is None
    assert summary.reported_state == "NotLocomoting"


def test_motion_uses_measured_pose_but_not_dead_reckoning(record: RunRecord) -> None:
    """The black box contains no pose here, but the world model of guidance does."""
    without_pose = replace_fields(record, position_w_m=record.position_w_m * np.nan)
    for source, fraction in (("sensor", pytest.approx(0.63, abs=0.03)), ("dead_reckoning", None)):
        worlds = [msgspec.structs.replace(world, pose_from=source) for world in record.worlds]
        with_world = replace_fields(without_pose, worlds=worlds)
        summary = summarize_run(with_world, "complete")
        assert summary.locomoting_fraction == fraction
        verdict = make_verdict(with_world, summary)
        assert verdict.text.startswith("Ran for 10.0 s; the distance is unknown;")


def test_hand_over_count_is_equal_in_summary_terminal_and_verdict(
    record: RunRecord, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [joint.name for joint in record.description.joints]
    control_states = [
        msgspec.structs.replace(state, propulsion_joint=names[i // 5 % 3])
        for i, state in enumerate(record.control_states)
    ]
    many_hand_overs = replace_fields(record, control_states=control_states)
    summary = summarize_run(many_hand_overs, "complete")
    print_summary(summary)
    printed = re.search(r"\((\d+) hand-overs in all\)", capsys.readouterr().out)
    verdict = make_verdict(many_hand_overs, summary)
    in_verdict = re.search(r"handed over (\d+) times among 3 joints", verdict.text)
    assert printed is not None
    assert in_verdict is not None
    hand_over_count = len(summary.propulsion_joints or []) - 1
    assert hand_over_count > 30
    assert summary.hand_overs == hand_over_count
    assert int(printed[1]) == hand_over_count
    assert int(in_verdict[1]) == hand_over_count


def test_terminal_summary_shows_displacement_energy_and_control_report(
    record: RunRecord, capsys: pytest.CaptureFixture[str]
) -> None:
    control_states = [
        msgspec.structs.replace(state, state="Locomoting", reason="pushing")
        for state in record.control_states
    ]
    summary = summarize_run(replace_fields(record, control_states=control_states), "complete")
    sideways = msgspec.structs.replace(
        summary, energy_j_per_m=None, displacement_energy_j_per_m=50.4
    )
    print_summary(sideways)
    printed = capsys.readouterr().out
    assert (
        "last state            NotLocomoting: standing still: less than 20 mm in 1 s\n" in printed
    )
    assert "control reported      Locomoting: pushing\n" in printed
    assert (
        "energy per meter      50.4 J/m along its displacement, too little advance along the first heading"
        in printed
    )
    print_summary(summarize_run(record, "complete"))
    assert "control reported" not in capsys.readouterr().out
