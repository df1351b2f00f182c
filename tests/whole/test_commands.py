"""Commands that need no robot: help, typos, config, scenarios, echo's list of keys, version."""

import shlex
from importlib.metadata import version
from pathlib import Path

import pytest

from snakesim_hal.wire import keys
from tests.whole.command import snakesim


def test_the_command_alone_lists_all_by_task(tmp_path: Path) -> None:
    ended = snakesim(cwd=tmp_path)
    assert ended.code == 0 and ended.out == snakesim("--help", cwd=tmp_path).out
    tasks = [line.rstrip(":") for line in ended.out.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert tasks[:4] == ["run", "watch", "command", "results"]
    assert all(name in ended.out for name in ("can, ", "dynamixels, ", "modules, ")), "those of installed backends"


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("estopp", "estop"),
        ("modles", "modules"),
        ("run triplet --durration 3", "--duration"),
        ("config triplett", "triplet"),
        ("config triplet --set propulsion_n=2", "controllers.obstacle_triplet.propulsion_n"),
        ("fault kil control", "kill"),
        ("echo sensor/jonts", "sensor/joints"),
    ],
)
def test_a_typo_is_answered_by_what_may_be_meant(typed: str, meant: str, tmp_path: Path) -> None:
    ended = snakesim(*typed.split(), cwd=tmp_path)
    assert ended.code == 2 and ended.err.strip().splitlines()[-1].count(f"did you mean `{meant}`?") == 1, ended.err


@pytest.mark.parametrize(
    ("typed", "way_out"),
    [
        ("run planar13", "it is a robot. Give a scenario, and --set robot=planar13"),
        ("run wave.py", "--controller ./wave.py:CLASS"),
        ("run triplet --duration 3s", "'3s' is not a number; give it without a unit"),
        ("config ./mine.tml", "did you mean mine.toml?"),
        ("console runs/nothing", "no such folder; give the folder that `snakesim run` left"),
        ("run triplet --out ''", "--out: empty; give a value, or leave it out"),
        ("evaluate clutter --controllers=", "--controllers: empty; give a value, or leave it out"),
    ],
)
def test_what_cannot_be_meant_tells_the_way_out(typed: str, way_out: str, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").touch()
    ended = snakesim(*shlex.split(typed), cwd=tmp_path)
    assert ended.code == 2 and way_out in ended.err, ended.err
    assert len(ended.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("typed", "way_out"),
    [
        ("ros2 --domain 233", "'233': give a whole number from 0 to 232"),
        ("ros2 --image-hz nan", "'nan': give a number from 0.1 to 200 Hz"),
        ("console runs/a --at nan", "'nan': give a number from 0 to inf s"),
        ("console --port 65536", "'65536': give a whole number from 0 to 65535"),
        ("record --duration -1", "'-1': give a number from 0 to 1000000000 s"),
        ("replay runs/a --rate 1e-320", "'1e-320': give a number from 0.001 to 1000000"),
        ("evaluate random_field --fields 0", "'0': give a whole number from 1 to 100000"),
        ("sim step inf", "give a whole number of ticks from 1 to 1000000"),
    ],
)
def test_a_number_out_of_bounds_is_told_its_bounds(typed: str, way_out: str, tmp_path: Path) -> None:
    ended = snakesim(*typed.split(), cwd=tmp_path)
    assert ended.code == 2 and way_out in ended.err, ended.err
    assert len(ended.err.splitlines()) == 1


def test_config_tells_where_each_value_came_from(tmp_path: Path) -> None:
    ended = snakesim("config", "triplet", "--seed", "5", "--set", "control.propulsion_n=20", cwd=tmp_path)
    assert ended.code == 0, ended.err
    line = {row.split()[0]: row for row in ended.out.splitlines()}
    assert line["seed"].endswith("--seed 5")
    assert line["controllers.obstacle_triplet.propulsion_n"].endswith("--set control.propulsion_n=20")
    assert line["robot.module.length_m"].endswith("robots/planar13.toml")
    assert line["scene.ground.friction"].endswith("scenes/triplet.toml")
    assert line["stall_limit_s"].endswith("default")


def test_config_tells_the_file_of_a_value_that_extends_another(tmp_path: Path) -> None:
    (tmp_path / "eel.toml").write_text('extends = "planar13"\nname = "eel"\n[module]\nmass_kg = 0.2\n')
    ended = snakesim("config", "triplet", "--set", "robot=./eel.toml", cwd=tmp_path)
    line = {row.split()[0]: row for row in ended.out.splitlines()}
    assert line["robot.module.mass_kg"].endswith("  eel.toml")
    assert line["robot.module.length_m"].endswith("robots/planar13.toml")


def test_scenarios_lists_what_is_shipped(tmp_path: Path) -> None:
    ended = snakesim("scenarios", cwd=tmp_path)
    assert ended.code == 0
    for name in ("triplet", "peg_row", "jam", "planar13", "mamba"):
        assert name in ended.out


def test_echo_without_a_key_lists_the_keys(tmp_path: Path) -> None:
    ended = snakesim("echo", cwd=tmp_path)
    assert ended.code == 0, ended.err
    listed = [line.split()[0] for line in ended.out.splitlines()]
    assert listed == [row.key for row in keys.SPACE if row.kind in ("stream", "latched")]


def test_version(tmp_path: Path) -> None:
    ended = snakesim("--version", cwd=tmp_path)
    assert ended.code == 0 and ended.out == f"snakesim {version('snakesim')}\n"


def test_config_runs_no_code_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text("open('mark', 'w')\nclass Wave: ...\n")
    for flags in (["--controller", "./wave.py:Wave"], ["--backend", "./wave.py:Wave"]):
        ended = snakesim("config", "triplet", *flags, "--set", "controllers.Wave.gain=1", cwd=tmp_path)
        assert ended.code == 0, ended.err
        assert "ers.Wave: not checked" in ended.out or "ends.Wave: not checked" in ended.out
    ended = snakesim("config", "triplet", "--controller", "./wave.py", cwd=tmp_path)
    assert ended.code == 2 and "the classes in it are Wave" in ended.err
    assert not (tmp_path / "mark").exists()
