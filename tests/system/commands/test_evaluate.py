"""Evaluations, searches and trainings in worker processes give the same result after a repetition, kill or resume."""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

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

SUITE_FILE = """
title = "A quick one"
scenario = "peg_row"
controllers = ["path_following", "hold"]
fields = 2

[set]
duration_s = 0.6
mission.goal = { kind = "heading", distance_m = 0.06 }

[vary]
"scene.ground.friction" = [0.1, 0.2]
"""
CASE_COUNT = 8
DASK_PROGRAM = (sys.executable, "-m", "dask")
RESULT_FILES = ("results.csv", "results.parquet", "evaluation.html")


class Evaluation(NamedTuple):
    """A completed evaluation and the folder of its results."""

    completed: CompletedRun
    folder: Path


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with a suite of eight short cases."""
    folder = tmp_path_factory.mktemp("evaluate")
    (folder / "quick.toml").write_text(SUITE_FILE)
    return folder


@pytest.fixture(scope="module")
def reference(home: Path) -> Evaluation:
    """Run the undisturbed evaluation with which others are compared."""
    completed = evaluate(home, "undisturbed", "--workers", "2")
    assert completed.code == 0, completed.out + completed.err
    assert not completed.err, completed.out + completed.err
    return Evaluation(completed, home / "undisturbed")


def evaluate(home: Path, out: str, *arguments: str) -> CompletedRun:
    """Evaluate the suite, with results in the folder `out`."""
    return snakesim("study", "evaluate", "./quick.toml", "--out", out, *arguments, cwd=home)


def extract_table(completed: CompletedRun) -> str:
    """Return the table that an evaluation printed."""
    return completed.out[completed.out.index("setting ") : completed.out.index("written:")]


def count_completed_cases(out: Path) -> int:
    """Return the number of cases whose results are in a folder."""
    path = out / "cases.jsonl"
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def is_running(process: psutil.Process) -> bool:
    """Return whether a process exists and is no zombie."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return process.status() != psutil.STATUS_ZOMBIE
    return False


@pytest.mark.slow
def test_evaluation_against_another_pairs_its_cases(home: Path, reference: Evaluation) -> None:
    completed = evaluate(
        home, "part", "--rows", "2", "--controller", "hold", "--against", str(reference.folder)
    )
    assert completed.code == 0, completed.out + completed.err
    assert (
        sum(line.strip().startswith("cost of transport") for line in completed.out.splitlines())
        == 1
    )
    assert "code " in completed.out
    assert "fields 1 to 2" in completed.out
    assert "hold against path_following" in completed.out
    assert "of 2; p = " in completed.out
    assert "Holm's correction for 2 comparisons" in completed.out
    (score,) = json.loads((home / "part" / "card.json").read_bytes())["scores"]
    assert score["controller"] == "hold"
    assert score["runs"] == 2
    assert score["success_count"] == 0
    assert score["medians"]["jam_ratio"] is not None
    assert score["medians"]["desired_force_error"] is None


@pytest.mark.slow
def test_evaluation_table_has_success_counts_of_each_controller(
    reference: Evaluation,
) -> None:
    completed, out = reference
    rows = [line.split() for line in extract_table(completed).splitlines()[1:5]]
    assert [row[2:4] for row in rows] == [["path_following", "2/2"], ["hold", "0/2"]] * 2
    assert count_completed_cases(out) == CASE_COUNT
    assert all((out / name).is_file() for name in RESULT_FILES)
    scores = json.loads((out / "card.json").read_bytes())["scores"]
    assert all(0 < score["medians"]["planning_fraction"] <= 1 for score in scores)
    assert all(0 <= score["medians"]["form_closure"] <= 1 for score in scores)


@pytest.mark.slow
def test_evaluation_repeated_has_same_results(home: Path, reference: Evaluation) -> None:
    repeated = evaluate(home, "again", "--workers", "1")
    assert extract_table(repeated) == extract_table(reference.completed)
    for name in RESULT_FILES:
        assert (home / "again" / name).read_bytes() == (reference.folder / name).read_bytes(), name
    lines = (home / "again" / "cases.jsonl").read_text().splitlines()
    seeds = [json.loads(line)["outcome"]["numbers"]["seed"] for line in lines]
    # An evaluation that is cut short has as many random scenes in each row.
    assert seeds == [1] * 4 + [2] * 4


