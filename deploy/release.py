"""Builds and checks what a release publishes: `make release` calls it.

Into `build/release/`:

    dist/        the source distribution, and a wheel for each kind of processor
    sbom.json    the software bill of materials (CycloneDX), from the hashed lock
    audit.json   the known vulnerabilities of the locked packages, as far as the vulnerability service answers
    env/         an environment made from nothing but the wheel for this computer, in which the checks run
    run/         the run of the main job in that environment

The exit code is 0 only if every step passed. Packages that the vulnerability service did not
judge are reported as UNKNOWN.
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "release"
UV = ROOT / ".tools" / "bin" / "uv"
BIN = ROOT / ".venv" / "bin"
LOCK = ROOT / "requirements.lock"

INSTALLED_EXTRAS = "sim,record,report"  # enough for a recorded run with a report
MAIN_JOB = ("run", "peg_row", "--controller", "obstacle_aided", "--duration", "3")
AUDIT_TIMEOUT_S = 300
FIND_LAWS_PROBLEM = """
import mujoco
from snakesim_native.libraries import LAWS_LIBRARY
from snakesim_native.load import load_shared_library
print(load_shared_library(LAWS_LIBRARY).problem)
"""


def main() -> int:
    """Run all steps in order. Returns the exit code."""
    argparse.ArgumentParser(
        description="Build and check the distributions of a release."
    ).parse_args()
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    version = read_version()
    check_version_everywhere(version)
    build_distributions()
    check_metadata()
    install_wheel()
    run_main_job(version)
    write_bill_of_materials()
    not_judged = audit_dependencies()
    for file in sorted((OUT / "dist").iterdir()):
        print(f"release: {file.relative_to(ROOT)}  {file.stat().st_size / 1e6:.1f} MB")
    print(f"release: {version} is ready")
    if not_judged:
        print(
            f"release: UNKNOWN: the vulnerability service did not judge {not_judged} packages; audit.json lists them"
        )
    return 0


def read_version() -> str:
    """Return the version in `pyproject.toml`."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]


def check_version_everywhere(version: str) -> None:
    """Exit if the changelog or the citation file names another version."""
    for name, expected in (
        ("CHANGELOG.md", f"## [{version}]"),
        ("CITATION.cff", f"version: {version}"),
    ):
        if expected not in (ROOT / name).read_text(encoding="utf-8"):
            sys.exit(
                f"release: {name} does not contain {expected!r}, the version in pyproject.toml"
            )


def build_distributions() -> None:
    """Build the source distribution and the wheels."""
    sys.path.insert(0, str(ROOT))
    from deploy import wheels  # here, because its folder must be searched first

    wheels.build_wheels(OUT / "dist")
    options = (
        "--quiet",
        "--sdist",
        "--no-build-isolation",
        "--python",
        BIN / "python",
        "--out-dir",
        OUT / "dist",
    )
    run(UV, "build", *options, ROOT)


def check_metadata() -> None:
    """Check that a package index would accept the metadata and can show the README."""
    run(BIN / "twine", "check", "--strict", *sorted((OUT / "dist").glob("snakesim-*")))


def install_wheel() -> None:
    """Install the wheel with its dependencies, in the locked versions, into an empty environment."""
    wheel = next((OUT / "dist").glob(f"*_{platform.machine()}.whl"))
    python = OUT / "env" / "bin" / "python"
    constraints = OUT / "constraints.txt"
    constraints.write_text(read_locked_versions(), encoding="utf-8")
    run(UV, "venv", "--quiet", "--python", BIN / "python", OUT / "env")
    run(
        UV,
        "pip",
        "install",
        "--quiet",
        "--python",
        python,
        "--constraints",
        constraints,
        f"{wheel}[{INSTALLED_EXTRAS}]",
    )
    run(UV, "pip", "check", "--quiet", "--python", python)


def read_locked_versions() -> str:
    """Return the lines `name==version ; marker` of the lock, without hashes."""
    lines = LOCK.read_text(encoding="utf-8").splitlines()
    return "\n".join(
        line.removesuffix("\\").rstrip()
        for line in lines
        if "==" in line and not line.startswith((" ", "#"))
    )


def run_main_job(version: str) -> None:
    """Run the installed command outside the repository: its version, and a run with a recording and a report."""
    command = OUT / "env" / "bin" / "snakesim"
    printed = run(command, "--version", folder=OUT).strip()
    if printed != f"snakesim {version}":
        sys.exit(
            f"release: the installed command prints {printed!r} instead of 'snakesim {version}'"
        )
    python = OUT / "env" / "bin" / "python"
    problem = run(python, "-c", FIND_LAWS_PROBLEM, folder=OUT).strip()
    if problem:
        sys.exit(f"release: the laws of the installed wheel do not run in C: {problem}")
    run(command, *MAIN_JOB, "--out", OUT / "run", folder=OUT)
    for name in ("summary.json", "report.html"):
        if not (OUT / "run" / name).is_file():
            sys.exit(f"release: the run in the empty environment wrote no {name}")


def write_bill_of_materials() -> None:
    """Write the software bill of materials."""
    run(BIN / "cyclonedx-py", "requirements", LOCK, "--output-file", OUT / "sbom.json")


def audit_dependencies() -> int:
    """Ask for known vulnerabilities of the locked packages, and exit if there are any.

    Returns:
        The number of packages that the service could not judge. Without a connection these are all of them, although
        pip-audit then reports success.
    """
    report = OUT / "audit.json"
    options = ("--no-deps", "--disable-pip", "--format", "json", "--output", report)
    finished = subprocess.run(
        [str(word) for word in (BIN / "pip-audit", "--requirement", LOCK, *options)],
        capture_output=True,
        text=True,
        check=False,
        timeout=AUDIT_TIMEOUT_S,
    )
    if not report.is_file():
        sys.exit(f"release: pip-audit wrote no report\n{finished.stderr.strip()}")
    packages = json.loads(report.read_text(encoding="utf-8"))["dependencies"]
    vulnerable = [package["name"] for package in packages if package.get("vulns")]
    if vulnerable:
        sys.exit(
            f"release: known vulnerabilities in {', '.join(vulnerable)}; see {report.relative_to(ROOT)}"
        )
    return sum("skip_reason" in package for package in packages)


def run(*command: object, folder: Path = ROOT) -> str:
    """Run a program and return what it prints. Exits with its messages if it fails."""
    words = [str(word) for word in command]
    finished = subprocess.run(
        words, cwd=folder, env=_make_environment(), capture_output=True, text=True, check=False
    )
    if finished.returncode != 0:
        sys.exit(f"release: failed: {' '.join(words)}\n{finished.stdout}{finished.stderr}")
    return finished.stdout


def _make_environment() -> Mapping[str, str]:
    """Return the environment without what would let this repository's packages be imported."""
    return {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }


if __name__ == "__main__":
    sys.exit(main())
