"""Checks the English of the documentation, the docstrings and the messages: `make check` runs it.

Two checkers work together. proselint brings general advice on English. `reject.toml` beside this file lists the words
that this project replaces by the terms of its field, and `Limits` below bounds what makes a page hard to read.
Every problem is printed as `file:line: problem`, and any problem makes the exit code 1.

    python docs/style/check_prose.py              # everything
    python docs/style/check_prose.py --figures    # the measurements of every page, without judging them
"""

import argparse
import ast
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
REJECT_FILE = Path(__file__).with_name("reject.toml")
PROSELINT_EXIT_CODES = (0, 1)  # nothing found, something found
# typography and diacritical marks are those of source files; the rest misjudges tables, code marks and measured zeros.
IGNORED_CHECKS = ("typography", "misc", "lexical_illusions", "psychology", "dates_times", "hedging")

PRODUCT_CODE = ("snakesim", "snakesim_*", "examples")
GENERATED_MARK = "<!-- generated"  # the first line of a page that a program writes

# Of a page that is read from top to bottom; reference pages are looked up instead.
MAX_PAGE_WORDS = 1200
MAX_SENTENCE_WORDS = 45
MIN_REPEATED_WORDS = 8  # shorter sentences may occur twice
MAX_SEMICOLONS_PER_1000_WORDS = 3.0


@dataclass(frozen=True)
class Rejected:
    """One entry of the reject list."""

    pattern: re.Pattern[str]
    instead: str
    docs_only: bool


@dataclass(frozen=True)
class Problem:
    """One thing to correct, at one line of one file."""

    file: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text}"


@dataclass(frozen=True)
class PageFigures:
    """The measurements of one page."""

    file: str
    words: int
    semicolons: int
    second_person: int  # occurrences of "you" and "your"
    sentences: int
    pictures: int
    tables: int
    tables_without_header: int

    @property
    def semicolons_per_1000_words(self) -> float:
        """Return how many semicolons stand in a thousand words."""
        return 1000 * self.semicolons / max(self.words, 1)


def main() -> int:
    """Check everything, or print the figures. Returns the exit code."""
    parser = argparse.ArgumentParser(
        description="Check the English of documentation, docstrings and messages."
    )
    parser.add_argument(
        "--figures", action="store_true", help="print the measurements of every page instead"
    )
    arguments = parser.parse_args()
    pages = list_pages()
    if arguments.figures:
        print_figures([measure_page(page) for page in pages])
        return 0
    rejected = read_reject_list()
    problems = [problem for page in pages for problem in check_page(page, rejected)]
    problems += [problem for file in list_code_files() for problem in check_code(file, rejected)]
    problems += run_proselint(pages)
    for problem in problems:
        print(problem)
    if problems:
        print(
            f"{len(problems)} problems; docs/style/reject.toml lists what to write instead",
            file=sys.stderr,
        )
    return 1 if problems else 0


def read_reject_list() -> list[Rejected]:
    """Return the entries of `reject.toml`."""
    entries = tomllib.loads(REJECT_FILE.read_text(encoding="utf-8"))["reject"]
    return [
        Rejected(
            pattern=re.compile(rf"(?<![\w/`.-])({entry['pattern']})(?![\w/`-])", re.IGNORECASE),
            instead=entry["instead"],
            docs_only=entry.get("where") == "docs",
        )
        for entry in entries
    ]


def list_pages() -> list[Path]:
    """Return the Markdown pages that people write: tracked files, without the changelog and the development notes."""
    pages = _list_tracked("*.md")
    return [
        page
        for page in pages
        if page.name != "CHANGELOG.md" and "docs/development/" not in page.as_posix()
    ]


def list_code_files() -> list[Path]:
    """Return the tracked Python files of the product and of the examples."""
    return [file for file in _list_tracked(*PRODUCT_CODE) if file.suffix == ".py"]


def _list_tracked(*patterns: str) -> list[Path]:
    command = ["git", "ls-files", "--", *patterns]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


