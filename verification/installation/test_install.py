"""Installed without make: from a wheel or the sources, into an environment, a folder or a person's home.

What SnakeSIM depends on is lent by the environment that runs the tests, without a network; only the sizes need one.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
import threading
import tomllib
import zipfile
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
from snakesim_testing.runs.command import CompletedRun, make_environment, run_program
from snakesim_testing.runs.documents import REPOSITORY, UV, list_excluded_names, needs_uv
from verification.installation.distributions import required

pytestmark = pytest.mark.e2e

SCHEMAS = REPOSITORY / "schemas"
PACKAGES = (
    "snakesim_can_backend",
    "snakesim_gnc",
    "snakesim_hal",
    "snakesim_native",
    "snakesim_operator",
    "snakesim_sim_backend",
)


def run(*command: object, cwd: Path, **more: str) -> str:
    done = ended(*command, cwd=cwd, **more)
    assert done.code == 0, done.out + done.err
    return done.out


def ended(*command: object, cwd: Path, **more: str) -> CompletedRun:
    return run_program(command, cwd, {**make_environment(cwd), "UV_OFFLINE": "1", **more}, 100.0)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, so that the build leaves nothing in the repository. Links stay links, as in a clone."""
    folder = tmp_path_factory.mktemp("sources") / "snakesim"
    shutil.copytree(REPOSITORY, folder, ignore=list_excluded_names, symlinks=True)
    return folder


