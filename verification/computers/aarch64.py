"""Runs the wheel for ARM on this computer: `python -m verification.computers.aarch64`.

It runs, under the emulator of QEMU for single programs, the tests that compare the C libraries with their Python
versions, and then the same scenario with the C libraries and without them: both must have the same digest.

The emulated Python and its libraries are packages of Debian for arm64. They are downloaded and unpacked into
`build/aarch64`, and not installed. The wheels of other projects come from the package index.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from snakesim_native.load import SWITCH_VARIABLE

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "aarch64"
SYSTEM = FOLDER / "system"  # Debian's files
SITE = FOLDER / "site"  # Python packages
PYTHON = FOLDER / "python"  # a script that runs the emulated Python
UV = ROOT / ".tools" / "bin" / "uv"
EMULATOR = "qemu-aarch64-static"
TESTS = ("tests/unit/sim_backend/test_laws.py", "tests/unit/gnc/test_native_growth.py")
SCENARIO = "peg_row"
SECONDS = "0.3"  # of robot time; the emulator is slow
LONGEST_S = 1800
# A program of the emulated computer cannot be started directly, only through the script.
SITE_CUSTOMIZATION = f"import sys\nsys.executable = {str(PYTHON)!r}\n"


class MissingToolError(Exception):
    """Something that this computer lacks; the text explains what to do."""


def main() -> int:
    """Prepare the emulated computer, and run the tests and both runs. Returns the exit code."""
    try:
        unpack_system()
        install_packages(build_wheel())
    except MissingToolError as error:
        print(f"aarch64: {error}")
        return 2
    tests = run_emulated(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow", *TESTS
    )
    if tests.returncode:
        return 1
    with_library, without_library = run_scenario("on"), run_scenario("off")
    print(f"{SCENARIO}: digest {with_library} with the C libraries, {without_library} without")
    return 0 if with_library == without_library else 1


def build_wheel() -> Path:
    """Build the wheels of this repository, as `make wheels` does. Returns the one for ARM."""
    run(sys.executable, ROOT / "deploy" / "wheels.py")
    (wheel,) = (ROOT / "build" / "wheels").glob("*_aarch64.whl")
    return wheel


def unpack_system() -> None:
    """Download Debian's Python for arm64 with all that it needs, and unpack it.

    apt gets folders of its own, so the lists and the architecture of this computer stay as they are.
    """
    for tool in ("apt-get", "dpkg-deb", EMULATOR):
        if shutil.which(tool) is None:
            raise MissingToolError(f"{tool} is missing. Run: sudo apt-get install qemu-user-static")
    shutil.rmtree(FOLDER, ignore_errors=True)
    state, cache = FOLDER / "apt" / "state", FOLDER / "apt" / "cache"
    for folder in (state / "lists" / "partial", cache / "archives" / "partial", SYSTEM, SITE):
        folder.mkdir(parents=True)
    (state / "status").touch()
    apt = [
        "apt-get",
        "--quiet",
        "--yes",
        "--no-install-recommends",
        *make_apt_options(
            {
                "APT::Architecture": "arm64",
                "APT::Architectures": "arm64",
                "APT::Sandbox::User": "root",
                "Debug::NoLocking": "1",
                "Dir::State": str(state),
                "Dir::State::status": str(state / "status"),
                "Dir::Cache": str(cache),
            }
        ),
    ]
    run(*apt, "update")
    run(*apt, "--download-only", "install", "python3", "libgcc-s1", "libstdc++6", "libgomp1")
    for package in sorted((cache / "archives").glob("*.deb")):
        run("dpkg-deb", "--extract", package, SYSTEM)
    if not (SYSTEM / "lib").exists():  # since Debian 13, everything is below usr
        (SYSTEM / "lib").symlink_to("usr/lib")


def make_apt_options(values: dict[str, str]) -> Iterator[str]:
    """Return the options that set these values of apt's configuration."""
    for name, value in values.items():
        yield "-o"
        yield f"{name}={value}"


def install_packages(wheel: Path) -> None:
    """Install a wheel, the packages of its extra [sim] and pytest, for the emulated computer."""
    python = max((SYSTEM / "usr" / "bin").glob("python3.*[0-9]"))
    run(
        *(UV, "pip", "install", "--quiet", "--target", SITE),
        *("--python-platform", "aarch64-manylinux_2_28"),
        *("--python-version", python.name.removeprefix("python")),
        *("--only-binary", ":all:", "--constraint", ROOT / "requirements.lock"),
        *(f"{wheel}[sim]", "pytest", "pytest-timeout", "hypothesis"),
    )
    (SITE / "sitecustomize.py").write_text(SITE_CUSTOMIZATION)
    PYTHON.write_text(
        "#!/bin/sh\n"
        f"export PYTHONHOME={SYSTEM}/usr PYTHONPATH={SITE}\n"
        f'exec {EMULATOR} -L {SYSTEM} {python} "$@"\n'
    )
    PYTHON.chmod(0o755)
    shutil.copytree(ROOT / "tests", FOLDER / "tests")
    shutil.copy(ROOT / "pyproject.toml", FOLDER)


def run_scenario(library: str) -> str:
    """Run a scenario with the C libraries ("on") or without them ("off"). Returns the command digest."""
    ended = run_emulated(
        *(SITE / "bin" / "snakesim", "run", SCENARIO, "--in-process", "--duration", SECONDS),
        *("--no-record", "--out", f"run-{library}"),
        extra_env={SWITCH_VARIABLE: "off"} if library == "off" else {},
        captures=True,
    )
    if ended.returncode:
        sys.exit(f"aarch64: the run failed:\n{ended.stdout}\n{ended.stderr}")
    return ended.stdout.partition("command digest")[2].split(",")[0].strip()


def run_emulated(
    *arguments: str | Path, extra_env: dict[str, str] | None = None, captures: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run the emulated Python with these arguments in its folder, which has only the tests."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "SNAKESIM_"))
    }
    return subprocess.run(
        [PYTHON, *arguments],
        cwd=FOLDER,
        env=environment | {"OMP_NUM_THREADS": "1"} | (extra_env or {}),
        capture_output=captures,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )


def run(*command: str | Path) -> None:
    """Run a program of this computer. Raises CalledProcessError if it fails; its output is shown then."""
    ended = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    if ended.returncode:
        sys.stderr.write(ended.stdout + ended.stderr)
    ended.check_returncode()


if __name__ == "__main__":
    sys.exit(main())
