"""The main job, with real processes: it runs, it moves, it repeats itself, and it can be told apart from not moving."""

import multiprocessing
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest

from snakesim_operator.results.record import REPORT
from tests.e2e.command import nothing_left, run_to_summary, snakesim

pytestmark = pytest.mark.e2e


def test_triplet_moves_forward_and_hands_over_backward(tmp_path: Path) -> None:
    ended, summary = run_to_summary(tmp_path / "run", "triplet", "--duration", "10", "--pace", "lockstep")
    assert ended.code == 0, ended.out + ended.err
    assert summary.path_distance_m is not None and summary.path_distance_m >= 0.5
    joints = [int(name.removeprefix("joint_")) for name in summary.propulsion_joints]
    assert len(joints) >= 4 and joints == sorted(joints, reverse=True)
    assert summary.ticks == 1000 and summary.rejected_commands == {} and summary.faults == []
    assert summary.answered_fraction == 1.0
    assert summary.backend == "sim" and summary.config["scene"]["name"] == "triplet"
    assert (tmp_path / "run" / REPORT).stat().st_size > 20_000
    assert str(tmp_path / "run" / REPORT) in ended.out
    nothing_left(tmp_path / "run")


@pytest.mark.parametrize(
    "arguments", [["--controller", "hold"], ["--set", "control.propulsion_n=2"]], ids=["hold", "below-drag"]
)
def test_control_experiments_stay_where_they_are(tmp_path: Path, arguments: list[str]) -> None:
    ended, summary = run_to_summary(tmp_path / "run", "triplet", "--duration", "10", *arguments)
    assert ended.code == 0, ended.out + ended.err
    assert summary.path_distance_m is not None and abs(summary.path_distance_m) < 0.02
    assert summary.net_displacement_m is not None and summary.net_displacement_m < 0.02


def _burn(stop: Event) -> None:
    while not stop.is_set():
        sum(range(1000))


def test_one_seed_one_digest_also_under_load(tmp_path: Path) -> None:
    digests: list[str] = []
    for number, loaded in enumerate((False, False, True)):
        context = multiprocessing.get_context("spawn")
        stop = context.Event()
        load = [context.Process(target=_burn, args=(stop,), daemon=True) for _ in range(2 if loaded else 0)]
        for process in load:
            process.start()
        try:
            ended, summary = run_to_summary(tmp_path / f"run{number}", "triplet", "--duration", "5", "--seed", "7")
        finally:
            stop.set()
            for process in load:
                process.join(10)
        assert ended.code == 0, ended.out + ended.err
        digests.append(summary.command_digest)
    assert len(set(digests)) == 1, digests


def test_another_seed_another_digest(tmp_path: Path) -> None:
    digests = {
        run_to_summary(tmp_path / f"run{seed}", "triplet", "--duration", "1", "--seed", str(seed))[1].command_digest
        for seed in (1, 2)
    }
    assert len(digests) == 2


def test_a_run_repeats_from_the_configuration_that_it_left(tmp_path: Path) -> None:
    _, first = run_to_summary(tmp_path / "first", "triplet", "--duration", "2", "--set", "scene.ground.friction=0.08")
    _, again = run_to_summary(tmp_path / "again", str(tmp_path / "first" / "config.json"))
    assert again.command_digest == first.command_digest
    assert again.config == first.config


@pytest.mark.parametrize("pace", ["realtime", "free"])
def test_other_paces_complete(tmp_path: Path, pace: str) -> None:
    # 50 Hz has the longest lease, 100 ms: a busy test machine may well forget a process for 50 ms.
    arguments = ["triplet", "--controller", "hold", "--duration", "2", "--pace", pace, "--set", "rate_hz=50"]
    ended, summary = run_to_summary(tmp_path / "run", *arguments)
    assert ended.code == 0, ended.out + ended.err
    assert summary.ticks == 100 and summary.pace == pace
    if pace == "realtime":
        assert summary.real_time_factor == pytest.approx(1.0, abs=0.05)
        assert summary.state_to_command_us["p50"] is not None


@pytest.mark.parametrize(
    "modules", [8, pytest.param(13, marks=pytest.mark.slow), pytest.param(30, marks=pytest.mark.slow)]
)
def test_any_number_of_modules_without_a_code_change(tmp_path: Path, modules: int) -> None:
    ended, summary = run_to_summary(
        tmp_path / "run", "peg_row", "--duration", "6", "--set", f"robot.chain.modules={modules}"
    )
    assert ended.code == 0, ended.out + ended.err
    assert summary.path_distance_m is not None and summary.path_distance_m > 0.4
    assert summary.propulsion_joints


def test_a_jam_is_reported_as_such(tmp_path: Path) -> None:
    ended, summary = run_to_summary(tmp_path / "run", "jam")
    assert ended.code == 0, ended.out + ended.err
    assert summary.jammed
    assert "jam" in ended.out.lower()


def test_another_robot_in_another_world(tmp_path: Path) -> None:
    ended, summary = run_to_summary(tmp_path / "run", "mamba_hills")
    assert ended.code == 0, ended.out + ended.err
    assert summary.robot == "mamba" and summary.path_distance_m is not None and summary.path_distance_m > 0.3


def test_run_from_a_file_of_ones_own_in_another_folder(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        'title = "mine"\nrobot = "planar13"\nscene = "./my_scene.toml"\ncontroller = "path_following"\n'
        "duration_s = 1\n[services.guidance]\n[services.navigation]\n[services.control]\n"
    )
    (tmp_path / "my_scene.toml").write_text(
        'name = "mine"\n[ground]\nfriction = 0.3\n[route]\nkind = "sine"\namplitude_m = 0.05\nwavelength_m = 0.8\n'
        "length_m = 4.0\n[[box]]\nposition_m = [0.5, 0.6]\nsize_m = [0.2, 0.1, 0.2]\n"
    )
    ended = snakesim("run", "./mine.toml", "--out", "out", cwd=tmp_path)
    assert ended.code == 0, ended.out + ended.err
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_host_that_is_held_up_costs_no_determinism(tmp_path: Path) -> None:
    """Control hears nothing for more than a second of wall-clock time; in lockstep no robot time passes meanwhile."""
    arguments = ["triplet", "--duration", "2", "--pace", "lockstep"]
    _, plain = run_to_summary(tmp_path / "plain", *arguments)
    ended, held_up = run_to_summary(tmp_path / "held-up", *arguments, "--fault", "freeze:host@1-2.4")
    assert ended.code == 0, ended.out + ended.err
    assert held_up.command_digest == plain.command_digest
