"""Run the tests of physics and planner with sanitized C libraries: `python -m verification.sanitize`.

The address sanitizer ends the program at a read or write outside of allocated memory. The sanitizer of undefined
behavior ends it at an integer overflow or at a pointer that is not aligned. MuJoCo's arrays lie in one block of
memory, so an access beyond the end of one array into the next is not detected.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from snakesim_hal.base.process import make_child_environment
from snakesim_native.compile import CannotCompileError, compile_library, list_compilers
from snakesim_native.libraries import LIBRARIES
from snakesim_native.load import SWITCH_VARIABLE
from verification import TESTS_OF_A_CHANGE

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "build" / "sanitized"
# With this macro, MuJoCo's headers would use functions that only a MuJoCo with sanitizers has.
SANITIZERS = (
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
    "-g",
    "-U__SANITIZE_ADDRESS__",
)
TESTS = (
    "tests/unit/sim_backend",
    "tests/unit/gnc/navigation/path_search/test_native_growth.py",
    "tests/system/physics",
    "tests/system/native",
)
LIBRARIES_TO_PRELOAD = ("libasan.so", "libubsan.so")


def main() -> int:
    """Compile the libraries, and run the tests.

    Returns:
        The exit code of pytest, or 1 if no compiler has sanitizers.
    """
    parser = argparse.ArgumentParser(prog="python -m verification.sanitize", description=__doc__)
    parser.add_argument(
        "tests", nargs="*", default=TESTS, help="files or folders of tests (physics and planner)"
    )
    arguments = parser.parse_args()
    try:
        for library in LIBRARIES:
            compile_library(library, FOLDER, extra_flags=SANITIZERS)
    except CannotCompileError as error:
        print(f"sanitize: {error}")
        return 1
    environment = {
        SWITCH_VARIABLE: str(FOLDER),
        "LD_PRELOAD": " ".join(find_sanitizer_libraries()),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python does not free all memory when it ends
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
        *TESTS_OF_A_CHANGE,
        *arguments.tests,
    ]
    return subprocess.call(command, cwd=ROOT, env=make_child_environment(environment))


def find_sanitizer_libraries() -> list[str]:
    """Return the paths of the sanitizers' own libraries, which must be loaded before all others."""
    compiler = list_compilers()[0]
    paths: list[str] = []
    for name in LIBRARIES_TO_PRELOAD:
        path = subprocess.check_output([*compiler, f"-print-file-name={name}"], text=True)
        paths.append(path.strip())
    return paths


if __name__ == "__main__":
    sys.exit(main())
