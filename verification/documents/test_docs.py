"""Tests that run the commands in the README, the tutorials and the guides exactly as printed.

Of docs/hardware/joint-modules.md, only the section that needs no CAN is tested here. `make test-can` runs commands for
the other sections.
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


GET_STARTED_PAGES = (
    "get-started/first-run",
    "tutorials/explore-runs",
    "tutorials/watch-a-running-robot",
    "tutorials/recover-from-faults",
    "tutorials/write-a-controller",
)
EVALUATION_PAGES = (
    "how-to/evaluate-controllers",
    "how-to/write-a-suite",
    "how-to/optimize-parameters",
)
TUTORIAL_PAGES = (
    "tutorials/first-controller",
    "tutorials/train-a-policy",
    "tutorials/your-robot",
    "tutorials/your-sensor",
    "tutorials/lab-on-your-desk",
)
JOINT_MODULES_PAGE = REPOSITORY / "docs" / "hardware" / "joint-modules.md"
SECTION_WITHOUT_CAN = "1. Anywhere"
SCRIPT_TIMEOUT_S = 500.0
END_TIMEOUT_S = 30.0


def read_sections(page: str) -> list[DocumentSection]:
    """Return the sections of a Markdown file that contain commands."""
    return [section for section in parse_sections(REPOSITORY / page) if section.has_commands]


def read_doc_sections(*pages: str) -> list[DocumentSection]:
    """Return the sections of pages in `docs` that contain commands. Pages are named without suffix."""
    return [section for page in pages for section in read_sections(f"docs/{page}.md")]


README = read_sections("README.md")
GET_STARTED = read_doc_sections(*GET_STARTED_PAGES)
EVALUATION = read_doc_sections(*EVALUATION_PAGES)
TUTORIALS = read_doc_sections(*TUTORIAL_PAGES)
CONTROLLERS = read_doc_sections("reference/controllers")
ROBOTS = read_doc_sections("how-to/robots")
SCENES = read_doc_sections("how-to/scenes")
URDF = read_doc_sections("how-to/urdf")
HARDWARE_IN_THE_LOOP = [
    section
    for section in parse_sections(JOINT_MODULES_PAGE)
    if section.title == SECTION_WITHOUT_CAN
]


def make_test_id(section: DocumentSection) -> str:
    """Return the title of a section in lower case, with hyphens between its words."""
    return re.sub(r"\W+", "-", section.title).lower()


def find_isolation_prefix() -> list[str]:
    """Return the command prefix for a network namespace, in which the default port is free.

    The prefix is empty if the kernel grants no namespace.
    """
    prefix = ["unshare", "--net"]
    if os.geteuid() != 0:
        prefix.append("--map-root-user")
    if shutil.which("unshare") is None:
        return []
    attempt = subprocess.run([*prefix, "true"], capture_output=True, check=False)
    return prefix if attempt.returncode == 0 else []


def run_script(script: str, cwd: Path, prefix: list[str]) -> str:
    """Run a bash script, check that it succeeds, and return its output.

    Args:
        script: The script.
        cwd: Folder in which it runs. Its virtual environment comes first on the search path.
        prefix: Command prefix, such as for a network namespace.
    """
    (cwd / "typed.sh").write_text(script)
    search_path = os.pathsep.join([str(cwd / ".venv" / "bin"), os.environ["PATH"]])
    process = subprocess.Popen(
        [*prefix, "bash", "typed.sh"],
        cwd=cwd,
        env=make_environment(cwd / "state", PATH=search_path),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=SCRIPT_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGTERM)  # all processes that the script has started
        output, _ = process.communicate(timeout=END_TIMEOUT_S)
        raise AssertionError(f"not done within {SCRIPT_TIMEOUT_S:.0f} s:\n{output}") from None
    assert process.returncode == 0, output
    assert "Traceback" not in output, output
    return output


@needs_uv
@pytest.mark.slow
@pytest.mark.parametrize(
    "section",
    [
        *GET_STARTED,
        *HARDWARE_IN_THE_LOOP,
        *EVALUATION,
        *CONTROLLERS,
        *ROBOTS,
        *SCENES,
        *URDF,
        *TUTORIALS,
    ],
    ids=make_test_id,
)
def test_section_commands_succeed_as_printed(section: DocumentSection, tmp_path: Path) -> None:
    folder = tmp_path / "snakesim"
    documents.copy_repository(folder)
    for name, content in section.files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")
    run_script(documents.make_bash_script(section), folder, find_isolation_prefix())


@needs_uv
def test_readme_commands_succeed_in_fresh_clone(tmp_path: Path) -> None:
    """Runs all blocks of the README in a clone with a new environment, made from the lock.

    The clone only collects the tests, because this test is one of them. Downloads come from uv's cache, as a rule.
    """
    origin = tmp_path / "origin"
    git = ["git", "-c", "user.name=x", "-c", "user.email=x@example.org"]
    shutil.copytree(REPOSITORY, origin, ignore=documents.list_excluded_names, symlinks=True)
    for arguments in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "Copy the working tree"]):
        subprocess.run([*git, "-C", str(origin), *arguments], check=True)
    clone = tmp_path / "snakesim"
    subprocess.run([*git, "clone", "-q", str(origin), str(clone)], check=True)
    install, quick_start = README
    for name, content in quick_start.files.items():
        (clone / name).write_text(content, encoding="utf-8")
    install_script = documents.make_bash_script(install)
    assert "\nmake demo" in install_script and "\nmake test" in install_script
    install_script = install_script.replace(
        "\nmake test", "\nmake test-unit WORKERS=0 ARGS='--collect-only -q'"
    )
    quick_start_script = documents.make_bash_script(quick_start)
    output = run_script(f"{install_script}\n{quick_start_script}", clone, [])
    assert "report:" in output and (clone / "runs" / "demo" / "report.html").is_file()
    assert "tests collected" in output
    assert (clone / "first.html").is_file()


def test_documents_contain_commands_without_dangerous_ones() -> None:
    assert len(GET_STARTED) >= 5
    assert len(EVALUATION) >= 6
    assert len(README) >= 1
    assert len(HARDWARE_IN_THE_LOOP) == 1
    assert len(CONTROLLERS) == 2
    assert len(SCENES) == 1
    sections = [*GET_STARTED, *EVALUATION, *README]
    languages = {info.split()[0] for section in sections for info, _ in section.blocks if info}
    assert languages <= {"sh", "python", "toml", "text"}
    commands = "\n".join(
        content
        for section in GET_STARTED
        for info, content in section.blocks
        if info.startswith("sh")
    )
    assert not re.search(
        r"\bpip\b(?! install --python)|pgrep|kill -9|killall|pkill|step:clock", commands
    )
