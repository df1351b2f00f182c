"""Tests the wheel for ARM on an emulated processor: `python -m verification.computers.aarch64`.

First it runs the tests that compare the C libraries with their Python versions. Then it runs the same scenario with the
C libraries and without them: both runs must have the same digest. The emulator is QEMU's for single programs.

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
BUILD_FOLDER = ROOT / "build" / "aarch64"
DEBIAN_ROOT = BUILD_FOLDER / "system"  # Debian's files
SITE_PACKAGES = BUILD_FOLDER / "site"  # Python packages
PYTHON_SCRIPT = BUILD_FOLDER / "python"  # a script that runs the emulated Python
UV = ROOT / ".tools" / "bin" / "uv"
EMULATOR = "qemu-aarch64-static"
TESTS = (
    "tests/unit/sim_backend/test_laws.py",
    "tests/unit/gnc/navigation/path_search/test_native_growth.py",
)
SCENARIO = "peg_row"
DURATION_S = "0.3"  # of robot time; the emulator is slow
COMMAND_TIMEOUT_S = 1800  # long enough for a slow computer
# A program of the emulated computer cannot be started directly, only through the script.
SITE_CUSTOMIZATION = f"import sys\nsys.executable = {str(PYTHON_SCRIPT)!r}\n"


class MissingToolError(Exception):
    """Raised if this computer has no apt or emulator. The text explains what to do."""


def main() -> int:
    """Prepare the emulated computer, run the tests and both runs on it, and return the exit code."""
    try:
        download_debian_python()
        install_packages(build_wheel())
    except MissingToolError as error:
        print(f"aarch64: {error}")
        return 2
    completed = run_emulated(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow", *TESTS
    )
    if completed.returncode:
        return 1
    # If the variable names a folder, SnakeSIM fails if it cannot load a library.
    with_library = run_scenario(str(SITE_PACKAGES / "snakesim_native" / "compiled"), "run-c")
    without_library = run_scenario("off", "run-python")
    print(f"{SCENARIO}: digest {with_library} with the C libraries, {without_library} without")
    return 0 if with_library == without_library else 1


def build_wheel() -> Path:
    """Build the wheels of this repository as `make wheels` does, and return the one for ARM."""
    run_on_host(sys.executable, ROOT / "deploy" / "wheels.py")
    (wheel,) = (ROOT / "build" / "wheels").glob("*_aarch64.whl")
    return wheel


def download_debian_python() -> None:
    """Download Debian's Python for arm64 with all that it needs, and unpack it.

    apt uses separate folders, so the package lists and the architecture of this computer do not change.
    """
    if shutil.which("apt-get") is None:
        raise MissingToolError("apt-get is missing: this needs Debian")
    if shutil.which(EMULATOR) is None:
        raise MissingToolError(f"{EMULATOR} is missing. Run: sudo apt-get install qemu-user-static")
    shutil.rmtree(BUILD_FOLDER, ignore_errors=True)
    state = BUILD_FOLDER / "apt" / "state"
    cache = BUILD_FOLDER / "apt" / "cache"
    for folder in (
        state / "lists" / "partial",
        cache / "archives" / "partial",
        DEBIAN_ROOT,
        SITE_PACKAGES,
    ):
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
    run_on_host(*apt, "update")
    run_on_host(
        *apt, "--download-only", "install", "python3", "libgcc-s1", "libstdc++6", "libgomp1"
    )
    for package in sorted((cache / "archives").glob("*.deb")):
        run_on_host("dpkg-deb", "--extract", package, DEBIAN_ROOT)
    if not (DEBIAN_ROOT / "lib").exists():  # since Debian 13, everything is below usr
        (DEBIAN_ROOT / "lib").symlink_to("usr/lib")


def make_apt_options(values: dict[str, str]) -> Iterator[str]:
    """Return the options that set these values of apt's configuration."""
    for name, value in values.items():
        yield "-o"
        yield f"{name}={value}"


def install_packages(wheel: Path) -> None:
    """Install a wheel, the packages of its extra [sim] and pytest, for the emulated computer."""
    (python,) = (DEBIAN_ROOT / "usr" / "bin").glob("python3.[0-9]*[0-9]")
    run_on_host(
        *(UV, "pip", "install", "--quiet", "--target", SITE_PACKAGES),
        *("--python-platform", "aarch64-manylinux_2_28"),
        *("--python-version", python.name.removeprefix("python")),
        *("--only-binary", ":all:", "--constraint", ROOT / "requirements.lock"),
        *(f"{wheel}[sim]", "pytest", "pytest-timeout", "hypothesis"),
    )
    (SITE_PACKAGES / "sitecustomize.py").write_text(SITE_CUSTOMIZATION)
    PYTHON_SCRIPT.write_text(
        "#!/bin/sh\n"
        f"export PYTHONHOME={DEBIAN_ROOT}/usr PYTHONPATH={SITE_PACKAGES}\n"
        f'exec {EMULATOR} -L {DEBIAN_ROOT} {python} "$@"\n'
    )
    PYTHON_SCRIPT.chmod(0o755)
    shutil.copytree(ROOT / "tests", BUILD_FOLDER / "tests")
    shutil.copy(ROOT / "pyproject.toml", BUILD_FOLDER)


def run_scenario(libraries: str, out: str) -> str:
    """Run a scenario, and return its command digest.

    Args:
        libraries: Folder of the C libraries, or "off" for the Python versions.
        out: Folder of the results.
    """
    completed = run_emulated(
        *(
            SITE_PACKAGES / "bin" / "snakesim",
            "run",
            SCENARIO,
            "--in-process",
            "--duration",
            DURATION_S,
        ),
        *("--no-record", "--out", out),
        extra_env={SWITCH_VARIABLE: libraries},
        capture_output=True,
    )
    digest = completed.stdout.partition("command digest")[2].split(",")[0].strip()
    if completed.returncode or not digest:
        sys.exit(f"aarch64: the run failed:\n{completed.stdout}\n{completed.stderr}")
    return digest


def run_emulated(
    *arguments: str | Path, extra_env: dict[str, str] | None = None, capture_output: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run the emulated Python in its folder, which contains the tests but no packages of this repository."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "SNAKESIM_"))
    }
    return subprocess.run(
        [PYTHON_SCRIPT, *arguments],
        cwd=BUILD_FOLDER,
        env=environment | {"OMP_NUM_THREADS": "1"} | (extra_env or {}),
        capture_output=capture_output,
        text=True,
        timeout=COMMAND_TIMEOUT_S,
        check=False,
    )


def run_on_host(*command: str | Path) -> None:
    """Run a program of this computer. If it fails, print its output.

    Raises:
        CalledProcessError: The program failed.
    """
    completed = subprocess.run(
        command, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False
    )
    if completed.returncode:
        sys.stderr.write(completed.stdout + completed.stderr)
    completed.check_returncode()


if __name__ == "__main__":
    sys.exit(main())
