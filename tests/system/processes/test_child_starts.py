"""Every place in the source that starts a process, and that no child of ours takes modules from the working folder."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_hal.base.process import make_child_environment, make_python_command

ROOT = Path(__file__).parents[3]
FOLDERS = (
    "snakesim",
    *sorted(path.name for path in ROOT.glob("snakesim_*") if path.name != "snakesim_testing"),
    "benchmarks",
    "deploy",
    "docs",
    "examples",
)
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))

STARTS = {
    *(f"subprocess.{name}" for name in ("Popen", "run", "call", "check_call", "check_output")),
    *(
        f"os.{name}"
        for name in ("fork", "forkpty", "posix_spawn", "posix_spawnp", "system", "popen")
    ),
    *(f"os.exec{how}" for how in ("l", "le", "lp", "lpe", "v", "ve", "vp", "vpe")),
    *(f"os.spawn{how}" for how in ("l", "le", "lp", "lpe", "v", "ve", "vp", "vpe")),
    "pty.fork",
    "pty.spawn",
    "asyncio.create_subprocess_exec",
    "asyncio.create_subprocess_shell",
    "multiprocessing.Process",
    "multiprocessing.Pool",
    "get_context",
    "multiprocessing.get_context",
    "ProcessPoolExecutor",
    "LocalCluster",
}
OTHER_PROGRAMS = {  # that start no Python of ours, or where the file says why
    "benchmarks/checkouts.py": "git",
    "benchmarks/paths/ways.py": "openssl",
    "benchmarks/peers/__main__.py": "rospy, dora and apt, each with an interpreter of its own",
    "deploy/bootstrap.py": "before anything is installed; its environment has the variable",
    "deploy/release.py": "uv, twine and the command of another environment",
    "deploy/vm/kernel.py": "zstd",
    "deploy/vm/machine.py": "qemu",
    "deploy/vm/packages.py": "apt",
    "deploy/vm/with_vcan.py": "the command that the user types",
    "deploy/wheels.py": "the package build, uv and the wheel in another environment",
    "docs/site/build.py": "git",
    "docs/style/check_prose.py": "git and proselint",
    "snakesim_can_backend/bus/bus_faults.py": "ip",
    "snakesim_can_backend/driver/firmware_process.py": "the reference firmware, a program in C",
    "snakesim_can_backend/emulator/reference_firmware.py": "the same program",
    "snakesim_native/compile.py": "the C compiler",
    "snakesim_hal/base/process.py": "the same program again, with its own options",
}
# Copies of a process, which import nothing.
FORKS = {"snakesim_operator/run/processes/guarded_process.py"}


def dotted(node: ast.expr) -> str:
    """A name as it is written: `subprocess.run`; empty for anything else."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def starts_in(path: Path) -> Iterator[tuple[ast.Call, ast.AST]]:
    """Each call that starts a process, with the function or file around it."""
    text = path.read_text(encoding="utf-8")
    if not any(name.rpartition(".")[2] in text for name in STARTS):
        return  # parsing all files takes seconds
    tree = ast.parse(text)
    calls = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and dotted(node.func) in STARTS
    ]
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    for call in calls:
        around = [one for one in functions if one.lineno <= call.lineno <= (one.end_lineno or 0)]
        yield call, around[-1] if around else tree


def is_protected(call: ast.Call, around: ast.AST) -> bool:
    """Whether command line and environment come from the two functions that make them."""
    called = {dotted(node.func) for node in ast.walk(around) if isinstance(node, ast.Call)}
    has_environment = any(keyword.arg == "env" for keyword in call.keywords)
    return has_environment and {"make_python_command", "make_child_environment"} <= called


def test_child_processes_all_start_with_prepared_command_and_environment() -> None:
    found = {path: list(starts_in(path)) for path in FILES}
    assert sum(map(len, found.values())) > 15, "the search finds nothing any more"
    unprotected = {
        f"{path.relative_to(ROOT)}:{call.lineno}"
        for path, calls in found.items()
        if path.relative_to(ROOT).as_posix() not in OTHER_PROGRAMS.keys() | FORKS
        for call, around in calls
        if not is_protected(call, around)
    }
    assert not unprotected, (
        "start it with make_python_command() and make_child_environment(), or add it to the table above"
    )
    listed = OTHER_PROGRAMS.keys() | FORKS
    assert listed <= {
        path.relative_to(ROOT).as_posix() for path, calls in found.items() if calls
    }, "no longer needed"


def test_nothing_else_makes_a_command_line_of_this_interpreter() -> None:
    # Zig, a compiler.
    allowed = {"snakesim_hal/base/process.py", "deploy/bootstrap.py", "snakesim_native/compile.py"}
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        if "sys.executable" not in text or path.relative_to(ROOT).as_posix() in allowed:
            continue
        tree = ast.parse(text)
        sequences = [node for node in ast.walk(tree) if isinstance(node, ast.List | ast.Tuple)]
        assert not [
            node.lineno for node in sequences if "sys.executable" in map(dotted, node.elts)
        ], path


@pytest.mark.parametrize("search_path", ["", os.pathsep])
@pytest.mark.parametrize("words", [("-c",), ("-m", "snakesim_operator")])
def test_a_file_in_the_working_folder_replaces_no_module(
    words: tuple[str, ...], search_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", search_path)
    for name in ("random", "queue", "can", "calendar", "resource"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(77)")
    again = "import subprocess, sys; sys.exit(subprocess.call([sys.executable, '-c', 'import random, calendar']))"
    if words == ("-c",):
        command = make_python_command("-c", f"import random, queue, calendar; {again}")
        variables = make_child_environment()
    else:
        command = [sys.executable, *words, "--version"]  # as a user may type it
        variables = dict(os.environ)
    ended = subprocess.run(
        command, cwd=tmp_path, env=variables, capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 0, ended.stderr
