"""Wrong files and flags: one clear error, exit code 2, nothing started, nothing left."""

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
WRONG: dict[str, list[str]] = {
    **{name: [*RUN, "triplet", "--set", flag] for name, flag in TABLE["set"].items()},
    **{name: [*RUN, *typed.split()] for name, typed in TABLE["arguments"].items()},
    **{name: shlex.split(typed) for name, typed in TABLE["commands"].items()},
    "50,000 parts": [*RUN, "triplet", "--set", ".".join("a" * 50_000) + "=1"],
}
HAS_A_LIST = ("too much for the bus", "typo: key")  # in its answer: a line a sum, and a line a key


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    """Return what is in a folder, without the bytecode of a controller file that was read."""
    return {path for path in folder.iterdir() if path.name != "__pycache__"}


@pytest.mark.parametrize("wrong", WRONG)
def test_one_clear_error_and_nothing_started(
    folder: Path, wrong: str, messages: StoredMessages
) -> None:
    before = list_files(folder)
    ended = snakesim(*WRONG[wrong], cwd=folder)
    assert ended.code == 2, ended.out + ended.err
    assert ended.out == ""
    assert ended.err.startswith("snakesim")
    assert "Traceback" not in ended.err
    assert ended.err.count("\n") == 1 or wrong in HAS_A_LIST, ended.err
    messages.check(ended.err.rstrip("\n"))
    assert list_files(folder) == before
