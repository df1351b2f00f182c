"""Tests of the extras: each one suffices for its purpose, and commands name the extra that they miss.

Only the tests that are marked as slow download packages; they are skipped if no package index can be reached.
"""

import sysconfig
import threading
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from snakesim_operator.base.extras import PACKAGES_BY_EXTRA
from snakesim_testing.benches.workbench import read_example_from_docs
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import CompletedRun
from snakesim_testing.runs.documents import REPOSITORY, UV, needs_uv
from verification.installation.distributions import find_required_distributions
from verification.installation.ways_to_install import (
    create_empty_environment,
    install_into_environment,
    try_program,
)

pytestmark = pytest.mark.e2e

SCENARIO = """
robot = "planar13"
scene = "flat"
controller = "hold"
clock_mode = "lockstep"
duration_s = 0.3

[start]
on_route = false

[services.control]
"""
WORKBENCH = ("alone.toml", "--backend", "./workbench.py:Workbench")
CAN_BACKEND = ("--backend", "can", "--set", "backend.physics_model=inertia")
REALTIME = ("--clock-mode", "realtime", "--duration", "8", "--stay")
INDEX_ERRORS = ("error sending request", "Failed to fetch")  # as uv prints them
BYTES_PER_MB = 1e6
# The sizes that were measured, and some reserve.
MAX_INSTALL_MB = {"": 110, "can": 130, "sim": 190}
# Each command needs an extra that a plain installation does not have.
COMMANDS_BY_EXTRA: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("sim", ("run", "triplet")),
    ("record", ("run", *WORKBENCH)),
    ("record", ("recording", "report", "run")),
    ("can", ("drive", "load", "can", "triplet")),
    ("serial", ("drive", "scan", "feetech", "/dev/ttyUSB0")),
    ("console", ("console", "run")),
    ("console", ("record", "--foxglove", "0")),
    ("console", ("start", "preview")),
    ("report", ("recording", "export", "run", "--format", "parquet")),
    ("report", ("recording", "plot", "run")),
    ("report", ("recording", "video", "run", "--out", "film.mp4")),
    ("train", ("study", "evaluate", "clutter")),
    ("lab", ("lab", "render", "lab.toml", "--out", "lab")),
    ("ros2", ("start", "ros2")),
)

RunSnakesim = Callable[..., CompletedRun]  # runs one command of an installation


def prepare_command(command: Path, home: Path, **variables: str) -> RunSnakesim:
    """Create a working folder with a scenario and a backend, and return a function that runs `snakesim` there."""
    work = home / "work"
    work.mkdir()
    (work / "alone.toml").write_text(SCENARIO)
    (work / "workbench.py").write_text(read_example_from_docs())

    def run_snakesim(*arguments: str) -> CompletedRun:
        return try_program(command, *arguments, cwd=work, **variables)

    return run_snakesim


def install_with_linked_packages(wheel: Path, home: Path) -> RunSnakesim:
    """Install a wheel without extras, and link the packages that it needs from the environment of the tests."""
    installation = install_into_environment(wheel, home)
    linked = home / "linked"
    linked.mkdir()
    for name in find_required_distributions():
        for entry in find_top_level_entries(name):
            target = Path(sysconfig.get_path("purelib")) / entry
            link = linked / entry
            if target.exists() and not link.exists():
                link.symlink_to(target)
    return prepare_command(installation.command, home, PYTHONPATH=str(linked))


def find_top_level_entries(name: str) -> set[str]:
    """Return the files and folders that a distribution has directly in the folder of the packages."""
    files = distribution(name).files or ()
    return {file.parts[0] for file in files if not file.parts[0].startswith(".")}


def install_from_index(extra: str, wheel: Path, home: Path) -> tuple[RunSnakesim, Path]:
    """Install a wheel and an extra with the packages of a package index, as `pip install` does.

    Returns:
        A function that runs `snakesim`, and the folder with all installed packages.
    """
    python, library = create_empty_environment(home)
    completed = try_program(
        UV,
        "pip",
        "install",
        "--quiet",
        "--python",
        python,
        "--constraint",
        REPOSITORY / "requirements.lock",
        f"{wheel}[{extra}]" if extra else wheel,
        cwd=home,
        UV_OFFLINE="0",
    )
    if completed.code != 0 and any(error in completed.err for error in INDEX_ERRORS):
        pytest.skip("no package index can be reached")
    assert completed.code == 0, completed.err
    return prepare_command(python.with_name("snakesim"), home), library


