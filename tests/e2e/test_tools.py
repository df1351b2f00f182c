"""The other commands: config, scenarios, echo, status, router, and controllers from outside."""

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from tests.e2e.command import (
    SNAKESIM,
    environment,
    free_endpoint,
    nothing_left,
    run_to_summary,
    running,
    snakesim,
)

pytestmark = pytest.mark.e2e

TUTORIAL = Path("docs/tutorial.md").resolve()
ROUTER = Path("snakesim_hal/shipped/router.json5").resolve()


def test_config_tells_where_each_value_came_from(tmp_path: Path) -> None:
    ended = snakesim("config", "triplet", "--seed", "5", "--set", "control.propulsion_n=20", cwd=tmp_path)
    assert ended.code == 0, ended.err
    line = {row.split()[0]: row for row in ended.out.splitlines()}
    assert line["seed"].endswith("--seed 5")
    assert line["controllers.obstacle_triplet.propulsion_n"].endswith("--set control.propulsion_n=20")
    assert line["robot.module.length_m"].endswith("robots/planar13.toml")
    assert line["scene.ground.friction"].endswith("scenes/triplet.toml")
    assert line["stall_limit_s"].endswith("default")


def test_scenarios_lists_what_is_shipped(tmp_path: Path) -> None:
    ended = snakesim("scenarios", cwd=tmp_path)
    assert ended.code == 0
    for name in ("triplet", "peg_row", "jam", "planar13", "mamba"):
        assert name in ended.out


def test_echo_and_status_of_a_running_robot(tmp_path: Path) -> None:
    arguments = ["triplet", "--controller", "hold", "--duration", "600", "--pace", "realtime"]
    with running(tmp_path / "run", *arguments) as run:
        run.wait_for(" s  ")
        rate = snakesim("echo", "sensor/joints", "--hz", "--count", "2", "--endpoint", run.endpoint, cwd=tmp_path)
        found = re.findall(r"planar13/sensor/joints: ([\d.]+) Hz", rate.out)
        assert found and float(found[-1]) == pytest.approx(100, rel=0.1), rate.out + rate.err
        one = snakesim("echo", "hal/description", "--count", "1", "--endpoint", run.endpoint, cwd=tmp_path)
        assert '"name":"joint_13"' in one.out
        unknown = snakesim("echo", "sensor/smell", "--endpoint", run.endpoint, cwd=tmp_path)
        assert unknown.code == 2 and "sensor/contacts" in unknown.err
        status = snakesim("status", "--endpoint", run.endpoint, cwd=tmp_path)
        assert status.code == 0 and "planar13: armed" in status.out and "control, guidance, navigation" in status.out
        os.kill(run.process.pid, signal.SIGINT)
        assert run.end() == 130
    nothing_left(tmp_path / "run")


def test_status_without_a_robot(tmp_path: Path) -> None:
    ended = snakesim("status", "--endpoint", free_endpoint(), cwd=tmp_path)
    assert ended.code == 1 and "no robot answers" in ended.out


def test_run_over_a_router_of_ones_own(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    (tmp_path / "router.json5").write_text(ROUTER.read_text().replace("tcp/127.0.0.1:7447", endpoint))
    router = subprocess.Popen(
        [*SNAKESIM, "router", "router.json5"],
        cwd=tmp_path,
        env=environment(tmp_path),
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert router.stdout is not None and "router running" in router.stdout.readline()
        ended, summary = run_to_summary(
            tmp_path / "run", "triplet", "--controller", "hold", "--duration", "1", "--router", endpoint
        )
        assert ended.code == 0, ended.out + ended.err
        assert summary.ticks == 100 and summary.answered_fraction == 1.0
    finally:
        router.send_signal(signal.SIGINT)
        assert router.wait(10) == 130


def test_a_router_file_that_zenoh_refuses(tmp_path: Path) -> None:
    (tmp_path / "router.json5").write_text('{ mode: "peer" }')
    ended = snakesim("router", "router.json5", cwd=tmp_path)
    assert ended.code == 2 and "router" in ended.err


def test_the_controller_of_the_tutorial(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL)
    example = next(block for block in blocks if "class Wave" in block)
    assert len([line for line in example.splitlines() if line.strip()]) <= 24
    (tmp_path / "wave.py").write_text(example, encoding="utf-8")
    ended, summary = run_to_summary(tmp_path / "run", "triplet", "--controller", "./wave.py:Wave", "--duration", "2")
    assert ended.code == 0, ended.out + ended.err
    assert summary.controller == "./wave.py:Wave" and summary.energy_j is not None and summary.energy_j > 0.1

    # The same class as a stranger's installed package: an entry point is all it takes.
    package = tmp_path / "site" / "waves-1.0.dist-info"
    package.mkdir(parents=True)
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: waves\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[snakesim.controllers]\nwave = wave:Wave\n")
    (tmp_path / "site" / "wave.py").write_text(example, encoding="utf-8")
    ended, again = run_to_summary(
        tmp_path / "again",
        *("triplet", "--controller", "wave", "--duration", "2"),
        PYTHONPATH=os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")]),
    )
    assert ended.code == 0, ended.out + ended.err
    assert again.command_digest == summary.command_digest