@pytest.mark.slow
def test_evaluation_killed_leaves_no_process_and_can_resume(
    home: Path, reference: Evaluation
) -> None:
    out = home / "killed"
    with run_in_background(
        home, "study", "evaluate", "./quick.toml", "--workers", "2", "--out", str(out)
    ) as process:
        wait_until(lambda: count_completed_cases(out) >= 2, "two completed cases")
        parent = psutil.Process(process.pid)
        workers = parent.children()
        assert len(workers) >= 2
        sockets = [
            socket
            for evaluator in (parent, *workers)
            for socket in evaluator.net_connections("tcp")
        ]
        assert not [socket for socket in sockets if socket.status == psutil.CONN_LISTEN]
        workers[-1].suspend()  # This worker cannot notice the end of its parent.
    wait_until(lambda: not any(map(is_running, workers)), "no process left", 10)
    count_before = count_completed_cases(out)
    assert 2 <= count_before < CASE_COUNT
    with (out / "cases.jsonl").open("a") as file:
        file.write('{"id": "cut')
    refused = evaluate(home, "killed")
    assert refused.code == 2
    assert "--resume" in refused.err
    resumed = evaluate(home, "killed", "--resume")
    assert f"{count_before} of {CASE_COUNT} cases are done already" in resumed.out, (
        resumed.out + resumed.err
    )
    assert extract_table(resumed) == extract_table(reference.completed)
    for name in RESULT_FILES:
        assert (out / name).read_bytes() == (reference.folder / name).read_bytes(), name


INTERRUPTED_OUTPUT = {  # what the command prints before the test interrupts it, and at its end
    "evaluate": (
        "workers, on this computer",
        "cases are done; the same command continues with\n  --resume --out stopped",
    ),
    "optimize": ("keeps all trials", "the same command continues with\n  --storage stopped.db"),
    "train": (
        "generation 1:",
        "stopped/policy.onnx is the best policy until then, .* goes on with --resume",
    ),
}
INTERRUPTED_COMMANDS = {
    "evaluate": ("study", "evaluate", "./quick.toml", "--fields", "400", "--out", "stopped"),
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
        "--fields",
        "1",
        "--out",
        "stopped",
    ),
}


