"""The programs in C that are compiled when they are first needed: the reference firmware of a joint module.

`joint_modules`         emulates the modules of a robot, on a local bus
`joint_module_replay`   runs the firmware of one module on events from its standard input

Both contain the same firmware, without change: `joint_module/firmware`. A program is compiled once for its sources and
flags, into this package, or into the user's cache if the package is read-only.
"""

import hashlib
import platform
import tempfile
from dataclasses import dataclass
from pathlib import Path

from snakesim_native.compile import (
    NO_COMPILER,
    SHIPPED_FOLDER,
    CannotCompileError,
    list_compilers,
    run_and_get_error,
)
from snakesim_native.libraries import KEY_LENGTH, PACKAGE
from snakesim_native.load import choose_writable_folder

# The firmware is C99 without extensions, so that every compiler for microcontrollers accepts it.
STRICT_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion")
# The emulation of a robot uses pipes and clocks of POSIX.
POSIX_FLAGS = ("-D_POSIX_C_SOURCE=200809L",)
SANITIZER_FLAGS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")


@dataclass(frozen=True, kw_only=True)
class NativeProgram:
    """One program: all C files of some folders of `joint_module`."""

    name: str
    folders: tuple[str, ...]

    def list_sources(self) -> list[Path]:
        """Return the C files, by folder and name."""
        return self._list_files("*.c")

    def list_headers(self) -> list[Path]:
        """Return the header files, by folder and name."""
        return self._list_files("*.h")

    def _list_files(self, pattern: str) -> list[Path]:
        root = PACKAGE / "joint_module"
        return [file for folder in self.folders for file in sorted((root / folder).glob(pattern))]


JOINT_MODULES = NativeProgram(name="joint_modules", folders=("firmware", "host"))
JOINT_MODULE_REPLAY = NativeProgram(name="joint_module_replay", folders=("firmware", "replay"))


def get_program(program: NativeProgram, extra_flags: tuple[str, ...] = ()) -> Path:
    """Return the file of a program, which is compiled first if there is none of the current sources.

    Args:
        program: The program.
        extra_flags: Further options of the compiler, such as SANITIZER_FLAGS.

    Raises:
        CannotCompileError: There is no compiler, or none accepts the sources with these options.
    """
    flags = (*STRICT_FLAGS, *POSIX_FLAGS, *extra_flags)
    name = f"{program.name}-{platform.machine()}-{_compute_key(program, flags)}"
    folder = choose_writable_folder()
    for file in (SHIPPED_FOLDER / name, folder / name):
        if file.is_file():
            return file
    _compile_program(program, flags, folder / name)
    return folder / name


def _compute_key(program: NativeProgram, flags: tuple[str, ...]) -> str:
    """Return a hash of everything that decides what a program does: sources and flags."""
    digest = hashlib.sha256(" ".join(flags).encode())
    for file in (*program.list_sources(), *program.list_headers()):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:KEY_LENGTH]


def _compile_program(program: NativeProgram, flags: tuple[str, ...], file: Path) -> None:
    """Compile a program with the first compiler that accepts it, and move it to its place when it is complete."""
    problems: list[str] = []
    file.parent.mkdir(parents=True, exist_ok=True)
    sources = [str(source) for source in program.list_sources()]
    for compiler in list_compilers():
        with tempfile.TemporaryDirectory(dir=file.parent, prefix=".") as temporary:
            compiled = Path(temporary, file.name)
            problem = run_and_get_error([*compiler, *flags, *sources, "-lm", "-o", str(compiled)])
            if not problem:
                compiled.replace(file)
                return
        problems.append(f"{compiler[0]}: {problem}")
    raise CannotCompileError("; ".join(problems) or NO_COMPILER)
