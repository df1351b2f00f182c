"""Builds wheels with compiled libraries, and checks them: `make wheels` and `make release` call it.

One wheel for each kind of processor, into `build/wheels/`. The compiler is zig, from the package index with the hash in
`deploy/wheels.lock`, because it compiles for every processor and for old versions of the C library on any computer. The
libraries fit the version of MuJoCo in the lock. With another version SnakeSIM compiles its sources, or uses Python.
"""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "wheels"
ZIG = ROOT / "build" / "zig"
UV = ROOT / ".tools" / "bin" / "uv"
PYTHON = ROOT / ".venv" / "bin" / "python"
LOCK = ROOT / "deploy" / "wheels.lock"

OLDEST_GLIBC = (2, 28)  # as MuJoCo's own wheels need
COMPILED_FOR_WHEEL = "SNAKESIM_COMPILED"  # read by setup.py


@dataclass(frozen=True)
class Processor:
    """A kind of processor that a wheel is built for."""

    machine: str  # as `uname -m` prints it
    elf_number: int  # e_machine in the header of an ELF file

    @property
    def platform(self) -> str:
        """Return the wheel's platform tag."""
        return f"manylinux_{OLDEST_GLIBC[0]}_{OLDEST_GLIBC[1]}_{self.machine}"


PROCESSORS = (Processor("x86_64", 62), Processor("aarch64", 183))


def main() -> int:
    """Build and check the wheels. Returns the exit code."""
    for wheel in build_wheels(OUT):
        print(f"wheels: {wheel.relative_to(ROOT)}  {wheel.stat().st_size / 1e6:.1f} MB")
    return 0


def build_wheels(folder: Path) -> list[Path]:
    """Build a wheel for each kind of processor into an empty folder, and check its libraries."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    install_zig()
    wheels: list[Path] = []
    for processor in PROCESSORS:
        compiled = ROOT / "build" / "compiled" / processor.machine
        compile_libraries(processor, compiled)
        wheel = build_wheel(processor, compiled, folder)
        check_wheel(wheel, processor)
        wheels.append(wheel)
    return wheels


def install_zig() -> None:
    """Install the locked zig into a folder of its own."""
    run(UV, "pip", "install", "--quiet", "--require-hashes", "--target", ZIG, "--requirement", LOCK)


def compile_libraries(processor: Processor, folder: Path) -> None:
    """Compile all libraries for a kind of processor into an empty folder."""
    sys.path[:0] = [str(ROOT), str(ZIG)]
    # Here, because the folders above must be searched first.
    from snakesim_native.compile import CompileTarget, compile_library
    from snakesim_native.libraries import LIBRARIES

    os.environ["PYTHONPATH"] = str(ZIG)  # for the compiler's process
    shutil.rmtree(folder, ignore_errors=True)
    target = CompileTarget(processor.machine, f"gnu.{OLDEST_GLIBC[0]}.{OLDEST_GLIBC[1]}")
    for library in LIBRARIES:
        compile_library(library, folder, target, extra_flags=("-s",))
    del os.environ["PYTHONPATH"]


def build_wheel(processor: Processor, compiled: Path, folder: Path) -> Path:
    """Build the wheel with these compiled libraries."""
    option = f"--config-setting=--build-option=--plat-name={processor.platform}"
    # Setuptools would add what an earlier build left there.
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)
    run(
        *(UV, "build", "--quiet", "--wheel", "--no-build-isolation", "--python", PYTHON),
        *(option, "--out-dir", folder, ROOT),
        environment={COMPILED_FOR_WHEEL: str(compiled)},
    )
    wheels = list(folder.glob(f"snakesim-*-py3-none-{processor.platform}.whl"))
    if len(wheels) != 1:
        sys.exit(f"wheels: expected one wheel for {processor.platform} in {folder}")
    return wheels[0]


def check_wheel(wheel: Path, processor: Processor) -> None:
    """Exit if a library in the wheel is for another processor, or needs a newer C library than its tag states."""
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if name.endswith(".so")]
        if not names:
            sys.exit(f"wheels: {wheel.name} has no compiled library")
        for name in names:
            content = archive.read(name)
            elf_number = int.from_bytes(content[18:20], "little")
            if not content.startswith(b"\x7fELF") or elf_number != processor.elf_number:
                sys.exit(f"wheels: {name} in {wheel.name} is not for {processor.machine}")
            versions = [
                (int(major), int(minor))
                for major, minor in re.findall(rb"GLIBC_(\d+)\.(\d+)", content)
            ]
            if max(versions, default=OLDEST_GLIBC) > OLDEST_GLIBC:
                sys.exit(f"wheels: {name} in {wheel.name} needs glibc {max(versions)}")


def run(*command: object, environment: dict[str, str] | None = None) -> None:
    """Run a program. Exits with its messages if it fails."""
    words = [str(word) for word in command]
    finished = subprocess.run(
        words,
        cwd=ROOT,
        env=dict(os.environ, **(environment or {})),
        capture_output=True,
        text=True,
        check=False,
    )
    if finished.returncode != 0:
        sys.exit(f"wheels: failed: {' '.join(words)}\n{finished.stdout}{finished.stderr}")


if __name__ == "__main__":
    sys.exit(main())
