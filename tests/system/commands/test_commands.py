"""Commands that need no robot print help, configuration, scenarios, keys, and version."""

from importlib.metadata import version
from pathlib import Path

from snakesim_hal.wire import keys
from snakesim_testing.runs.in_process_command import snakesim


def test_command_without_arguments_prints_help_by_task(tmp_path: Path) -> None:
    completed = snakesim(cwd=tmp_path)
    assert completed.code == 0
    assert completed.out == snakesim("--help", cwd=tmp_path).out
    headings = [
        line.rstrip(":")
        for line in completed.out.splitlines()
        if line.endswith(":") and not line.startswith(" ")
    ]
    assert headings == ["daily work", "robot", "runs and studies", "files and computers"]
    assert all(f"  {name} " in completed.out for name in ("drive", "policy", "lab")), (
        "the commands of installed packages are missing"
    )


def test_config_names_the_origin_of_each_value(tmp_path: Path) -> None:
    """A robot file that extends another is an origin, too."""
    (tmp_path / "eel.toml").write_text(
        'extends = "planar13"\nname = "eel"\n[module]\nmass_kg = 0.2\n'
    )
    options = ("--seed", "5", "--set", "control.propulsion_n=20", "--set", "robot=./eel.toml")
    completed = snakesim("config", "triplet", *options, cwd=tmp_path)
    assert completed.code == 0, completed.err
    lines_by_key = {line.split()[0]: line for line in completed.out.splitlines()}
    assert lines_by_key["seed"].endswith("--seed 5")
    assert lines_by_key["controllers.obstacle_triplet.propulsion_n"].endswith(
        "--set control.propulsion_n=20"
    )
    assert lines_by_key["robot.module.mass_kg"].endswith("  eel.toml")
    assert lines_by_key["robot.module.length_m"].endswith("robots/planar13.toml")
    assert lines_by_key["scene.ground.friction"].endswith("scenes/triplet.toml")
    assert lines_by_key["stall_limit_s"].endswith("default")


def test_scenario_list_names_shipped_scenarios_and_robots(tmp_path: Path) -> None:
    completed = snakesim("scenario", "list", cwd=tmp_path)
    assert completed.code == 0
    for name in ("triplet", "peg_row", "jam", "planar13", "mamba"):
        assert name in completed.out


def test_topic_list_names_all_keys_in_order(tmp_path: Path) -> None:
    completed = snakesim("topic", "list", cwd=tmp_path)
    assert completed.code == 0, completed.err
    listed = [line.split()[0] for line in completed.out.splitlines()]
    assert listed == [row.key for row in keys.SPACE if row.kind in ("stream", "latched")]


def test_version_option_prints_installed_version(tmp_path: Path) -> None:
    completed = snakesim("--version", cwd=tmp_path)
    assert completed.code == 0
    assert completed.out == f"snakesim {version('snakesim')}\n"


def test_config_with_controller_file_runs_none_of_its_code(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text("open('mark', 'w')\nclass Wave: ...\n")
    for flags in (["--controller", "./wave.py:Wave"], ["--backend", "./wave.py:Wave"]):
        completed = snakesim(
            "config", "triplet", *flags, "--set", "controllers.Wave.gain=1", cwd=tmp_path
        )
        assert completed.code == 0, completed.err
        assert "ers.Wave: not checked" in completed.out or "ends.Wave: not checked" in completed.out
    completed = snakesim("config", "triplet", "--controller", "./wave.py", cwd=tmp_path)
    assert completed.code == 2
    assert "the classes in it are Wave" in completed.err
    assert not (tmp_path / "mark").exists()