@pytest.mark.parametrize(
    "command",
    ["evaluate", *(pytest.param(name, marks=pytest.mark.slow) for name in ("optimize", "train"))],
)
def test_evaluation_interrupted_stops_at_once_and_keeps_results(
    command: str, tmp_path: Path
) -> None:
    (tmp_path / "quick.toml").write_text(SUITE_FILE)
    (tmp_path / "tmp").mkdir()
    start_text, end_pattern = INTERRUPTED_OUTPUT[command]
    environment = {**make_environment(tmp_path), "TMPDIR": str(tmp_path / "tmp")}
    with subprocess.Popen(
        [*SNAKESIM_COMMAND, *INTERRUPTED_COMMANDS[command], "--workers", "2"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        output = ""
        while start_text not in output and (line := process.stdout.readline()):
            output += line
        os.killpg(process.pid, signal.SIGINT)  # A terminal also signals the whole group.
        output += process.stdout.read()
    assert process.returncode == 130, output
    assert re.search(end_pattern, output), output
    assert "Traceback" not in output, output
    assert "leaked" not in output, output
    assert not list((tmp_path / "tmp").glob("snakesim-*"))


def make_dask_arguments() -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Return the address of a new Dask scheduler, and the arguments of scheduler and worker."""
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
def test_training_on_cluster_finds_same_policy(home: Path) -> None:
    address, scheduler, worker = make_dask_arguments()
    small = ["--generations", "2", "--population", "4", "--fields", "1", "--check-fields", "1"]
    train = ["policy", "train", "surveyed_clutter", *small, "--duration", "0.5"]
    with (
        run_in_background(home, *scheduler, program=DASK_PROGRAM),
        run_in_background(home, *worker, program=DASK_PROGRAM),
    ):
        on_cluster = snakesim(*train, "--cluster", address, "--out", "cluster_policy", cwd=home)
    local = snakesim(*train, "--workers", "1", "--out", "local_policy", cwd=home)
    assert on_cluster.code == local.code == 0, on_cluster.out + on_cluster.err + local.err
    cluster_policy = (home / "cluster_policy" / "policy.onnx").read_bytes()
    assert cluster_policy == (home / "local_policy" / "policy.onnx").read_bytes()


@pytest.mark.slow
def test_evaluation_on_cluster_with_lost_worker_has_same_results(
    home: Path, reference: Evaluation
) -> None:
    address, scheduler, worker = make_dask_arguments()
    out = home / "cluster"
    with (
        run_in_background(home, *scheduler, program=DASK_PROGRAM),
        run_in_background(home, *worker, program=DASK_PROGRAM) as lost_worker,
        run_in_background(home, *worker, program=DASK_PROGRAM),
        run_in_background(
            home, "study", "evaluate", "./quick.toml", "--cluster", address, "--out", str(out)
        ) as process,
    ):
        wait_until(lambda: count_completed_cases(out) >= 2, "two completed cases")
        lost_worker.kill()
        assert process.wait(90) == 0
    for name in RESULT_FILES:
        assert (out / name).read_bytes() == (reference.folder / name).read_bytes(), name


@pytest.mark.slow
def test_evaluation_of_one_case_repeats_it_as_a_run(home: Path, reference: Evaluation) -> None:
    completed = evaluate(home, "one", "--only", "path_following:2:2")
    assert completed.code == 0, completed.out + completed.err
    assert (home / "one" / REPORT_FILENAME).is_file()
    digest = json.loads((home / "one" / HOST_RECORD).read_bytes())["command_digest"]
    rows = [line.split(",") for line in (reference.folder / "results.csv").read_text().splitlines()]
    column = rows[0].index("command_digest")
    matching_rows = [row for row in rows if row[0] == "2" and row[2:4] == ["path_following", "2"]]
    assert [row[column] for row in matching_rows] == [digest]
    ambiguous = evaluate(home, "none", "--only", "path_following:2")
    assert ambiguous.code == 2
    assert "path_following:2:1" in ambiguous.err


DEADLY_CONTROLLER = """
import os
from snakesim_gnc.control.hold import HoldPose


class Deadly(HoldPose):
    def update(self, observation):
        if observation.tick > 20:
            os._exit(1)
        return super().update(observation)
"""


@pytest.mark.slow
def test_evaluation_with_case_that_kills_workers_completes_the_others(
    home: Path, reference: Evaluation
) -> None:
    (home / "deadly.py").write_text(DEADLY_CONTROLLER)
    completed = evaluate(
        home, "deadly", "--controllers", "path_following,./deadly.py:Deadly", "--fields", "1"
    )
    assert completed.code == 1, completed.out + completed.err
    assert "its worker process died" in completed.out, completed.out + completed.err
    rows = [line.split() for line in extract_table(completed).splitlines()[1:5]]
    assert [row[3] for row in rows] == ["1/1", "0/1"] * 2


@pytest.mark.slow
def test_sweep_evaluates_every_value(home: Path) -> None:
    options = ["--vary", "controllers.path_following.look_ahead_m=0.02:0.06:3"]
    options += ["--set", "duration_s=0.5", "--seeds", "2", "--set", "controller=path_following"]
    completed = snakesim("study", "sweep", "peg_row", *options, "--out", "sweep", cwd=home)
    assert completed.code == 0, completed.out + completed.err
    values = [line.split()[1] for line in extract_table(completed).splitlines()[1:4]]
    assert values == ["0.02", "0.04", "0.06"]
    html = (home / "sweep" / "evaluation.html").read_text()
    text = re.sub(r"<(script|style).*?</\1>", "", html, flags=re.DOTALL)
    assert not re.findall("goal", completed.out + text), "the scenario has no goal"


def parse_best_trial(output: str, goal: str) -> tuple[str, list[str]]:
    """Return the value of the best trial of a search, and the arguments of the command that repeats it."""
    _, best = output.split(f"best {goal}: ")
    program, *arguments = shlex.split(best.splitlines()[1])
    assert program == "snakesim"
    return best.split(",")[0], arguments


@pytest.mark.slow
def test_search_resumes_and_prints_command_that_repeats_its_best(home: Path) -> None:
    search = ["study", "optimize", "peg_row", "--set", "duration_s=0.5"]
    search += ["--vary", "control.propulsion_n=5:40", "--seed", "2"]
    search += ["--goal", "path_distance_m", "--workers", "2"]
    first = snakesim(*search, "--trials", "2", cwd=home)
    assert first.code == 0, first.out + first.err
    assert first.out.count("trial ") >= 3, first.out + first.err
    (storage,) = (home / "runs").glob("optimize-*.db")
    assert f"runs/{storage.name} keeps all trials" in first.out, first.out + first.err
    resumed = snakesim(*search, "--storage", f"runs/{storage.name}", "--trials", "4", cwd=home)
    assert "holds 2 trials already" in resumed.out, resumed.out + resumed.err
    assert "trial 4:" in resumed.out, resumed.out + resumed.err
    best_distance_m, command = parse_best_trial(resumed.out, "path_distance_m")
    assert "--until-goal" not in command, "`snakesim run` refuses it for a mission without a goal"
    repeated, summary = run_to_summary(home / "again", *command[1:])
    assert repeated.code == 0, repeated.out + repeated.err
    assert f"{summary.path_distance_m:.4g}" == best_distance_m


@pytest.mark.slow
def test_search_on_suite_row_prints_evaluation_of_its_best(home: Path) -> None:
    search = ["study", "optimize", "./quick.toml", "--rows", "2"]
    search += ["--set", "controller=path_following", "--set", "duration_s=0.4"]
    search += ["--vary", "control.look_ahead_m=0.02:0.1"]
    search += ["--goal", "advance_m", "--trials", "1", "--seeds", "2"]
    completed_search = snakesim(*search, "--storage", "row.db", cwd=home)
    best_advance_m, command = parse_best_trial(completed_search.out, "advance_m")
    assert command[:5] == ["study", "evaluate", "./quick.toml", "--rows", "2"], completed_search.out
    completed = snakesim(*command, "--controllers", "path_following", "--out", "best", cwd=home)
    assert completed.code == 0, completed.out + completed.err
    lines = (home / "best" / "cases.jsonl").read_text().splitlines()
    cases = [json.loads(line)["outcome"]["numbers"] for line in lines]
    assert len(cases) == 2
    assert {case["ticks"] for case in cases} == {40}, (
        "the duration that was set is not that of a row"
    )
    mean_advance_m = sum(case["advance_m"] for case in cases) / 2
    assert f"{mean_advance_m:.4g}" == best_advance_m
