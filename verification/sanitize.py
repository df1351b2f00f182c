"""Runs the tests of physics and planner with C libraries that check themselves: `python -m verification.sanitize`.

The address sanitizer ends the program at a read or write outside of what belongs to it. The sanitizer of undefined
behavior ends it at an integer that overflows or a pointer that is not aligned. MuJoCo's arrays lie in one block of
memory, so a step from one of them into the next is not detected here.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from snakesim_hal.base.process import make_child_environment
from snakesim_native.compile import CannotCompileError, compile_library, list_compilers
from snakesim_native.libraries import LIBRARIES
from snakesim_native.load import SWITCH_VARIABLE

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "build" / "sanitized"
# MuJoCo's headers would replace functions by others that only a MuJoCo with sanitizers has, if they saw this macro.
SANITIZERS = (
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
    "-g",
    "-U__SANITIZE_ADDRESS__",
)
TESTS = (
    "tests/unit/sim_backend",
    "tests/unit/gnc/test_native_growth.py",
    "tests/system/physics",
    "tests/system/native",
)
LIBRARIES_TO_PRELOAD = ("libasan.so", "libubsan.so")


def main() -> int:
    """Compile, and run the tests. Returns the exit code of pytest, or 1 without a compiler that has sanitizers."""
    parser = argparse.ArgumentParser(description="Run the physics tests with sanitizers.")
    parser.add_argument("tests", nargs="*", default=TESTS, help="files or folders of tests")
    arguments = parser.parse_args()
    try:
        for library in LIBRARIES:
            compile_library(library, FOLDER, extra_flags=SANITIZERS)
    except CannotCompileError as error:
        print(f"sanitize: {error}")
        return 1
    environment = {
        SWITCH_VARIABLE: str(FOLDER),
        "LD_PRELOAD": " ".join(find_sanitizers()),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python frees little at its end
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "--timeout",
        "1200",
        "-p",
        "no:cacheprovider",
        *arguments.tests,
    ]
    return subprocess.call(command, cwd=ROOT, env=make_child_environment(environment))


def find_sanitizers() -> list[str]:
    """Return the sanitizers' own libraries, which must be loaded before everything else."""
    compiler = list_compilers()[0]
    files: list[str] = []
    for name in LIBRARIES_TO_PRELOAD:
        printed = subprocess.check_output([*compiler, f"-print-file-name={name}"], text=True)
        files.append(printed.strip())
    return files


if __name__ == "__main__":
    sys.exit(main())
