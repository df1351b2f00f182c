"""The source code starts every process in a safe way, so that no child imports modules from the working folder."""

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

START_FUNCTIONS = {
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
# Files that start programs without our Python code, or that explain why their start is safe.
OTHER_PROGRAMS = {
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
# Files that fork a process, which imports nothing.
FORKS = {"snakesim_operator/run/processes/guarded_process.py"}


def get_dotted_name(node: ast.expr) -> str:
    """Return a name as it is written, such as `subprocess.run`, or an empty text for any other expression."""
    if isinstance(node, ast.Attribute):
        return f"{get_dotted_name(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def find_process_starts(path: Path) -> Iterator[tuple[ast.Call, ast.AST]]:
    """Yield each call that starts a process, with the function or file that contains it."""
    text = path.read_text(encoding="utf-8")
    if not any(name.rpartition(".")[2] in text for name in START_FUNCTIONS):
        return  # the file is not parsed, because parsing all files takes seconds
    tree = ast.parse(text)
    calls = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and get_dotted_name(node.func) in START_FUNCTIONS
    ]
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    for call in calls:
        containing = [
            function
            for function in functions
            if function.lineno <= call.lineno <= (function.end_lineno or 0)
        ]
        yield call, containing[-1] if containing else tree


def is_safe_start(call: ast.Call, container: ast.AST) -> bool:
    """Return whether command line and environment come from the two functions that make them."""
    called = {
        get_dotted_name(node.func) for node in ast.walk(container) if isinstance(node, ast.Call)
    }
    has_environment = any(keyword.arg == "env" for keyword in call.keywords)
    return has_environment and {"make_python_command", "make_child_environment"} <= called


@pytest.mark.heavy
def test_child_processes_start_with_prepared_command_and_environment() -> None:
    starts_by_file = {
        path.relative_to(ROOT).as_posix(): list(find_process_starts(path)) for path in FILES
    }
    assert sum(map(len, starts_by_file.values())) > 15, "the search finds nothing any more"
    exceptions = OTHER_PROGRAMS.keys() | FORKS
    unsafe_starts = {
        f"{file}:{call.lineno}"
        for file, starts in starts_by_file.items()
        if file not in exceptions
        for call, container in starts
        if not is_safe_start(call, container)
    }
    assert not unsafe_starts, (
        "use make_python_command() and make_child_environment(), or add the file to the table above"
    )
    files_with_starts = {file for file, starts in starts_by_file.items() if starts}
    assert exceptions <= files_with_starts, "the table above names a file that starts no process"


def test_command_lines_of_this_interpreter_are_made_in_one_place() -> None:
    # The command of the C compiler Zig also starts with this interpreter.
    allowed = {"snakesim_hal/base/process.py", "deploy/bootstrap.py", "snakesim_native/compile.py"}
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        if "sys.executable" not in text or path.relative_to(ROOT).as_posix() in allowed:
            continue
        tree = ast.parse(text)
        sequences = [node for node in ast.walk(tree) if isinstance(node, ast.List | ast.Tuple)]
        command_line_numbers = [
            node.lineno for node in sequences if "sys.executable" in map(get_dotted_name, node.elts)
        ]
        assert not command_line_numbers, path


@pytest.mark.parametrize("search_path", ["", os.pathsep])
@pytest.mark.parametrize("arguments", [("-c",), ("-m", "snakesim_operator")])
def test_child_process_imports_no_module_from_working_folder(
    arguments: tuple[str, ...], search_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", search_path)
    for name in ("random", "queue", "can", "calendar", "resource"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(77)")
    start_grandchild = (
        "import subprocess, sys; "
        "sys.exit(subprocess.call([sys.executable, '-c', 'import random, calendar']))"
    )
    if arguments == ("-c",):
        code = f"import random, queue, calendar; {start_grandchild}"
        command = make_python_command("-c", code)
        environment = make_child_environment()
    else:
        command = [sys.executable, *arguments, "--version"]  # as a user may type it
        environment = dict(os.environ)
    result = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 0, result.stderr
