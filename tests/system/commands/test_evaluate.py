"""Evaluations in real worker processes: the same table on every repetition and computer, also after kills."""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from snakesim_hal.network.free_ports import find_free_port
from snakesim_hal.run_log.host_record import HOST_RECORD
from snakesim_operator.results.run_reader import REPORT_FILENAME
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import (
    SNAKESIM_COMMAND,
    CompletedRun,
    make_environment,
    run_in_background,
    run_to_summary,
    snakesim,
)

pytestmark = pytest.mark.e2e

SUITE = """
title = "A quick one"
scenario = "peg_row"
controllers = ["path_following", "hold"]
seeds = 2

[set]
duration_s = 0.6
mission.goal = { kind = "heading", distance_m = 0.06 }

[vary]
"scene.ground.friction" = [0.1, 0.2]
"""
TRIAL_COUNT = 8
DASK = (sys.executable, "-m", "dask")
TABLES = ("results.csv", "results.parquet", "evaluation.html")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluate")
    (folder / "quick.toml").write_text(SUITE)
    return folder


@pytest.fixture(scope="module")
def undisturbed(home: Path) -> tuple[CompletedRun, Path]:
    """An evaluation to compare others with, and its folder."""
    command = evaluate(home, "undisturbed", "--workers", "2")
    assert command.code == 0, command.out + command.err
    assert not command.err, command.err
    return command, home / "undisturbed"


def evaluate(home: Path, out: str, *arguments: str) -> CompletedRun:
    return snakesim("study", "evaluate", "./quick.toml", "--out", out, *arguments, cwd=home)


def extract_table(command: CompletedRun) -> str:
    return command.out[command.out.index("condition ") : command.out.index("written:")]


