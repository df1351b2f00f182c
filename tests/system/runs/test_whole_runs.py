"""Whole runs: a snake that moves can be told apart from one that does not, whatever its size, world and files."""

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
def test_the_control_experiment_stays_where_it_is(tmp_path: Path) -> None:
    ended, summary = run_to_summary(
        tmp_path / "run", "triplet", "--duration", "10", "--controller", "hold"
    )
    assert ended.code == 0, ended.out + ended.err
    assert summary.path_distance_m is not None
    assert abs(summary.path_distance_m) < 0.02
    assert summary.net_displacement_m is not None
    assert summary.net_displacement_m < 0.02


@pytest.mark.slow
def test_a_run_repeats_from_the_configuration_that_it_left(tmp_path: Path) -> None:
    _, first = run_to_summary(
        tmp_path / "first", "triplet", "--duration", "2", "--set", "scene.ground.friction=0.08"
    )
    _, again = run_to_summary(tmp_path / "again", str(tmp_path / "first" / "config.json"))
    assert again.command_digest == first.command_digest
    assert again.config == first.config


def test_a_jam_is_told_at_the_end(tmp_path: Path) -> None:
    ended, summary = run_to_summary(tmp_path / "run", "jam", "--duration", "4")
    assert ended.code == 0 and summary.jammed and "JAMMED" in ended.out, ended.out + ended.err


def test_run_from_a_file_of_ones_own_in_another_folder(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        'title = "mine"\nrobot = "planar13"\nscene = "./my_scene.toml"\ncontroller = "path_following"\n'
        "duration_s = 1\n[services.guidance]\n[services.navigation]\n[services.control]\n"
    )
    (tmp_path / "my_scene.toml").write_text(
        'name = "mine"\n[ground]\nfriction = 0.3\n[route]\nkind = "sine"\namplitude_m = 0.05\nwavelength_m = 0.8\n'
        "length_m = 4.0\n[[box]]\nposition_m = [0.5, 0.6]\nsize_m = [0.2, 0.1, 0.2]\n"
    )
    ended = snakesim("run", "./mine.toml", "--in-process", "--out", "out", cwd=tmp_path)
    assert ended.code == 0, ended.out + ended.err
    assert (tmp_path / "out" / "report.html").is_file()


def test_what_was_not_recorded_is_unknown_and_not_none(tmp_path: Path) -> None:
    short = ["triplet", "--in-process", "--duration", "1"]
    told = snakesim("run", *short, "--out", "told", cwd=tmp_path)
    untold = snakesim("run", *short, "--no-record", "--out", "untold", cwd=tmp_path)
    assert told.code == untold.code == 0, untold.out + untold.err
    said = {
        line.split("  ")[1]: line.split("  ")[-1].strip()
        for line in untold.out.splitlines()
        if line[:2] == "  "
    }
    assert said["propulsion joints"] == "unknown"
    assert (said["locomoting"], said["last state"]) == (
        "100 % of the time",
        "Locomoting: moving",
    ), "they are measured"
    assert said["not known"] == UNRECORDED
    compared = snakesim("study", "compare", "told", "untold", cwd=tmp_path)
    assert "propulsion joints" in compared.out
    assert "nothing that control reported in B was recorded" in compared.out
    assert "with none" not in compared.out
    assert UNRECORDED in compared.out + compared.err


def test_run_without_pose_sensor_uses_joints_or_dead_reckoning(
    tmp_path: Path,
) -> None:
    short = ["triplet", "--in-process", "--duration", "1", "--unset", "robot.sensors.pose"]
    ended, summary = run_to_summary(tmp_path / "held", *short, "--controller", "hold")
    assert ended.code == 0 and summary.pose_from is None, ended.err
    ended, summary = run_to_summary(tmp_path / "pushed", *short)
    assert (
        ended.code == 0
        and summary.pose_from == "dead_reckoning"
        and summary.contacts_from == "sensor"
    ), ended.err
    assert summary.path_distance_m is None
    assert (summary.dead_reckoned_distance_m or 0.0) > 0.03
    wrong = snakesim(
        "run", *short, "--unset", "robot.sensors.contact", "--out", "wrong", cwd=tmp_path
    )
    assert wrong.code == 2
    assert "contact" in wrong.err
    assert not (tmp_path / "wrong").exists()


@pytest.mark.slow
def test_at_its_goal_the_snake_stands_still_whatever_it_touches(tmp_path: Path) -> None:
    near = ["--set", "mission.goal.distance_m=0.4", "--duration", "6"]
    ended, _ = run_to_summary(tmp_path / "run", "surveyed_clutter", *near)
    assert ended.code == 0
    assert "reached after" in ended.out
    record = RunRecord.load(tmp_path / "run")
    reached_s = next(
        state.timestamp_ns * 1e-9
        for state in record.control_states
        if "the goal is reached" in state.reason
    )
    assert 1.0 < reached_s < 4.0
    after = record.position_w_m[record.time_s > reached_s + 0.5, :2]
    assert np.ptp(after, axis=0).max() < 0.005
    assert np.abs(record.torque_nm[-1]).max() < 0.5


@pytest.mark.slow
def test_report_shows_perceived_map_and_paths_beside_truth(tmp_path: Path) -> None:
    film = make_playback(
        simulate(
            load_scenario("clutter", [parse_set_option("duration_s=1")]).config, tmp_path / "run"
        ).record
    )
    assert film is not None
    assert film.data["maps"]
    assert film.data["paths"]
    maps, paths, last = film.data["maps"], film.data["paths"], film.data["frames"][-1]
    assert len(maps[last[6]]) >= 6
    assert len(paths[last[7]]) >= 20  # the launch row, and what lies ahead
    assert "as guidance perceived it" in (tmp_path / "run" / "report.html").read_text()
