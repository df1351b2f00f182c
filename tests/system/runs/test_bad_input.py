"""Invalid files and options cause one clear error and exit code 2; no process starts, and no file remains."""

import os
import shlex
import tomllib
from pathlib import Path

import pytest

from snakesim_testing.messages import StoredMessages
from snakesim_testing.runs.in_process_command import snakesim

ROBOT = Path("snakesim_hal/shipped/robots/planar13.toml").resolve()
SCENE = Path("snakesim_hal/shipped/scenes/triplet.toml").resolve()
SCENARIO = Path("snakesim_hal/shipped/scenarios/triplet.toml").resolve()

TABLE = tomllib.loads(Path(__file__).with_name("refusals.toml").read_text())
RUN = ("run", "--out", "run")
INVALID_COMMANDS: dict[str, list[str]] = {
    **{name: [*RUN, "triplet", "--set", option] for name, option in TABLE["set"].items()},
    **{name: [*RUN, *arguments.split()] for name, arguments in TABLE["arguments"].items()},
    **{name: shlex.split(command) for name, command in TABLE["commands"].items()},
    "50,000 parts": [*RUN, "triplet", "--set", ".".join("a" * 50_000) + "=1"],
}
# The errors of these cases have several lines: one for each part of a sum, or for each valid key.
CASES_WITH_A_LIST = ("too much for the bus", "typo: key")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide a folder with the invalid files that the commands name."""
    tmp_path = tmp_path_factory.mktemp("wrong")
    scenario = SCENARIO.read_text()
    (tmp_path / "broken.toml").write_text("robot = \n")
    (tmp_path / "missing.toml").write_text(
        scenario.replace('controller = "obstacle_triplet"\n', "")
    )
    (tmp_path / "my_robot.toml").write_text(
        ROBOT.read_text().replace("mass_kg = 0.3", 'mass_kg = "heavy"')
    )
    (tmp_path / "bad_robot.toml").write_text(scenario.replace('"planar13"', '"my_robot.toml"'))
    (tmp_path / "my_scene.toml").write_text(
        SCENE.read_text().replace("friction = 0.1", "friction = 99.0")
    )
    (tmp_path / "bad_scene.toml").write_text(
        scenario.replace('scene = "triplet"', 'scene = "my_scene.toml"')
    )
    (tmp_path / "wave.py").write_text("class Wave: ...\n")
    for name in ("pipe.py", "pipe.toml"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "endless.toml").symlink_to("/dev/zero")
    (tmp_path / "deep.json").write_text('{"a":' * 100_000)
    (tmp_path / "utf16.toml").write_text(scenario, encoding="utf-16")
    (tmp_path / "steering.toml").write_text(f'"\\u001b[2J\\u202e" = 1\n{scenario}')
    pegs = "".join(
        f"[[cylinder]]\nposition_m = [{9 + i % 900}, 9]\nradius_m = 0.1\n" for i in range(20_000)
    )
    (tmp_path / "crowd.toml").write_text(f"name = 'crowd'\n[ground]\nfriction = 0.1\n{pegs}")
    (tmp_path / "crowded.toml").write_text(
        scenario.replace('scene = "triplet"', 'scene = "crowd.toml"').replace(
            "tail_s_m = 0.0", "on_route = false"
        )
    )
    return tmp_path


def list_files(folder: Path) -> set[Path]:
    """Return the files in a folder, except the bytecode of a controller file that was read."""
    return {path for path in folder.iterdir() if path.name != "__pycache__"}


@pytest.mark.parametrize("case", INVALID_COMMANDS)
def test_command_with_invalid_input_prints_one_error_and_starts_nothing(
    folder: Path, case: str, messages: StoredMessages
) -> None:
    files_before = list_files(folder)
    result = snakesim(*INVALID_COMMANDS[case], cwd=folder)
    assert result.code == 2, result.out + result.err
    assert result.out == ""
    assert result.err.startswith("snakesim")
    assert "Traceback" not in result.err
    assert result.err.count("\n") == 1 or case in CASES_WITH_A_LIST, result.err
    messages.check(result.err.rstrip("\n"))
    assert list_files(folder) == files_before
