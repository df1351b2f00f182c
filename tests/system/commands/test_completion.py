"""Tab completion: the printed scripts, asked by a real bash and a real zsh."""

import shutil
from pathlib import Path

import pytest

from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.plugins import CONTROLLERS, list_installed_plugins
from snakesim_testing.harness.command import run_program
from snakesim_testing.runs.in_process_command import snakesim

pytestmark = pytest.mark.e2e

# What a shell does when TAB is pressed behind these words; zsh counts them from 1 where bash counts from 0.
ASKED = 'COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _snakesim; printf "%s\\n" "${COMPREPLY[@]}"'
ASK = {
    "bash": f'source "$1"; shift; {ASKED}',
    "zsh": f'source "$1"; shift; setopt ksharrays; {ASKED}',
}
TYPED: dict[str, tuple[list[str], set[str]]] = {
    "command": (["ru"], {"run"}),
    "all commands": ([""], {"run", "topic", "fault", "drive", "lab", "completion"}),
    "scenario": (["run", ""], set(list_shipped_names("scenarios"))),
    "flag": (["run", "triplet", "--clo"], {"--clock-mode"}),
    "value of a flag": (["run", "triplet", "--clock-mode", "l"], {"lockstep"}),
    "controller": (["run", "--controller", ""], set(list_installed_plugins(CONTROLLERS))),
    "free value": (["run", "--duration", ""], set()),
    "after a free value": (["run", "--duration", "3", "pe"], {"peg_row"}),
    "of an installed package": (
        ["drive", ""],
        {"load", "scan", "replay", "emulate", "dbc", "new", "qualify", "verify"},
    ),
    "driver type": (["drive", "emulate", "o"], {"odrive"}),
    "its argument": (["drive", "load", "can", "pe"], {"peg_row"}),
    "its flag": (["drive", "load", "can", "peg_row", "--jo"], {"--joints"}),
    "key": (["topic", "echo", "sensor/j"], {"sensor/joints"}),
    "kind of a fault": (["fault", "inject", "overh"], {"overheat"}),
    "robot": (
        ["robot", "arm", "pl"],
        {"planar13", "planar13_camera", "planar13_mixed", "planar13_scales", "planar13_wheels"},
    ),
    "shell": (["completion", "z"], {"zsh"}),
    "file": (["start", "router", "./"], set()),  # nothing of ours: the shell completes file names
}


@pytest.fixture(scope="module", params=sorted(ASK))
def script(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    shell = request.param
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    folder = tmp_path_factory.mktemp("completion")
    ended = snakesim("completion", shell, cwd=folder)
    assert ended.code == 0 and ended.err == "", ended.err
    (folder / shell).write_text(ended.out)
    return shell, folder / shell


@pytest.mark.parametrize("typed", TYPED)
def test_what_can_follow(script: tuple[str, Path], typed: str) -> None:
    shell, path = script
    words, wanted = TYPED[typed]
    plain = ["--norc", "--noprofile"] if shell == "bash" else ["-f"]
    done = run_program(
        [shell, *plain, "-c", ASK[shell], shell, path, "snakesim", *words], path.parent
    )
    assert done.code == 0, done.printed
    # Which zsh leaves to its matcher.
    found = {word for word in done.out.split() if word.startswith(words[-1])}
    assert done.err == "" and (found >= wanted if typed == "all commands" else found == wanted), (
        done.out
    )
