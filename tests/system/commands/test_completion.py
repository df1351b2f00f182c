"""A real bash and a real zsh complete `snakesim` commands with the printed scripts."""

import shutil
from pathlib import Path

import pytest

from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.plugins import CONTROLLERS, list_installed_plugins
from snakesim_testing.harness.command import run_program
from snakesim_testing.runs.in_process_command import snakesim

pytestmark = pytest.mark.e2e

# Completes the last word as a shell does when Tab is pressed, and prints the candidates. zsh counts words from 1.
PRINT_CANDIDATES = (
    'COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _snakesim; printf "%s\\n" "${COMPREPLY[@]}"'
)
SHELL_PROGRAMS = {
    "bash": f'source "$1"; shift; {PRINT_CANDIDATES}',
    "zsh": f'source "$1"; shift; setopt ksharrays; {PRINT_CANDIDATES}',
}
CASES: dict[str, tuple[list[str], set[str]]] = {  # typed words, and the expected candidates
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
    "file": (["start", "router", "./"], set()),  # The shell itself completes file names.
}


@pytest.fixture(scope="module", params=sorted(SHELL_PROGRAMS))
def script(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    """Write the completion script of a shell, and return the name of the shell and the path."""
    shell = request.param
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    folder = tmp_path_factory.mktemp("completion")
    completed = snakesim("completion", shell, cwd=folder)
    assert completed.code == 0, completed.err
    assert completed.err == ""
    (folder / shell).write_text(completed.out)
    return shell, folder / shell


@pytest.mark.parametrize("case", CASES)
def test_completion_of_typed_words_gives_expected_candidates(
    script: tuple[str, Path], case: str
) -> None:
    shell, path = script
    words, expected = CASES[case]
    options = ["--norc", "--noprofile"] if shell == "bash" else ["-f"]
    completed = run_program(
        [shell, *options, "-c", SHELL_PROGRAMS[shell], shell, path, "snakesim", *words], path.parent
    )
    assert completed.code == 0, completed.printed
    # The script for zsh prints all candidates, which zsh itself compares with the typed word.
    candidates = {word for word in completed.out.split() if word.startswith(words[-1])}
    assert completed.err == ""
    if case == "all commands":
        assert candidates >= expected, completed.out
    else:
        assert candidates == expected, completed.out
