"""Compiles the C libraries: `python -m snakesim_native.compile`, which `make setup` runs.

It uses the first C compiler that works: `$CC`, else `cc`, `gcc` or `clang`, else the compiler in the package `ziglang`
of the Python package index. Without one it prints what the Python versions cost, and succeeds.

A library is written under a temporary name and renamed, so several processes may compile it at the same time.
"""

import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from dataclasses import dataclass
from pathlib import Path

from snakesim_native.libraries import (
    FLAGS,
    LIBRARIES,
    PACKAGE,
    MujocoFiles,
    NativeLibrary,
    compute_build_key,
    find_mujoco,
    make_file_name,
)

COMPILERS = ("cc", "gcc", "clang")
COMPILE_TIMEOUT_S = 300
SHIPPED_FOLDER = PACKAGE / "compiled"  # in a wheel, and in a repository
NO_COMPILER = "no C compiler was found (install gcc, or `pip install ziglang`)"


class CannotCompileError(Exception):
    """A library cannot be compiled here; the text explains why and what to do."""


@dataclass(frozen=True)
class CompileTarget:
    """What a library is compiled for."""

    machine: str  # as `uname -m` prints it
    libc: str  # "gnu" or "musl", as zig names it; "gnu.2.28" needs no newer version

    @property
    def zig_target_name(self) -> str:
        """Return the target's name for zig, such as "x86_64-linux-gnu"."""
        return f"{self.machine}-linux-{self.libc}"


def get_this_target() -> CompileTarget:
    """Return the target for this computer's Python."""
    host = sysconfig.get_config_var("HOST_GNU_TYPE") or ""
    return CompileTarget(platform.machine(), "musl" if "musl" in host else "gnu")


def list_compilers(target: CompileTarget | None = None) -> list[list[str]]:
    """Return the commands of the C compilers that are installed on this computer, the first choice first.

    Args:
        target: Computer to compile for; None for this computer. Only zig compiles for other computers.
    """
    commands: list[list[str]] = []
    if target is None:
        if os.environ.get("CC"):
            return [shlex.split(os.environ["CC"])]
        commands += [[name] for name in COMPILERS if shutil.which(name)]
    if importlib.util.find_spec("ziglang") is not None:
        zig_target = target or get_this_target()
        # Without a target, zig would use all instructions of this computer's processor.
        commands.append(
            [
                sys.executable,
                "-m",
                "ziglang",
                "cc",
                "-target",
                zig_target.zig_target_name,
                "-mcpu=baseline",
            ]
        )
    return commands


def compile_library(
    library: NativeLibrary,
    folder: Path,
    target: CompileTarget | None = None,
    extra_flags: tuple[str, ...] = (),
) -> Path:
    """Compile a library into a folder, and remove older builds of it from there.

    Args:
        library: The library.
        folder: Folder in which the compiled library is written.
        target: Computer to compile for; None for this computer.
        extra_flags: Further options of the compiler.

    Returns:
        The compiled file.

    Raises:
        CannotCompileError: There is no compiler, no MuJoCo, or no compiler accepts the sources.
    """
    mujoco = find_mujoco()
    if library.uses_mujoco and mujoco is None:
        raise CannotCompileError("MuJoCo is not installed (install the extra [sim])")
    compilers = list_compilers(target)
    if not compilers:
        raise CannotCompileError(NO_COMPILER)
    machine = (target or get_this_target()).machine
    key = compute_build_key(library, mujoco.version if mujoco else "")
    file = folder / make_file_name(library, key, machine)
    problems: list[str] = []
    for compiler in compilers:
        command = [*compiler, *extra_flags]
        problem = _run_compiler(command, library, key, mujoco, file, is_foreign=target is not None)
        if not problem:
            _remove_older_builds(library, machine, file)
            return file
        problems.append(f"{shlex.join(compiler)}: {problem}")
    raise CannotCompileError("; ".join(problems))


def _run_compiler(
    command: list[str],
    library: NativeLibrary,
    key: str,
    mujoco: MujocoFiles | None,
    file: Path,
    *,
    is_foreign: bool,
) -> str:
    """Compile a library with one compiler, and move it to its place when it is complete.

    Args:
        command: Command of the compiler with its options.
        library: The library to compile.
        key: Build key of the library, which is compiled into it.
        mujoco: Files of the installed MuJoCo; None if it is not installed.
        file: Path of the compiled library.
        is_foreign: Whether the library is compiled for another computer than this one.

    Returns:
        What went wrong; an empty text if the library was compiled.
    """
    arguments = [*command, *FLAGS, f'-DSNAKESIM_BUILD_KEY="{key}"']
    arguments += [str(source) for source in library.list_sources()]
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=file.parent, prefix=".") as temporary:
            if library.uses_mujoco and mujoco is not None:
                mujoco_library = mujoco.library
                if is_foreign:
                    mujoco_library = _make_placeholder_library(command, mujoco, Path(temporary))
                arguments += [
                    "-isystem",
                    str(mujoco.include_folder),
                    "-Wl,--no-as-needed",
                    str(mujoco_library),
                ]
            compiled = Path(temporary, file.name)
            problem = run_and_get_error([*arguments, "-lm", "-o", str(compiled)])
            if not problem:
                compiled.replace(file)
            return problem
    except OSError as error:
        return str(error)


def _make_placeholder_library(command: list[str], mujoco: MujocoFiles, folder: Path) -> Path:
    """Compile an empty library with the name of MuJoCo's, and return its file.

    The MuJoCo that is installed here was made for this computer. To link for another one, its name is enough.
    """
    source = folder / "empty.c"
    source.write_text("")
    file = folder / mujoco.library.name
    problem = run_and_get_error(
        [*command, "-shared", f"-Wl,-soname,{file.name}", str(source), "-o", str(file)]
    )
    if problem:
        raise OSError(problem)
    return file


def run_and_get_error(arguments: list[str]) -> str:
    """Run a compiler command, and return the first error that it prints; an empty text if it succeeded."""
    try:
        completed = subprocess.run(
            arguments,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=COMPILE_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired as error:
        return str(error)
    if completed.returncode == 0:
        return ""
    return _find_first_error(completed.stderr) or f"exit code {completed.returncode}"


def _find_first_error(printed: str) -> str:
    """Return the first error that a compiler printed, in one line."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line]
    return next(iter(errors + lines), "")


def _remove_older_builds(library: NativeLibrary, machine: str, newest: Path) -> None:
    """Remove builds of other sources for the same processor. A process that has loaded one keeps it."""
    for file in newest.parent.glob(f"{library.name}-{machine}-*.so"):
        if file != newest:
            file.unlink(missing_ok=True)


def compile_all(folder: Path) -> list[str]:
    """Compile the libraries whose sources have changed.

    Args:
        folder: Folder in which the compiled libraries are written.

    Returns:
        A sentence for each library that cannot be compiled here, with the reason and the consequence.
    """
    warnings: list[str] = []
    mujoco = find_mujoco()
    for library in LIBRARIES:
        key = compute_build_key(library, mujoco.version if mujoco else "")
        if (folder / make_file_name(library, key)).is_file():
            continue
        try:
            compile_library(library, folder)
        except CannotCompileError as error:
            warnings.append(
                f"without the C library `{library.name}` {library.python_cost}: {error}"
            )
    return warnings


def main() -> int:
    """Compile all libraries into this package, and return the exit code, which is 0 even without a compiler."""
    for warning in compile_all(SHIPPED_FOLDER):
        print(f"setup: {warning}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
