"""Complete runs report whether the snake moved, where its pose comes from, and what is unknown."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.report.playback import make_playback
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import UNRECORDED
from snakesim_operator.run.in_process import simulate
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim


@pytest.mark.slow
def test_run_with_hold_controller_does_not_move(tmp_path: Path) -> None:
    result, summary = run_to_summary(
        tmp_path / "run", "triplet", "--duration", "10", "--controller", "hold"
    )
    assert result.code == 0, result.out + result.err
    assert summary.path_distance_m is not None
    assert abs(summary.path_distance_m) < 0.02
    assert summary.net_displacement_m is not None
    assert summary.net_displacement_m < 0.02


@pytest.mark.slow
def test_run_from_stored_configuration_repeats_the_run(tmp_path: Path) -> None:
    _, original = run_to_summary(
        tmp_path / "first", "triplet", "--duration", "2", "--set", "scene.ground.friction=0.08"
    )
    _, repeated = run_to_summary(tmp_path / "again", str(tmp_path / "first" / "config.json"))
    assert repeated.command_digest == original.command_digest
    assert repeated.config == original.config


@pytest.mark.heavy
def test_run_that_jams_reports_it_at_the_end(tmp_path: Path) -> None:
    result, summary = run_to_summary(tmp_path / "run", "jam", "--duration", "4")
    assert result.code == 0, result.out + result.err
    assert summary.jammed
    assert "JAMMED" in result.out


def test_run_from_user_files_in_another_folder_completes(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        'title = "mine"\nrobot = "planar13"\nscene = "./my_scene.toml"\ncontroller = "path_following"\n'
        "duration_s = 1\n[services.guidance]\n[services.navigation]\n[services.control]\n"
    )
    (tmp_path / "my_scene.toml").write_text(
        'name = "mine"\n[ground]\nfriction = 0.3\n[route]\nkind = "sine"\namplitude_m = 0.05\nwavelength_m = 0.8\n'
        "length_m = 4.0\n[[box]]\nposition_m = [0.5, 0.6]\nsize_m = [0.2, 0.1, 0.2]\n"
    )
    result = snakesim("run", "./mine.toml", "--in-process", "--out", "out", cwd=tmp_path)
    assert result.code == 0, result.out + result.err
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.heavy
def test_run_without_recording_reports_unknown_instead_of_none(tmp_path: Path) -> None:
    short_run = ["triplet", "--in-process", "--duration", "1"]
    recorded = snakesim("run", *short_run, "--out", "recorded", cwd=tmp_path)
    unrecorded = snakesim("run", *short_run, "--no-record", "--out", "unrecorded", cwd=tmp_path)
    assert recorded.code == 0, recorded.out + recorded.err
    assert unrecorded.code == 0, unrecorded.out + unrecorded.err
    printed_values = {
        line.split("  ")[1]: line.split("  ")[-1].strip()
        for line in unrecorded.out.splitlines()
        if line[:2] == "  "
    }
    assert printed_values["propulsion joints"] == "unknown"
    # The black box measures the state, without a recording.
    assert printed_values["locomoting"] == "100 % of the time"
    assert printed_values["last state"] == "Locomoting: moving"
    assert printed_values["not known"] == UNRECORDED
    compared = snakesim("study", "compare", "recorded", "unrecorded", cwd=tmp_path)
    assert "propulsion joints" in compared.out
    assert "nothing that control reported in B was recorded" in compared.out
    assert "with none" not in compared.out
    assert UNRECORDED in compared.out + compared.err


def test_run_without_pose_sensor_uses_joints_or_dead_reckoning(
    tmp_path: Path,
) -> None:
    no_pose = ["triplet", "--in-process", "--duration", "1", "--unset", "robot.sensors.pose"]
    result, summary = run_to_summary(tmp_path / "held", *no_pose, "--controller", "hold")
    assert result.code == 0, result.err
    assert summary.pose_from is None

    result, summary = run_to_summary(tmp_path / "pushed", *no_pose)
    assert result.code == 0, result.err
    assert summary.pose_from == "dead_reckoning"
    assert summary.contacts_from == "sensor"
    assert summary.path_distance_m is None
    assert (summary.dead_reckoned_distance_m or 0.0) > 0.03

    # The section is called `contacts`.
    misspelled = snakesim(
        "run", *no_pose, "--unset", "robot.sensors.contact", "--out", "wrong", cwd=tmp_path
    )
    assert misspelled.code == 2
    assert "contact" in misspelled.err
    assert not (tmp_path / "wrong").exists()


@pytest.mark.slow
def test_run_at_its_goal_stops_the_snake_despite_contacts(tmp_path: Path) -> None:
    near = ["--set", "mission.goal.distance_m=0.4", "--duration", "6"]
    result, _ = run_to_summary(tmp_path / "run", "surveyed_clutter", *near)
    assert result.code == 0
    assert "reached after" in result.out
    record = RunRecord.load(tmp_path / "run")
    reached_s = next(
        state.timestamp_ns * 1e-9
        for state in record.control_states
        if "the goal is reached" in state.reason
    )
    assert 1.0 < reached_s < 4.0
    positions_after_w_m = record.position_w_m[record.time_s > reached_s + 0.5, :2]
    assert np.ptp(positions_after_w_m, axis=0).max() < 0.005
    assert np.abs(record.torque_nm[-1]).max() < 0.5


@pytest.mark.slow
def test_report_shows_perceived_map_and_paths_beside_truth(tmp_path: Path) -> None:
    config = load_scenario("clutter", [parse_set_option("duration_s=1")]).config
    playback = make_playback(simulate(config, tmp_path / "run").record)
    assert playback is not None
    maps = playback.data["maps"]
    paths = playback.data["paths"]
    assert maps
    assert paths
    last_frame = playback.data["frames"][-1]
    last_map = maps[last_frame[6]]
    last_path = paths[last_frame[7]]
    assert len(last_map) >= 6
    assert len(last_path) >= 20  # the path through the launch row, and the path ahead
    assert "as guidance perceived it" in (tmp_path / "run" / "report.html").read_text()