def check_page(page: Path, rejected: list[Rejected]) -> Iterator[Problem]:
    """Yield the problems of a page: words, sentences, headings and tables that readers stumble over."""
    file = page.relative_to(ROOT).as_posix()
    lines = page.read_text(encoding="utf-8").splitlines()
    prose = remove_code(lines)
    for number, line in enumerate(prose, start=1):
        for problem in find_rejected(line, rejected, in_docs=True):
            yield Problem(file, number, problem)
    for number in find_tables_without_header(prose):
        yield Problem(file, number, "a table has an empty header cell; name the column")
    for number in find_empty_sections(lines):
        yield Problem(file, number, "a heading without text; remove it, or write the section")
    if not _is_looked_up(file):
        for number, sentence in find_repeated_sentences(prose):
            yield Problem(file, number, f"this page says it twice: {sentence}")
    for number, words in find_long_sentences(prose):
        yield Problem(
            file, number, f"a sentence of {words} words; at most {MAX_SENTENCE_WORDS}, better 20"
        )
    if lines and lines[0].startswith(GENERATED_MARK):
        return
    figures = measure_page(page)
    if figures.words > MAX_PAGE_WORDS and not _is_looked_up(file):
        yield Problem(
            file, 1, f"{figures.words} words; at most {MAX_PAGE_WORDS} a page: split it by topic"
        )
    if figures.words > 200 and figures.semicolons_per_1000_words > MAX_SEMICOLONS_PER_1000_WORDS:
        yield Problem(
            file,
            1,
            f"{figures.semicolons} semicolons in {figures.words} words; write two sentences",
        )


def _is_looked_up(file: str) -> bool:
    """Tell whether a page belongs to the reference, which readers search instead of reading it."""
    return file.startswith(("docs/reference/", "docs/benchmarks/", "schemas/", "benchmarks/"))


def check_code(file: Path, rejected: list[Rejected]) -> Iterator[Problem]:
    """Yield the rejected words in the docstrings and texts of a Python file."""
    name = file.relative_to(ROOT).as_posix()
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
            continue
        for offset, line in enumerate(node.value.splitlines()):
            if len(line.split()) < 3:  # a key, a pattern or a unit, but no sentence
                continue
            for problem in find_rejected(line, rejected, in_docs=False):
                yield Problem(name, node.lineno + offset, problem)


def find_rejected(line: str, rejected: list[Rejected], *, in_docs: bool) -> Iterator[str]:
    """Yield what is wrong with the words of one line."""
    for entry in rejected:
        if entry.docs_only and not in_docs:
            continue
        for match in entry.pattern.finditer(line):
            yield f"{match.group(1)!r}: write {entry.instead}"


def remove_code(lines: list[str]) -> list[str]:
    """Return the lines of a page with code blocks, inline code, comments and link targets left empty."""
    prose = []
    fence = ""
    for line in lines:
        mark = re.match(r"\s*(```+|~~~+)", line)
        if mark and (not fence or line.strip().startswith(fence)):
            fence = "" if fence else mark.group(1)
            prose.append("")
        elif fence:
            prose.append("")
        else:
            without_code = re.sub(r"`[^`]*`", "`code`", line)
            without_comments = re.sub(r"<!--.*?-->", "", without_code)
            prose.append(re.sub(r"\]\([^)]*\)", "]", without_comments))
    return prose


def find_tables_without_header(prose: list[str]) -> Iterator[int]:
    """Yield the line numbers of table headers with an empty cell."""
    for number, (line, following) in enumerate(zip(prose, [*prose[1:], ""], strict=True), start=1):
        is_header = line.lstrip().startswith("|") and re.fullmatch(r"\s*\|[\s:|-]+\|\s*", following)
        if is_header and any(not cell.strip() for cell in line.strip().strip("|").split("|")):
            yield number


def find_empty_sections(lines: list[str]) -> Iterator[int]:
    """Yield the line numbers of headings whose section ends before it has any text."""
    last_line = last_level = 0  # of a heading without text so far; level 0: there is none
    fence = False
    for number, line in enumerate([*lines, "# end"], start=1):
        fence ^= line.lstrip().startswith(("```", "~~~"))
        heading = None if fence else re.match(r"(#+) ", line)
        if heading:
            level = len(heading.group(1))
            if last_level and level <= last_level:
                yield last_line
            last_line, last_level = number, level
        elif line.strip():
            last_level = 0


def find_repeated_sentences(prose: list[str]) -> Iterator[tuple[int, str]]:
    """Yield the line number of each paragraph that repeats a sentence of its page, with the sentence."""
    seen: set[str] = set()
    for number, paragraph in _list_paragraphs(prose):
        for sentence in _split_sentences(paragraph):
            if len(sentence.split()) < MIN_REPEATED_WORDS:
                continue
            if sentence in seen:
                yield number, sentence
            seen.add(sentence)