def count_finished_trials(folder: Path) -> int:
    path = folder / "trials.jsonl"
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def is_running(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return process.status() != psutil.STATUS_ZOMBIE
    return False


@pytest.mark.slow
def test_evaluation_of_one_condition_compares_with_another_card(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    options = ("--conditions", "2", "--controller", "hold", "--against", str(undisturbed[1]))
    command = evaluate(home, "part", *options)
    assert command.code == 0, command.out + command.err
    lines = command.out.splitlines()
    assert sum(line.strip().startswith("cost of transport") for line in lines) == 1
    assert "code " in command.out
    assert "seeds 1 to 2" in command.out
    assert "hold against path_following" in command.out
    assert re.search("with 2 seeds, .* times only the second; p = ", command.out)
    assert "Holm's correction for 2 comparisons" in command.out
    (score,) = json.loads((home / "part" / "card.json").read_bytes())["scores"]
    assert score["controller"] == "hold"
    assert score["trial_count"] == 2
    assert score["success_count"] == 0
    assert score["medians"]["jam_ratio"] is not None
    assert score["medians"]["desired_force_error"] is None


@pytest.mark.slow
def test_evaluation_table_shows_which_goals_were_reached(
    undisturbed: tuple[CompletedRun, Path],
) -> None:
    command, folder = undisturbed
    rows = [line.split() for line in extract_table(command).splitlines()[1:5]]
    assert [row[2:4] for row in rows] == [["path_following", "2/2"], ["hold", "0/2"]] * 2
    assert count_finished_trials(folder) == TRIAL_COUNT
    assert all((folder / name).is_file() for name in TABLES)
    scores = json.loads((folder / "card.json").read_bytes())["scores"]
    assert all(0 < score["medians"]["planning_fraction"] <= 1 for score in scores)
    assert all(0 <= score["medians"]["form_closure"] <= 1 for score in scores)


@pytest.mark.slow
def test_evaluation_repeated_gives_the_same_files(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    repeated = evaluate(home, "again", "--workers", "1")
    assert extract_table(repeated) == extract_table(undisturbed[0])
    for name in TABLES:
        assert (home / "again" / name).read_bytes() == (undisturbed[1] / name).read_bytes(), name
    lines = (home / "again" / "trials.jsonl").read_text().splitlines()
    seeds = [json.loads(line)["outcome"]["metrics"]["seed"] for line in lines]
    assert seeds == [1] * 4 + [2] * 4, "if stopped, every condition would have the same seeds"


@pytest.mark.slow
def test_evaluation_killed_leaves_no_process_and_can_be_resumed(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    folder = home / "killed"
    with run_in_background(
        home, "study", "evaluate", "./quick.toml", "--workers", "2", "--out", str(folder)
    ) as process:
        wait_until(lambda: count_finished_trials(folder) >= 2, "two trials finished")
        command_process = psutil.Process(process.pid)
        workers = command_process.children()
        assert len(workers) >= 2
        sockets = [
            socket
            for process_with_sockets in (command_process, *workers)
            for socket in process_with_sockets.net_connections("tcp")
        ]
        assert not [socket for socket in sockets if socket.status == psutil.CONN_LISTEN]
        workers[-1].suspend()  # it cannot see that its parent dies
    wait_until(lambda: not any(map(is_running, workers)), "no process left", 10)
    finished_count = count_finished_trials(folder)
    assert 2 <= finished_count < TRIAL_COUNT
    with (folder / "trials.jsonl").open("a") as file:
        file.write('{"id": "cut')
    refused = evaluate(home, "killed")
    assert refused.code == 2
    assert "--resume" in refused.err
    resumed = evaluate(home, "killed", "--resume")
    assert f"{finished_count} of {TRIAL_COUNT} trials are finished already" in resumed.out, (
        resumed.out + resumed.err
    )
    assert extract_table(resumed) == extract_table(undisturbed[0])
    for name in TABLES:
        assert (folder / name).read_bytes() == (undisturbed[1] / name).read_bytes(), name


# For each command, a line after which it is stopped, and what it prints then.
STOPPED = {
    "evaluate": (
        "workers, on this computer",
        "trials are finished; the same command continues with\n  --resume --out stopped",
    ),
    "optimize": ("keeps all candidates", "the same command continues with\n  --storage stopped.db"),
    "train": (
        "generation 1:",
        "stopped/policy.onnx is the best policy until then, .* continues with --resume",
    ),
}
ARGUMENTS = {
    "evaluate": ("study", "evaluate", "./quick.toml", "--seeds", "400", "--out", "stopped"),
    "optimize": (
        "study",
        "optimize",
        "peg_row",
        "--vary",
        "control.propulsion_n=5:40",
        "--goal",
        "advance_m",
        "--storage",
        "stopped.db",
    ),
    "train": (
        "policy",
        "train",
        "surveyed_clutter",
        "--duration",
        "0.2",
        "--population",
        "4",
        "--seeds",
        "1",
        "--out",
        "stopped",
    ),
}


@pytest.mark.heavy
@pytest.mark.parametrize(
    "command",
    ["evaluate", *(pytest.param(name, marks=pytest.mark.slow) for name in ("optimize", "train"))],
)
def test_evaluate_interrupted_stops_at_once_and_keeps_only_results(
    command: str, tmp_path: Path
) -> None:
    (tmp_path / "quick.toml").write_text(SUITE)
    (tmp_path / "tmp").mkdir()
    start_line, end_lines = STOPPED[command]
    environment = {**make_environment(tmp_path), "TMPDIR": str(tmp_path / "tmp")}
    with subprocess.Popen(
        [*SNAKESIM_COMMAND, *ARGUMENTS[command], "--workers", "2"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        output = ""
        while start_line not in output and (line := process.stdout.readline()):
            output += line
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        output += process.stdout.read()
    assert process.returncode == 130, output
    assert re.search(end_lines, output), output
    assert "Traceback" not in output, output
    assert "leaked" not in output, output
    assert not list((tmp_path / "tmp").glob("snakesim-*"))


def make_dask_arguments() -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Return the address of a new scheduler, and the arguments of `dask` for this scheduler and for a worker."""
    port = str(find_free_port())
    address = f"tcp://127.0.0.1:{port}"
    scheduler = ("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    worker = (
        "worker",
        address,
        "--nthreads",
        "1",
        "--no-nanny",
        "--no-dashboard",
        "--host",
        "127.0.0.1",
    )
    return address, scheduler, worker


@pytest.mark.slow
def test_training_on_a_cluster_finds_the_same_policy(home: Path) -> None:
    address, scheduler, worker = make_dask_arguments()
    small = [
        "--generations",
        "2",
        "--population",
        "4",
        "--seeds",
        "1",
        "--check-seeds",
        "1",
        "--duration",
        "0.5",
    ]
    train = ["policy", "train", "surveyed_clutter", *small]
    with (
        run_in_background(home, *scheduler, program=DASK),
        run_in_background(home, *worker, program=DASK),
    ):
        there = snakesim(
            "policy",
            "train",
            "surveyed_clutter",
            *small,
            "--cluster",
            address,
            "--out",
            "there",
            cwd=home,
        )
    here = snakesim(*train, "--workers", "1", "--out", "here", cwd=home)
    assert there.code == here.code == 0, there.out + there.err + here.err
    assert (home / "there" / "policy.onnx").read_bytes() == (
        home / "here" / "policy.onnx"
    ).read_bytes()


@pytest.mark.slow
def test_evaluation_on_a_cluster_survives_the_loss_of_a_worker(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    address, scheduler, worker = make_dask_arguments()
    folder = home / "cluster"
    with (
        run_in_background(home, *scheduler, program=DASK),
        run_in_background(home, *worker, program=DASK) as lost,
        run_in_background(home, *worker, program=DASK),
        run_in_background(
            home, "study", "evaluate", "./quick.toml", "--cluster", address, "--out", str(folder)
        ) as process,
    ):
        wait_until(lambda: count_finished_trials(folder) >= 2, "two trials finished")
        lost.kill()
        assert process.wait(90) == 0
    for name in TABLES:
        assert (folder / name).read_bytes() == (undisturbed[1] / name).read_bytes(), name


@pytest.mark.slow
def test_evaluation_of_one_trial_repeats_its_run(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    command = evaluate(home, "one", "--trial", "path_following:2:2")
    assert command.code == 0, command.out + command.err
    assert (home / "one" / REPORT_FILENAME).is_file(), command.out + command.err
    digest = json.loads((home / "one" / HOST_RECORD).read_bytes())["command_digest"]
    table_text = (undisturbed[1] / "results.csv").read_text()
    columns, *rows = [line.split(",") for line in table_text.splitlines()]
    trial_rows = [row for row in rows if row[0] == "2" and row[2:4] == ["path_following", "2"]]
    assert [row[columns.index("command_digest")] for row in trial_rows] == [digest]
    without_condition = evaluate(home, "none", "--trial", "path_following:2")
    assert without_condition.code == 2
    assert "path_following:2:1" in without_condition.err


DEADLY = """
import os
from snakesim_gnc.control.hold import HoldPose


class Deadly(HoldPose):
    def update(self, observation):
        if observation.tick > 20:
            os._exit(1)
        return super().update(observation)
"""


@pytest.mark.slow
def test_trial_that_kills_its_workers_does_not_affect_others(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    (home / "deadly.py").write_text(DEADLY)
    command = evaluate(
        home, "deadly", "--controllers", "path_following,./deadly.py:Deadly", "--seeds", "1"
    )
    assert command.code == 1, command.out + command.err
    assert "its worker process died" in command.out, command.out + command.err
    rows = [line.split() for line in extract_table(command).splitlines()[1:5]]
    assert [row[3] for row in rows] == ["1/1", "0/1"] * 2


@pytest.mark.slow
def test_sweep_runs_every_value(home: Path) -> None:
    options = [
        "--vary",
        "controllers.path_following.look_ahead_m=0.02:0.06:3",
        "--set",
        "duration_s=0.5",
        "--seeds",
        "2",
        "--set",
        "controller=path_following",
    ]
    command = snakesim("study", "sweep", "peg_row", *options, "--out", "sweep", cwd=home)
    assert command.code == 0, command.out + command.err
    values = [line.split()[1] for line in extract_table(command).splitlines()[1:4]]
    assert values == ["0.02", "0.04", "0.06"]
    page = re.sub(
        r"<(script|style).*?</\1>",
        "",
        (home / "sweep" / "evaluation.html").read_text(),
        flags=re.DOTALL,
    )
    assert not re.findall("goal", command.out + page), "a scenario without a goal"


@pytest.mark.slow
def test_optimize_resumes_and_prints_a_runnable_command(home: Path) -> None:
    arguments = [
        *("study", "optimize", "peg_row", "--set", "duration_s=0.5"),
        *("--vary", "control.propulsion_n=5:40", "--seed", "2"),
        *("--goal", "path_distance_m", "--workers", "2"),
    ]
    first = snakesim(*arguments, "--candidates", "2", cwd=home)
    assert first.code == 0, first.out + first.err
    assert first.out.count("candidate ") >= 3, first.out + first.err
    (storage,) = (home / "runs").glob("optimize-*.db")
    assert f"runs/{storage.name} keeps all candidates" in first.out, first.out + first.err
    more = snakesim(*arguments, "--storage", f"runs/{storage.name}", "--candidates", "4", cwd=home)
    assert "holds 2 candidates already" in more.out, more.out + more.err
    assert "candidate 4:" in more.out, more.out + more.err
    _, report = more.out.split("best path_distance_m: ")
    command = shlex.split(report.splitlines()[1])
    assert command.pop(0) == "snakesim"
    assert "--until-goal" not in command, "`snakesim run` refuses it for a mission without a goal"
    repeated, summary = run_to_summary(home / "again", *command[1:])
    assert repeated.code == 0, repeated.out + repeated.err
    assert f"{summary.path_distance_m:.4g}" == report.split(",")[0], repeated.out + repeated.err


@pytest.mark.slow
def test_optimize_in_a_suite_condition_prints_an_evaluation(home: Path) -> None:
    arguments = [
        *("study", "optimize", "./quick.toml", "--conditions", "2"),
        *("--set", "controller=path_following", "--set", "duration_s=0.4"),
        *("--vary", "control.look_ahead_m=0.02:0.1", "--goal", "advance_m"),
        *("--candidates", "1", "--seeds", "2"),
    ]
    search = snakesim(*arguments, "--storage", "condition.db", cwd=home)
    _, report = search.out.split("best advance_m: ")
    command = shlex.split(report.splitlines()[1])
    assert command.pop(0) == "snakesim", search.out
    assert command[:5] == ["study", "evaluate", "./quick.toml", "--conditions", "2"], search.out
    evaluation = snakesim(*command, "--controllers", "path_following", "--out", "best", cwd=home)
    assert evaluation.code == 0, evaluation.out + evaluation.err
    lines = (home / "best" / "trials.jsonl").read_text().splitlines()
    metrics_of_trials = [json.loads(line)["outcome"]["metrics"] for line in lines]
    assert len(metrics_of_trials) == 2
    assert {metrics["ticks"] for metrics in metrics_of_trials} == {40}, (
        "--set also changes the conditions of the suite"
    )
    mean_advance_m = sum(metrics["advance_m"] for metrics in metrics_of_trials) / 2
    assert f"{mean_advance_m:.4g}" == report.split(",")[0]
