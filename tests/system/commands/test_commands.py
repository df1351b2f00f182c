"""Commands that need no robot: help, config, scenarios, echo's list of keys, version. Typos are in refusals.toml."""

from importlib.metadata import version
from pathlib import Path

from snakesim_hal.wire import keys
from snakesim_testing.runs.in_process_command import snakesim


def test_the_command_alone_lists_all_by_task(tmp_path: Path) -> None:
    ended = snakesim(cwd=tmp_path)
    assert ended.code == 0
    assert ended.out == snakesim("--help", cwd=tmp_path).out
    tasks = [
        line.rstrip(":")
        for line in ended.out.splitlines()
        if line.endswith(":") and not line.startswith(" ")
    ]
    assert tasks == ["daily work", "robot", "runs and studies", "files and computers"]
    assert all(f"  {name} " in ended.out for name in ("drive", "policy", "lab")), (
        "those of installed packages"
    )


def test_config_tells_where_each_value_came_from(tmp_path: Path) -> None:
    """Also from a file that extends another."""
    (tmp_path / "eel.toml").write_text(
        'extends = "planar13"\nname = "eel"\n[module]\nmass_kg = 0.2\n'
    )
    given = ("--seed", "5", "--set", "control.propulsion_n=20", "--set", "robot=./eel.toml")
    ended = snakesim("config", "triplet", *given, cwd=tmp_path)
    assert ended.code == 0, ended.err
    line = {row.split()[0]: row for row in ended.out.splitlines()}
    assert line["seed"].endswith("--seed 5")
    assert line["controllers.obstacle_triplet.propulsion_n"].endswith(
        "--set control.propulsion_n=20"
    )
    assert line["robot.module.mass_kg"].endswith("  eel.toml")
    assert line["robot.module.length_m"].endswith("robots/planar13.toml")
    assert line["scene.ground.friction"].endswith("scenes/triplet.toml")
    assert line["stall_limit_s"].endswith("default")


def test_scenarios_lists_what_is_shipped(tmp_path: Path) -> None:
    ended = snakesim("scenario", "list", cwd=tmp_path)
    assert ended.code == 0
    for name in ("triplet", "peg_row", "jam", "planar13", "mamba"):
        assert name in ended.out


def test_echo_without_a_key_lists_the_keys(tmp_path: Path) -> None:
    ended = snakesim("topic", "list", cwd=tmp_path)
    assert ended.code == 0, ended.err
    listed = [line.split()[0] for line in ended.out.splitlines()]
    assert listed == [row.key for row in keys.SPACE if row.kind in ("stream", "latched")]


def test_version(tmp_path: Path) -> None:
    ended = snakesim("--version", cwd=tmp_path)
    assert ended.code == 0
    assert ended.out == f"snakesim {version('snakesim')}\n"


def test_config_runs_no_code_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text("open('mark', 'w')\nclass Wave: ...\n")
    for flags in (["--controller", "./wave.py:Wave"], ["--backend", "./wave.py:Wave"]):
        ended = snakesim(
            "config", "triplet", *flags, "--set", "controllers.Wave.gain=1", cwd=tmp_path
        )
        assert ended.code == 0, ended.err
        assert "ers.Wave: not checked" in ended.out or "ends.Wave: not checked" in ended.out
    ended = snakesim("config", "triplet", "--controller", "./wave.py", cwd=tmp_path)
    assert ended.code == 2
    assert "the classes in it are Wave" in ended.err
    assert not (tmp_path / "mark").exists()