def check_stop_and_arming(snakesim: RunSnakesim) -> None:
    """Run a robot whose backend is a file, then stop, reset and arm another run of it, without any extra."""
    completed = snakesim(
        "run", *WORKBENCH, "--no-record", "--out", "run", "--endpoint", find_free_endpoint()
    )
    assert completed.code == 0, completed
    assert "report:  not written" in completed.out, completed
    assert "snakesim[record]" in completed.out, completed

    endpoint = ("--endpoint", find_free_endpoint())
    staying_run = threading.Thread(
        target=snakesim, args=("run", *WORKBENCH, *REALTIME, "--no-record", *endpoint)
    )
    staying_run.start()
    wait_until(
        lambda: "armed" in snakesim("status", *endpoint).out.replace("disarmed", ""),
        "an armed robot",
    )
    assert snakesim("estop", *endpoint).code == 0
    wait_until(lambda: snakesim("robot", "reset", *endpoint).code == 0, "a reset stop")
    wait_until(
        lambda: snakesim("robot", "arm", "planar13", "Workbench", *endpoint).code == 0,
        "an armed robot again",
    )
    staying_run.join()


def check_can_driver(snakesim: RunSnakesim) -> None:
    """Run the CAN driver on a bus with emulated joint modules."""
    assert "together" in snakesim("drive", "load", "can", "triplet").out
    completed = snakesim(
        "run", "alone.toml", *CAN_BACKEND, "--no-record", "--endpoint", find_free_endpoint()
    )
    assert completed.code == 0, completed


def check_simulation(snakesim: RunSnakesim) -> None:
    """Simulate a robot among obstacles, in one process."""
    completed = snakesim("run", "triplet", "--in-process", "--no-record", "--set", "duration_s=2")
    assert completed.code == 0, completed


CHECKS_BY_EXTRA: dict[str, Callable[[RunSnakesim], None]] = {
    "": check_stop_and_arming,
    "can": check_can_driver,
    "sim": check_simulation,
}


def measure_size_mb(folder: Path) -> float:
    """Return the size of all files below a folder in MB; a link counts as a link."""
    size_bytes = sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())
    return size_bytes / BYTES_PER_MB


@needs_uv
@pytest.mark.slow
@pytest.mark.parametrize("extra", CHECKS_BY_EXTRA, ids=["core", "can", "sim"])
def test_extra_alone_suffices_for_its_purpose(extra: str, wheel: Path, tmp_path: Path) -> None:
    snakesim, library = install_from_index(extra, wheel, tmp_path)
    size_mb = measure_size_mb(library)
    own_size_mb = sum(measure_size_mb(package) for package in library.glob("snakesim*"))
    name = f"snakesim[{extra}]" if extra else "snakesim"
    print(f"\n{name}: {size_mb:.0f} MB, of which {own_size_mb:.0f} MB SnakeSIM")
    assert size_mb < MAX_INSTALL_MB[extra]
    CHECKS_BY_EXTRA[extra](snakesim)


@needs_uv
def test_core_installation_drives_robot_and_commands_name_missing_extras(
    wheel: Path, tmp_path: Path
) -> None:
    snakesim = install_with_linked_packages(wheel, tmp_path)
    overview = snakesim("--help")
    assert overview.code == 0 and not overview.err
    assert " estop " in overview.out and " drive " in overview.out
    completion = snakesim("completion", "bash")
    assert completion.code == 0 and not completion.err
    check_stop_and_arming(snakesim)
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda row: snakesim(*row[1]), COMMANDS_BY_EXTRA))
    for (extra, command), answer in zip(COMMANDS_BY_EXTRA, answers, strict=True):
        assert f"-m pip install 'snakesim[{extra}]'" in answer.err, (command, answer)
        assert answer.code == 2, (command, answer)
        assert answer.err.count("\n") == 1, (command, answer)
    assert "--no-record" in snakesim("run", *WORKBENCH).err


def find_packages_by_distribution() -> dict[str, set[str]]:
    """Return the import names of each distribution that is installed here, by its name in lower case."""
    packages_by_distribution: dict[str, set[str]] = {}
    for package, names in packages_distributions().items():
        for name in names:
            packages_by_distribution.setdefault(name.lower(), set()).add(package)
    return packages_by_distribution


def test_extras_install_exactly_the_listed_packages() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    assert {*Requirement(extras["all"][0]).extras} == {*extras} - {"all"} == {*PACKAGES_BY_EXTRA}
    packages_by_distribution = find_packages_by_distribution()
    for extra, packages in PACKAGES_BY_EXTRA.items():
        requirements = [Requirement(line) for line in extras[extra]]
        names: set[str] = set()
        for requirement in requirements:
            if requirement.name == "snakesim":
                continue
            names.add(requirement.name.lower())
            # An extra can be a distribution of its own: `dask[distributed]` installs `distributed`.
            names |= requirement.extras & packages_by_distribution.keys()
        importable = set().union(*(packages_by_distribution[name] for name in names))
        unknown = {*packages} - importable
        unlisted = [name for name in names if not packages_by_distribution[name] & {*packages}]
        assert not unknown, extra
        assert not unlisted, extra
