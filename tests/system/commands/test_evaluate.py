"""Evaluations in real worker processes: the same table however often, wherever, and whatever was killed on the way."""

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
fields = 2

[set]
duration_s = 0.6
mission.goal = { kind = "heading", distance_m = 0.06 }

[vary]
"scene.ground.friction" = [0.1, 0.2]
"""
CASES = 8
DASK = (sys.executable, "-m", "dask")
TABLES = ("results.csv", "results.parquet", "evaluation.html")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluate")
    (folder / "quick.toml").write_text(SUITE)
    return folder


@pytest.fixture(scope="module")
def undisturbed(home: Path) -> tuple[CompletedRun, Path]:
    """An evaluation to compare others with."""
    ended = evaluate(home, "undisturbed", "--workers", "2")
    assert ended.code == 0 and not ended.err, ended.out + ended.err
    return ended, home / "undisturbed"


def evaluate(home: Path, out: str, *arguments: str) -> CompletedRun:
    return snakesim("study", "evaluate", "./quick.toml", "--out", out, *arguments, cwd=home)


def table_of(ended: CompletedRun) -> str:
    return ended.out[ended.out.index("setting ") : ended.out.index("written:")]


def done(out: Path) -> int:
    path = out / "cases.jsonl"
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def lives(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return process.status() != psutil.STATUS_ZOMBIE
    return False


@pytest.mark.slow
def test_a_part_of_it_pairs_with_the_card_of_another(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    ended = evaluate(
        home, "part", "--rows", "2", "--controller", "hold", "--against", str(undisturbed[1])
    )
    assert ended.code == 0, ended.out + ended.err
    assert sum(line.strip().startswith("cost of transport") for line in ended.out.splitlines()) == 1
    assert "code " in ended.out
    assert "fields 1 to 2" in ended.out
    assert "hold against path_following" in ended.out
    assert "of 2; p = " in ended.out
    assert "Holm's correction for 2 comparisons" in ended.out
    (score,) = json.loads((home / "part" / "card.json").read_bytes())["scores"]
    assert score["controller"] == "hold"
    assert score["runs"] == 2
    assert score["success_count"] == 0
    assert score["medians"]["jam_ratio"] is not None
    assert score["medians"]["desired_force_error"] is None


@pytest.mark.slow
def test_the_table_tells_which_goals_were_reached(undisturbed: tuple[CompletedRun, Path]) -> None:
    ended, out = undisturbed
    rows = [line.split() for line in table_of(ended).splitlines()[1:5]]
    assert [row[2:4] for row in rows] == [["path_following", "2/2"], ["hold", "0/2"]] * 2
    assert done(out) == CASES
    assert all((out / name).is_file() for name in TABLES)
    scores = json.loads((out / "card.json").read_bytes())["scores"]
    assert all(0 < score["medians"]["planning_fraction"] <= 1 for score in scores)
    assert all(0 <= score["medians"]["form_closure"] <= 1 for score in scores)


@pytest.mark.slow
def test_it_can_be_repeated(home: Path, undisturbed: tuple[CompletedRun, Path]) -> None:
    again = evaluate(home, "again", "--workers", "1")
    assert table_of(again) == table_of(undisturbed[0])
    for name in TABLES:
        assert (home / "again" / name).read_bytes() == (undisturbed[1] / name).read_bytes(), name
    lines = (home / "again" / "cases.jsonl").read_text().splitlines()
    fields = [json.loads(line)["outcome"]["numbers"]["seed"] for line in lines]
    assert fields == [1] * 4 + [2] * 4, "cut short, it would have as many fields in each row"


@pytest.mark.slow
def test_killed_it_leaves_nobody_behind_and_goes_on(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    out = home / "killed"
    with run_in_background(
        home, "study", "evaluate", "./quick.toml", "--workers", "2", "--out", str(out)
    ) as process:
        wait_until(lambda: done(out) >= 2, "two cases done")
        command_itself = psutil.Process(process.pid)
        left = command_itself.children()
        assert len(left) >= 2
        sockets = [
            socket for one in (command_itself, *left) for socket in one.net_connections("tcp")
        ]
        assert not [socket for socket in sockets if socket.status == psutil.CONN_LISTEN]
        left[-1].suspend()  # it cannot see that its parent dies
    wait_until(lambda: not any(map(lives, left)), "no process left", 10)
    before = done(out)
    assert 2 <= before < CASES
    with (out / "cases.jsonl").open("a") as file:
        file.write('{"id": "cut')
    refused = evaluate(home, "killed")
    assert refused.code == 2
    assert "--resume" in refused.err
    ended = evaluate(home, "killed", "--resume")
    assert f"{before} of {CASES} cases are done already" in ended.out, ended.out + ended.err
    assert table_of(ended) == table_of(undisturbed[0])
    for name in TABLES:
        assert (out / name).read_bytes() == (undisturbed[1] / name).read_bytes(), name


STOPPED = {
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
TYPED = {
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
def test_evaluate_interrupted_stops_at_once_and_keeps_only_results(
    command: str, tmp_path: Path
) -> None:
    (tmp_path / "quick.toml").write_text(SUITE)
    (tmp_path / "tmp").mkdir()
    begun, kept = STOPPED[command]
    environment_of_it = {**make_environment(tmp_path), "TMPDIR": str(tmp_path / "tmp")}
    with subprocess.Popen(
        [*SNAKESIM_COMMAND, *TYPED[command], "--workers", "2"],
        cwd=tmp_path,
        env=environment_of_it,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        said = ""
        while begun not in said and (line := process.stdout.readline()):
            said += line
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        said += process.stdout.read()
    assert process.returncode == 130 and re.search(kept, said), said
    assert "Traceback" not in said and "leaked" not in said, said
    assert not list((tmp_path / "tmp").glob("snakesim-*"))


def dask() -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Where a scheduler of our own will listen, and what Dask is told to be it and a worker."""
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
    address, scheduler, worker = dask()
    small = [
        "--generations",
        "2",
        "--population",
        "4",
        "--fields",
        "1",
        "--check-fields",
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
def test_a_cluster_that_loses_a_worker_gives_the_same_table(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    address, scheduler, worker = dask()
    out = home / "cluster"
    with (
        run_in_background(home, *scheduler, program=DASK),
        run_in_background(home, *worker, program=DASK) as lost,
        run_in_background(home, *worker, program=DASK),
        run_in_background(
            home, "study", "evaluate", "./quick.toml", "--cluster", address, "--out", str(out)
        ) as process,
    ):
        wait_until(lambda: done(out) >= 2, "two cases done")
        lost.kill()
        assert process.wait(90) == 0
    for name in TABLES:
        assert (out / name).read_bytes() == (undisturbed[1] / name).read_bytes(), name


@pytest.mark.slow
def test_one_case_again_as_a_whole_run(home: Path, undisturbed: tuple[CompletedRun, Path]) -> None:
    ended = evaluate(home, "one", "--only", "path_following:2:2")
    assert ended.code == 0 and (home / "one" / REPORT_FILENAME).is_file(), ended.out + ended.err
    digest = json.loads((home / "one" / HOST_RECORD).read_bytes())["command_digest"]
    rows = [line.split(",") for line in (undisturbed[1] / "results.csv").read_text().splitlines()]
    names = rows[0]
    chosen = [row for row in rows if row[0] == "2" and row[2:4] == ["path_following", "2"]]
    assert [row[names.index("command_digest")] for row in chosen] == [digest]
    unclear = evaluate(home, "none", "--only", "path_following:2")
    assert unclear.code == 2
    assert "path_following:2:1" in unclear.err


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
def test_a_case_that_kills_its_workers_costs_no_other(
    home: Path, undisturbed: tuple[CompletedRun, Path]
) -> None:
    (home / "deadly.py").write_text(DEADLY)
    ended = evaluate(
        home, "deadly", "--controllers", "path_following,./deadly.py:Deadly", "--fields", "1"
    )
    assert ended.code == 1 and "its worker process died" in ended.out, ended.out + ended.err
    rows = [line.split() for line in table_of(ended).splitlines()[1:5]]
    assert [row[3] for row in rows] == ["1/1", "0/1"] * 2


@pytest.mark.slow
def test_a_sweep_runs_every_value(home: Path) -> None:
    span = "controllers.path_following.look_ahead_m=0.02:0.06:3"
    given = [
        "--vary",
        span,
        "--set",
        "duration_s=0.5",
        "--seeds",
        "2",
        "--set",
        "controller=path_following",
    ]
    ended = snakesim("study", "sweep", "peg_row", *given, "--out", "sweep", cwd=home)
    assert ended.code == 0, ended.out + ended.err
    assert [line.split()[1] for line in table_of(ended).splitlines()[1:4]] == [
        "0.02",
        "0.04",
        "0.06",
    ]
    page = re.sub(
        r"<(script|style).*?</\1>",
        "",
        (home / "sweep" / "evaluation.html").read_text(),
        flags=re.DOTALL,
    )
    assert not re.findall("goal", ended.out + page), "a scenario without a goal"


@pytest.mark.slow
def test_evaluate_search_resumes_and_prints_a_runnable_command(home: Path) -> None:
    given = [
        "study",
        "optimize",
        "peg_row",
        "--set",
        "duration_s=0.5",
        "--vary",
        "control.propulsion_n=5:40",
        "--seed",
        "2",
    ]
    given += ["--goal", "path_distance_m", "--workers", "2"]
    first = snakesim(*given, "--trials", "2", cwd=home)
    assert first.code == 0 and first.out.count("trial ") >= 3, first.out + first.err
    (kept,) = (home / "runs").glob("optimize-*.db")
    assert f"runs/{kept.name} keeps all trials" in first.out, first.out + first.err
    more = snakesim(*given, "--storage", f"runs/{kept.name}", "--trials", "4", cwd=home)
    assert "holds 2 trials already" in more.out and "trial 4:" in more.out, more.out + more.err
    _, said = more.out.split("best path_distance_m: ")
    command = shlex.split(said.splitlines()[1])
    assert command.pop(0) == "snakesim"
    assert "--until-goal" not in command, "`snakesim run` refuses it for a mission without a goal"
    again, summary = run_to_summary(home / "again", *command[1:])
    assert again.code == 0 and f"{summary.path_distance_m:.4g}" == said.split(",")[0], (
        again.out + again.err
    )


@pytest.mark.slow
def test_evaluate_search_on_a_suite_row_prints_an_evaluation(home: Path) -> None:
    given = [
        "study",
        "optimize",
        "./quick.toml",
        "--rows",
        "2",
        "--set",
        "controller=path_following",
        "--set",
        "duration_s=0.4",
    ]
    given += [
        "--vary",
        "control.look_ahead_m=0.02:0.1",
        "--goal",
        "advance_m",
        "--trials",
        "1",
        "--seeds",
        "2",
    ]
    found = snakesim(*given, "--storage", "row.db", cwd=home)
    _, said = found.out.split("best advance_m: ")
    command = shlex.split(said.splitlines()[1])
    assert command.pop(0) == "snakesim" and command[:5] == [
        "study",
        "evaluate",
        "./quick.toml",
        "--rows",
        "2",
    ], found.out
    ended = snakesim(*command, "--controllers", "path_following", "--out", "best", cwd=home)
    assert ended.code == 0, ended.out + ended.err
    lines = (home / "best" / "cases.jsonl").read_text().splitlines()
    cases = [json.loads(line)["outcome"]["numbers"] for line in lines]
    assert len(cases) == 2 and {case["ticks"] for case in cases} == {40}, (
        "what is set is set in a row, too"
    )
    assert f"{sum(case['advance_m'] for case in cases) / 2:.4g}" == said.split(",")[0]
