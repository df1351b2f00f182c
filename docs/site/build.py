"""Builds the documentation site into build/docs: `make docs`. Pages are taken as they stand, in the repository's tree.

So a link that works in the repository works on the site.
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from snakesim_hal.base.process import make_child_environment, make_python_command

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = ROOT / "build" / "site"
SITE = ROOT / "build" / "docs"
SHOWN = (
    "README.md",
    "CHANGELOG.md",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "LICENSE",
    "CITATION.cff",
    "docs",
    "schemas",
    "benchmarks",
    "deploy",
    "examples",
    "snakesim_gnc/guidance",
    "snakesim_hal/host/control_cycle.py",
)
# A block, and a file's name or where it is typed.
FENCE = re.compile(r"^(```\w+) +(\S.*)$", re.MULTILINE)
TITLES = {"background": "in a terminal of its own", "of root": "as root", "by hand": ""}


def main() -> None:
    """Collect the pages, then build the site and the API's pages."""
    shutil.rmtree(PAGES, ignore_errors=True)
    for file in shown_files():
        (PAGES / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / file, PAGES / file)
        if file.suffix == ".md":
            (PAGES / file).write_text(
                FENCE.sub(titled, (ROOT / file).read_text(encoding="utf-8")), encoding="utf-8"
            )
    (PAGES / "assets").mkdir()
    for asset in ("iframe-worker.js", "site.css"):
        shutil.copy(ROOT / "docs" / "site" / asset, PAGES / "assets")
    config = str(ROOT / "docs" / "site" / "mkdocs.yml")
    run("mkdocs", "build", "--strict", "--clean", "--config-file", config, NO_MKDOCS_2_WARNING="1")
    print(f"open {SITE.relative_to(ROOT)}/index.html")


def titled(fence: re.Match[str]) -> str:
    """The first line of a block, as the site's Markdown names blocks."""
    words = TITLES.get(fence[2], fence[2].replace("background on", "another terminal on"))
    return f'{fence[1]} title="{words}"' if words else fence[1]


def shown_files() -> Iterator[Path]:
    """Every tracked or new file of the folders that pages link to."""
    command = ("git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *SHOWN)
    for name in subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines():
        if (ROOT / name).is_file() and not name.startswith(("docs/site/", "docs/style/")):
            yield Path(name)


def run(module: str, *arguments: str, **variables: str) -> None:
    """Run a module of this environment's Python, and end with it if it fails."""
    ended = subprocess.run(
        make_python_command("-m", module, *arguments),
        cwd=ROOT,
        env=make_child_environment(variables),
    )
    if ended.returncode:
        sys.exit(f"docs: {module} {' '.join(arguments)} exited with {ended.returncode}")


if __name__ == "__main__":
    main()