@pytest.fixture(scope="module")
def wheel(sources: Path) -> Path:
    build = (UV, "build", "--wheel", "--no-build-isolation", "--python", sys.executable)
    run(*build, "--out-dir", sources / "dist", ".", cwd=sources)
    return next((sources / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def dependencies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that is installed here except SnakeSIM."""
    folder = tmp_path_factory.mktemp("dependencies")
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if "snakesim" not in entry.name:
            (folder / entry.name).symlink_to(entry)
    return folder


# The command, the folder with the packages, a folder for PYTHONPATH.
Installed = tuple[Path, Path, Path | None]


def into_a_folder(what: Path, home: Path) -> Installed:
    run(UV, "pip", "install", "--target", home / "lib", *NO_DEPS, what, cwd=home)
    return home / "lib" / "bin" / "snakesim", home / "lib", home / "lib"


def empty_environment(home: Path) -> tuple[Path, Path]:
    """Its Python, and the folder of its packages."""
    run(UV, "venv", "--python", sys.executable, home / "env", cwd=home)
    python = home / "env" / "bin" / "python"
    library = run(
        python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=home
    ).strip()
    return python, Path(library)


def into_an_environment(what: Path, home: Path) -> Installed:
    python, library = empty_environment(home)
    run(UV, "pip", "install", *NO_DEPS[:-2], "--python", python, what, cwd=home)
    return python.with_name("snakesim"), library, None


def into_a_home(what: Path, home: Path) -> Installed:
    """As `pip install --user` does it; the Python is the one that the environment here was made of."""
    python = Path(getattr(sys, "_base_executable", sys.executable))
    pip = [
        python,
        "-m",
        "pip",
        "install",
        "--user",
        "--no-deps",
        "--no-index",
        "--no-warn-script-location",
    ]
    if (
        subprocess.run(
            [python, "-m", "pip", "--version"], capture_output=True, check=False
        ).returncode
        != 0
    ):
        pytest.skip(f"{python} has no pip")
    run(*pip, what, cwd=home, PYTHONUSERBASE=str(home / "base"), PIP_BREAK_SYSTEM_PACKAGES="1")
    return (
        home / "base" / "bin" / "snakesim",
        next((home / "base" / "lib").glob("python*/site-packages")),
        None,
    )


NO_DEPS = ("--quiet", "--no-deps", "--no-build-isolation", "--python", sys.executable)
WAYS: dict[str, Callable[[Path, Path], Installed]] = {
    "target": into_a_folder,
    "environment": into_an_environment,
    "user": into_a_home,
}


@needs_uv
def test_a_wheel_has_what_is_no_code(wheel: Path) -> None:
    schemas = {f"snakesim_hal/schemas/{path.relative_to(SCHEMAS)}" for path in SCHEMAS.rglob("*.*")}
    wanted = {
        *schemas,
        *(f"{package}/py.typed" for package in PACKAGES),
        "snakesim/environments/__init__.py",
    }
    assert not wanted - {*zipfile.ZipFile(wheel).namelist()}


@needs_uv
@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_a_wheel_has_all_that_it_needs(
    way: str, wheel: Path, dependencies: Path, tmp_path: Path
) -> None:
    check(WAYS[way](wheel, tmp_path), dependencies, tmp_path)


@needs_uv
@pytest.mark.slow
def test_the_sources_installed_as_they_are(
    sources: Path, dependencies: Path, tmp_path: Path
) -> None:
    """`pip install .`; what builds it is lent by the environment here, too."""
    check(into_a_folder(sources, tmp_path), dependencies, tmp_path)


def check(installed: Installed, dependencies: Path, home: Path) -> None:
    command, library, on_path = installed
    path = os.pathsep.join(str(folder) for folder in (on_path, dependencies) if folder is not None)
    more = {"PYTHONPATH": path, "PYTHONUSERBASE": str(home / "base")}
    work = home / "work"
    work.mkdir()

    assert run(command, "--version", cwd=work, **more).startswith("snakesim ")
    assert "planar13" in run(command, "scenarios", cwd=work, **more)
    assert "together" in run(command, "can", "load", "triplet", cwd=work, **more)
    published = [Path(line) for line in run(command, "schemas", cwd=work, **more).splitlines()]
    names = {str(path.relative_to(library / "snakesim_hal" / "schemas")) for path in published}
    wanted = {str(path.relative_to(SCHEMAS)) for path in SCHEMAS.rglob("*.*")}
    assert names == wanted and all(path.is_file() for path in published)
    flags = (
        "--controller",
        "hold",
        "--duration",
        "0.2",
        "--out",
        "run",
        "--endpoint",
        find_free_endpoint(),
    )
    run(command, "run", "triplet", *flags, cwd=work, **more)
    assert (work / "run" / "report.html").is_file()


ALONE = """
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
Run = Callable[..., CompletedRun]  # of one command, in an environment of its own


def lent(extra: str, wheel: Path, home: Path) -> tuple[Run, Path]:
    """The wheel, and of the packages here only those that it asks for by itself and by an extra."""
    command, library, _ = into_an_environment(wheel, home)
    folder = home / "lent"
    folder.mkdir()
    for name in required(extra):
        for top in {
            file.parts[0]
            for file in distribution(name).files or ()
            if not file.parts[0].startswith(".")
        }:
            here = Path(sysconfig.get_path("purelib")) / top
            if here.exists() and not (folder / top).exists():
                (folder / top).symlink_to(here)
    return at_work(command, home, PYTHONPATH=str(folder)), library


def fetched(extra: str, wheel: Path, home: Path) -> tuple[Run, Path]:
    """As `pip install` does it, from a package index."""
    python, library = empty_environment(home)
    what = f"{wheel}[{extra}]" if extra else wheel
    install = (
        UV,
        "pip",
        "install",
        "--quiet",
        "--python",
        python,
        "--constraint",
        REPOSITORY / "requirements.lock",
    )
    done = ended(*install, what, cwd=home, UV_OFFLINE="0")
    if done.code != 0 and ("error sending request" in done.err or "Failed to fetch" in done.err):
        pytest.skip("no package index can be reached")
    assert done.code == 0, done.err
    return at_work(python.with_name("snakesim"), home), library


def at_work(command: Path, home: Path, **more: str) -> Run:
    work = home / "work"
    work.mkdir()
    (work / "alone.toml").write_text(ALONE)
    (work / "workbench.py").write_text(read_example_from_docs())
    return lambda *words: ended(command, *words, cwd=work, **more)


def stops_and_arms(snakesim: Run) -> None:
    """Host and controller with a backend from a file, and a person at it."""
    ran = snakesim(
        "run", *WORKBENCH, "--no-record", "--out", "run", "--endpoint", find_free_endpoint()
    )
    assert ran.code == 0 and "report:  not written" in ran.out and "snakesim[record]" in ran.out, (
        ran
    )
    at = ("--endpoint", find_free_endpoint())
    stays = threading.Thread(
        target=snakesim,
        args=(
            "run",
            *WORKBENCH,
            "--clock-mode",
            "realtime",
            "--duration",
            "8",
            "--stay",
            "--no-record",
            *at,
        ),
    )
    stays.start()
    wait_until(
        lambda: "armed" in snakesim("status", *at).out.replace("disarmed", ""), "an armed robot"
    )
    assert snakesim("estop", *at).code == 0
    wait_until(lambda: snakesim("robot", "reset", *at).code == 0, "a reset stop")
    wait_until(
        lambda: snakesim("robot", "arm", "planar13", "Workbench", *at).code == 0,
        "an armed robot again",
    )
    stays.join()


def drives_modules(snakesim: Run) -> None:
    """The driver, on a bus with emulated modules."""
    assert "together" in snakesim("drive", "load", "can", "triplet").out
    drives = (
        "--backend",
        "can",
        "--set",
        "backend.physics_model=inertia",
        "--no-record",
        "--endpoint",
        find_free_endpoint(),
    )
    ran = snakesim("run", "alone.toml", *drives)
    assert ran.code == 0, ran


def simulates(snakesim: Run) -> None:
    """A robot among obstacles, in one process."""
    ran = snakesim("run", "triplet", "--in-process", "--no-record", "--set", "duration_s=2")
    assert ran.code == 0, ran


JOBS: dict[str, Callable[[Run], None]] = {
    "": stops_and_arms,
    "can": drives_modules,
    "sim": simulates,
}
LARGEST_MB = {"": 110, "can": 130, "sim": 190}


@needs_uv
@pytest.mark.slow
@pytest.mark.parametrize("extra", JOBS, ids=["core", "can", "sim"])
def test_what_an_extra_is_for_works_with_that_extra_alone(
    extra: str, wheel: Path, tmp_path: Path
) -> None:
    snakesim, library = fetched(extra, wheel, tmp_path)
    size_mb = sum(file.lstat().st_size for file in library.rglob("*") if file.is_file()) / 1e6
    ours_mb = (
        sum(
            f.lstat().st_size
            for own in library.glob("snakesim*")
            for f in own.rglob("*")
            if f.is_file()
        )
        / 1e6
    )
    print(
        f"\nsnakesim{f'[{extra}]' if extra else ''}: {size_mb:.0f} MB, of which {ours_mb:.0f} MB SnakeSIM"
    )
    assert size_mb < LARGEST_MB[extra]
    JOBS[extra](snakesim)


NEEDS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("sim", ("run", "triplet")),
    ("record", ("run", *WORKBENCH)),
    ("record", ("report", "run")),
    ("can", ("can", "load", "triplet")),
    ("serial", ("serial", "scan", "/dev/ttyUSB0")),
    ("console", ("console", "run")),
    ("console", ("record", "--foxglove", "0")),
    ("console", ("preview",)),
    ("report", ("export", "run", "--format", "parquet")),
    ("report", ("plot", "run")),
    ("report", ("video", "run", "--out", "film.mp4")),
    ("train", ("evaluate", "clutter")),
    ("lab", ("deploy", "render", "lab.toml", "--out", "lab")),
    ("ros2", ("ros2",)),
)


@needs_uv
def test_core_installation_drives_robot_and_commands_name_missing_extras(
    wheel: Path, tmp_path: Path
) -> None:
    snakesim, _ = lent("", wheel, tmp_path)
    listed = snakesim("--help")
    assert (
        listed.code == 0 and not listed.err and " estop " in listed.out and " drive " in listed.out
    )
    completed = snakesim("completion", "bash")
    assert completed.code == 0 and not completed.err
    stops_and_arms(snakesim)
    with ThreadPoolExecutor(4) as side_by_side:
        said = list(side_by_side.map(lambda need: snakesim(*need[1]), NEEDS))
    for (extra, words), done in zip(NEEDS, said, strict=True):
        assert f"-m pip install 'snakesim[{extra}]'" in done.err, (words, done)
        assert (done.code, done.err.count("\n")) == (2, 1), (words, done)
    assert "--no-record" in snakesim("run", *WORKBENCH).err


def test_each_extra_brings_what_is_said_of_it() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    asked = project["optional-dependencies"]
    imported_of: dict[str, set[str]] = {}
    for package, names in packages_distributions().items():
        for name in names:
            imported_of.setdefault(name.lower(), set()).add(package)
    assert {*Requirement(asked["all"][0]).extras} == {*asked} - {"all"} == {*PACKAGES_BY_EXTRA}
    for extra, packages in PACKAGES_BY_EXTRA.items():
        needed = [one for line in asked[extra] if (one := Requirement(line)).name != "snakesim"]
        names = {one.name.lower() for one in needed}
        # Dask[distributed].
        names |= {name for one in needed for name in one.extras if name in imported_of}
        unknown = [
            package
            for package in packages
            if not any(package in imported_of[name] for name in names)
        ]
        unsaid = [name for name in names if not imported_of[name] & {*packages}]
        assert not unknown and not unsaid, extra
