"""What tutorials, the guide to evaluations and the README ask a reader to type is typed here, as printed.

Of docs/hardware/joint-modules.md only what needs no CAN; `make test-can` runs the rest of it with commands of its own.
"""

import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from snakesim_testing.runs import documents
from snakesim_testing.runs.command import make_environment
from snakesim_testing.runs.documents import REPOSITORY, DocumentSection, needs_uv, parse_sections

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600)]


def typed_in(page: str) -> list[DocumentSection]:
    """The sections of a page in which something is to be typed."""
    return [section for section in parse_sections(REPOSITORY / page) if section.has_commands]


TOUR = (
    "get-started/first-run",
    "tutorials/explore-runs",
    "tutorials/watch-a-running-robot",
    "tutorials/recover-from-faults",
    "tutorials/write-a-controller",
)
TUTORIAL = [section for page in TOUR for section in typed_in(f"docs/{page}.md")]
EVALUATION = [
    section
    for page in ("evaluate-controllers", "write-a-suite", "optimize-parameters")
    for section in typed_in(f"docs/how-to/{page}.md")
]
JOINT_MODULES = REPOSITORY / "docs" / "hardware" / "joint-modules.md"
# Needs no CAN.
HIL = [section for section in parse_sections(JOINT_MODULES) if section.title == "1. Anywhere"]
CONTROLLERS, ROBOTS, SCENES, URDF = (
    typed_in(f"docs/{page}.md")
    for page in ("reference/controllers", "how-to/robots", "how-to/scenes", "how-to/urdf")
)
PAGES = ("first-controller", "train-a-policy", "your-robot", "your-sensor", "lab-on-your-desk")
LESSONS = [section for page in PAGES for section in typed_in(f"docs/tutorials/{page}.md")]
README = typed_in("README.md")
LIMIT_S = 500.0


def named(section: DocumentSection) -> str:
    """A test's name."""
    return re.sub(r"\W+", "-", section.title).lower()


def apart() -> list[str]:
    """A network of the script's own, in which the default port is free; nothing where the kernel grants none."""
    command = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--net", "--map-root-user"]
    granted = shutil.which("unshare") and subprocess.run(
        [*command, "true"], capture_output=True, check=False
    )
    return command if granted and granted.returncode == 0 else []


def typed(script: str, cwd: Path, prefix: list[str]) -> str:
    """Run a script; what it says. Nothing that it has started is left."""
    (cwd / "typed.sh").write_text(script)
    path = os.pathsep.join([str(cwd / ".venv" / "bin"), os.environ["PATH"]])
    process = subprocess.Popen(
        [*prefix, "bash", "typed.sh"],
        cwd=cwd,
        env=make_environment(cwd / "state", PATH=path),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        said, _ = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGTERM)
        said, _ = process.communicate(timeout=30)
        raise AssertionError(f"not done within {LIMIT_S:.0f} s:\n{said}") from None
    assert process.returncode == 0, said
    assert "Traceback" not in said, said
    return said


@needs_uv
@pytest.mark.slow
@pytest.mark.parametrize(
    "section",
    [*TUTORIAL, *HIL, *EVALUATION, *CONTROLLERS, *ROBOTS, *SCENES, *URDF, *LESSONS],
    ids=named,
)
def test_a_section_as_printed(section: DocumentSection, tmp_path: Path) -> None:
    folder = tmp_path / "snakesim"
    documents.copy_repository(folder)
    for name, content in section.files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")
    typed(documents.make_bash_script(section), folder, apart())


@needs_uv
def test_the_readme_as_printed(tmp_path: Path) -> None:
    """All blocks of the README, in a fresh clone with an environment of its own from the lock.

    The tests, of which this is one, are only collected there. Downloads come from uv's cache, as a rule.
    """
    origin = tmp_path / "origin"
    git = ["git", "-c", "user.name=x", "-c", "user.email=x@example.org"]
    shutil.copytree(REPOSITORY, origin, ignore=documents.list_excluded_names, symlinks=True)
    for arguments in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "As it is"]):
        subprocess.run([*git, "-C", str(origin), *arguments], check=True)
    clone = tmp_path / "snakesim"
    subprocess.run([*git, "clone", "-q", str(origin), str(clone)], check=True)
    install, quick_start = README
    for name, content in quick_start.files.items():
        (clone / name).write_text(content, encoding="utf-8")
    printed = documents.make_bash_script(install)
    assert "\nmake demo" in printed and "\nmake test" in printed
    script = printed.replace("\nmake test", "\nmake test-unit WORKERS=0 ARGS='--collect-only -q'")
    output = typed(script + "\n" + documents.make_bash_script(quick_start), clone, [])
    assert "report:" in output and (clone / "runs" / "demo" / "report.html").is_file()
    assert "tests collected" in output
    assert (clone / "first.html").is_file()


def test_the_documents_ask_for_something() -> None:
    assert (
        len(TUTORIAL) >= 5
        and len(EVALUATION) >= 6
        and len(README) >= 1
        and len(HIL) == 1
        and len(CONTROLLERS) == len(SCENES) == 1
    )
    every = [info for section in [*TUTORIAL, *EVALUATION, *README] for info, _ in section.blocks]
    assert {info.split()[0] for info in every if info} <= {"sh", "python", "toml", "text"}
    commands = "\n".join(
        content for section in TUTORIAL for info, content in section.blocks if info.startswith("sh")
    )
    assert not re.search(
        r"\bpip\b(?! install --python)|pgrep|kill -9|killall|pkill|step:clock", commands
    )
