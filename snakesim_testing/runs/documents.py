"""Turns the fenced code blocks of a document into one shell script for each section, so that a test can run them.

    ```sh               commands, one after the other
    ```sh background    a command in a terminal of its own; the next such block or the section's end stops it by Ctrl-C
    ```python wave.py   a file that the reader saves

`# ... (exit code 1)` behind a command is its exit code, if that is not 0.
"""

import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
UV = REPOSITORY / ".tools" / "bin" / "uv"
needs_uv = pytest.mark.skipif(not UV.is_file(), reason="`make setup` has put no uv into .tools")
EXCLUDED_EVERYWHERE = ("*.egg-info", "__pycache__", ".*_cache")
EXCLUDED_FROM_ROOT = (".venv", ".tools", ".git", "runs", "build")
PROLOGUE = """\
set -eum
ip link set lo up 2>/dev/null || true
running=
end_background() {
    [ -z "$running" ] || { kill -INT -- "-$running" 2>/dev/null || true; wait "$running" || true; }
    running=
}
await_running() {
    for _ in $(seq 600); do
        grep -q ' s  ' "$1" && return
        kill -0 "$running" || break
        sleep 0.2
    done
    echo "did not start:"; cat "$1"; exit 90
}
trap 'code=$?; end_background; cat background-*.log 2>/dev/null || true; exit $code' EXIT
"""


def list_excluded_names(folder: str, names: list[str]) -> set[str]:
    """Return the names in a folder that a copy of the repository excludes, for `shutil.copytree`.

    `snakesim_testing/runs` is part of a copy, but the folder `runs` of the repository is not.
    """
    patterns = EXCLUDED_EVERYWHERE
    if Path(folder) == REPOSITORY:
        patterns += EXCLUDED_FROM_ROOT
    return {name for name in names if any(fnmatch(name, pattern) for pattern in patterns)}


@dataclass
class DocumentSection:
    """A section of a document, with its code blocks and the files that the reader has saved."""

    title: str
    # The info line and the content of each block.
    blocks: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    # The content of each file that this section or an earlier one contains, by its name.
    files: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def has_commands(self) -> bool:
        """Whether the section contains any commands."""
        return any(info.startswith("sh") for info, _ in self.blocks)


def parse_sections(path: Path) -> list[DocumentSection]:
    """Return the sections of a Markdown document that have code blocks.

    A block whose info line names a file, such as "python my.py", is also one of the section's files. Each section has
    the files of the sections before it, too.
    """
    sections = [DocumentSection("")]
    block_lines: list[str] | None = None  # of the open code block; None: outside of blocks
    info = ""
    for line in path.read_text(encoding="utf-8").splitlines():
        is_fence = line.startswith("```")
        if block_lines is None:
            heading = re.match(r"#+ (.*)", line)
            if heading:
                sections.append(DocumentSection(heading[1], files=dict(sections[-1].files)))
            elif is_fence:
                block_lines = []
                info = line.removeprefix("```").strip()
        elif is_fence:
            text = "\n".join(block_lines) + "\n"
            _, _, file_name = info.partition(" ")
            if "." in file_name:
                sections[-1].files[file_name] = text
            sections[-1].blocks.append((info, text))
            block_lines = None
        else:
            block_lines.append(line)
    return [section for section in sections if section.blocks]


def make_bash_script(section: DocumentSection) -> str:
    """Return a bash script that runs all commands of a section, and fails at the first unexpected exit code."""
    parts = [PROLOGUE]
    for number, (info, content) in enumerate(section.blocks):
        if info == "sh background":
            log = f"background-{number}.log"
            parts.append(
                f"end_background\n( {content.rstrip()} ) >{log} 2>&1 &\nrunning=$!\nawait_running {log}\n"
            )
        elif info == "sh":
            commands = re.split(r"(?<!\\)\n", content)  # a backslash continues a line
            parts += [_check_exit_code(command) for command in commands if command.strip()]
    return "\n".join(parts)


def _check_exit_code(command: str) -> str:
    """Return bash lines that print a command, run it, and compare its exit code with that in its comment, or 0."""
    echo = f"echo '$' {shlex.quote(command)}"
    exit_code = re.search(r"#.*\(exit code (\d+)\)", command)
    if exit_code is None:
        return f"{echo}\n{command}"
    command_without_comment = command.partition("#")[0].strip()
    return f"{echo}\ncode=0; {command_without_comment} || code=$?; [ $code = {exit_code[1]} ]"


def copy_repository(folder: Path) -> None:
    """Copy the repository into a folder, with an environment that uses the packages of this environment.

    `make` regards the environment as complete, and does not install anything.
    """
    shutil.copytree(REPOSITORY, folder, ignore=list_excluded_names, symlinks=True)
    (folder / ".tools").symlink_to(REPOSITORY / ".tools")
    venv = folder / ".venv"
    subprocess.run(
        [UV, "venv", "--quiet", "--offline", "--python", sys.executable, venv], check=True
    )
    library = next((venv / "lib").glob("python*/site-packages"))
    installed_packages = sysconfig.get_path("purelib")
    (library / "installed.pth").write_text(
        f"import site; site.addsitedir({installed_packages!r})\n"
    )
    command = venv / "bin" / "snakesim"
    entry = "import sys\nfrom snakesim_operator.__main__ import main\n"
    entry += "if __name__ == '__main__':\n    sys.exit(main())\n"
    command.write_text(f"#!{venv}/bin/python\n{entry}")
    command.chmod(0o755)
    (venv / ".setup").write_text(f"{folder}\n\n")
