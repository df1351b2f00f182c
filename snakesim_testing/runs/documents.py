"""What a document asks its reader to type: its fenced blocks, section by section, as one shell script.

    ```sh               commands, one after the other
    ```sh background    a command in a terminal of its own; the next one, or the section's end, ends it with Ctrl-C
    ```python wave.py   a file that the reader is asked to save

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
LEFT_OUT_EVERYWHERE = ("*.egg-info", "__pycache__", ".*_cache")
LEFT_OUT_OF_ROOT = (".venv", ".tools", ".git", "runs", "build")
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


def leave_out(folder: str, names: list[str]) -> set[str]:
    """Return what a copy of the repository leaves out. `snakesim_testing/runs` is part of it, `runs` is not."""
    patterns = LEFT_OUT_EVERYWHERE
    if Path(folder) == REPOSITORY:
        patterns += LEFT_OUT_OF_ROOT
    return {name for name in names if any(fnmatch(name, pattern) for pattern in patterns)}


@dataclass
class DocumentSection:
    """A heading, and what is to be typed below it."""

    title: str
    # (words behind the fence, content).
    blocks: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    # To be saved: here, or in a section before.
    files: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def has_commands(self) -> bool:
        """Whether anything is to be typed at all."""
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
    """All commands of a section, for bash."""
    parts = [PROLOGUE]
    for number, (info, content) in enumerate(section.blocks):
        if info == "sh background":
            log = f"background-{number}.log"
            parts.append(
                f"end_background\n( {content.rstrip()} ) >{log} 2>&1 &\nrunning=$!\nawait_running {log}\n"
            )
        elif info == "sh":
            parts += [
                _expecting(command)
                for command in re.split(r"(?<!\\)\n", content)
                if command.strip()
            ]
    return "\n".join(parts)


def _expecting(command: str) -> str:
    code = re.search(r"#.*\(exit code (\d+)\)", command)
    reported = f"echo '$' {shlex.quote(command)}"
    if code is None:
        return f"{reported}\n{command}"
    return (
        f"{reported}\ncode=0; {command.partition('#')[0].strip()} || code=$?; [ $code = {code[1]} ]"
    )


def clone(folder: Path) -> None:
    """The repository's files, and an environment that `make` takes for its own: it lends what is installed here."""
    shutil.copytree(REPOSITORY, folder, ignore=leave_out, symlinks=True)
    (folder / ".tools").symlink_to(REPOSITORY / ".tools")
    venv = folder / ".venv"
    subprocess.run(
        [UV, "venv", "--quiet", "--offline", "--python", sys.executable, venv], check=True
    )
    library = next((venv / "lib").glob("python*/site-packages"))
    lent = sysconfig.get_path("purelib")
    (library / "lent.pth").write_text(f"import site; site.addsitedir({lent!r})\n")
    command = venv / "bin" / "snakesim"
    entry = "import sys\nfrom snakesim_operator.__main__ import main\n"
    entry += "if __name__ == '__main__':\n    sys.exit(main())\n"
    command.write_text(f"#!{venv}/bin/python\n{entry}")
    command.chmod(0o755)
    (venv / ".setup").write_text(f"{folder}\n\n")