def find_long_sentences(prose: list[str]) -> Iterator[tuple[int, int]]:
    """Yield the line number and the number of words of every sentence that is too long."""
    for number, paragraph in _list_paragraphs(prose):
        for sentence in _split_sentences(paragraph):
            words = len(sentence.split())
            if words > MAX_SENTENCE_WORDS:
                yield number, words


def _list_paragraphs(prose: list[str]) -> Iterator[tuple[int, str]]:
    """Yield each paragraph or list item with its first line number; headings, tables and code are left out."""
    start, parts = 0, list[str]()
    for number, line in enumerate([*prose, ""], start=1):
        text = line.strip()
        is_item = re.match(r"([-*+]|\d+\.)\s", text)
        is_prose = text and not text.startswith(("#", "|", ">", "<", "!["))
        if parts and (not is_prose or is_item):
            yield start, " ".join(parts)
            parts = []
        if is_prose:
            start = start if parts else number
            parts.append(text)


def _split_sentences(paragraph: str) -> list[str]:
    return [part for part in re.split(r"(?<=[.!?:])\s+(?=[A-Z`\[*(0-9])", paragraph) if part]


def measure_page(page: Path) -> PageFigures:
    """Return the measurements of one page."""
    lines = page.read_text(encoding="utf-8").splitlines()
    prose = remove_code(lines)
    paragraphs = [text for _, text in _list_paragraphs(prose)]
    text = " ".join(paragraphs)
    headers = [
        n for n in range(len(prose) - 1) if re.fullmatch(r"\s*\|[\s:|-]+\|\s*", prose[n + 1])
    ]
    return PageFigures(
        file=page.relative_to(ROOT).as_posix(),
        words=len(text.split()),
        semicolons=text.count(";"),
        second_person=len(re.findall(r"\byour?s?\b", text, re.IGNORECASE)),
        sentences=sum(len(_split_sentences(paragraph)) for paragraph in paragraphs),
        pictures=sum(len(re.findall(r"!\[|<img ", line)) for line in lines),
        tables=len(headers),
        tables_without_header=len(list(find_tables_without_header(prose))),
    )


def print_figures(figures: list[PageFigures]) -> None:
    """Print one line a page, and the totals."""
    print(
        f"{'page':52} {'words':>6} {'; /1000':>8} {'you /1000':>9} {'pictures':>8} {'tables':>6} {'no header':>9}"
    )
    for page in figures:
        _print_row(page.file, [page])
    _print_row(f"all {len(figures)} pages", figures)


def _print_row(name: str, pages: list[PageFigures]) -> None:
    words = sum(page.words for page in pages)
    semicolons = 1000 * sum(page.semicolons for page in pages) / max(words, 1)
    second_person = 1000 * sum(page.second_person for page in pages) / max(words, 1)
    pictures = sum(page.pictures for page in pages)
    tables = sum(page.tables for page in pages)
    without_header = sum(page.tables_without_header for page in pages)
    print(
        f"{name:52} {words:6} {semicolons:8.1f} {second_person:9.1f} {pictures:8} {tables:6} {without_header:9}"
    )


def run_proselint(pages: list[Path]) -> list[Problem]:
    """Return what proselint reports about the pages, whose code is hidden from it."""
    with tempfile.TemporaryDirectory() as folder:
        copies = {}
        for number, page in enumerate(pages):
            copy = Path(folder, f"{number}.md")
            copy.write_text(
                "\n".join(remove_code(page.read_text(encoding="utf-8").splitlines())),
                encoding="utf-8",
            )
            copies[copy.as_posix()] = page.relative_to(ROOT).as_posix()
        command = [Path(sys.executable).with_name("proselint"), "check", *copies]
        finished = subprocess.run(command, capture_output=True, text=True, check=False)
        if finished.returncode not in PROSELINT_EXIT_CODES:
            sys.exit(f"check_prose: proselint failed: {finished.stderr.strip()}")
        found = re.findall(r"^(/\S+\.md):(\d+):\d+: (.*)$", finished.stdout, re.MULTILINE)
        return [
            Problem(copies[copy], int(line), text)
            for copy, line, text in found
            if copy in copies and not text.startswith(IGNORED_CHECKS)
        ]


if __name__ == "__main__":
    sys.exit(main())
