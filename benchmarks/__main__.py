"""`python -m benchmarks [SECTION ...] [--list] [--write]`: measure, print, and keep the tables in RESULTS.md."""

import argparse
import platform
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.sections import SECTIONS, ResultSection
from benchmarks.table import replace_section

RESULTS = Path(__file__).parent / "RESULTS.md"


def measure_section(section: ResultSection) -> str:
    """Measure a section, print every line as soon as it is known, and return the text of the section."""
    lines: list[str] = []

    def report(line: str) -> None:
        print(line, flush=True)
        lines.append(line)

    day = datetime.now(tz=UTC).date().isoformat()
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    needs = " Wall time: use a quiet machine." if section.needs_quiet_machine else ""
    report(f"\n## {section.title}\n")
    del lines[:]
    report(
        f"Measured by `python -m benchmarks {section.name} --write` on {day} ({machine}).{needs}\n"
    )
    section.measure(report)
    return "\n".join(lines)


def main() -> int:
    """Do the benchmarks, all of them or those that are named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    names = [section.name for section in SECTIONS]
    parser.add_argument(
        "sections",
        metavar="SECTION",
        nargs="*",
        help=f"one or more of {', '.join(names)}; all of them",
    )
    parser.add_argument(
        "--list", action="store_true", help="list the sections, and measure nothing"
    )
    parser.add_argument("--write", action="store_true", help=f"keep the tables in {RESULTS.name}")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.sections if name not in names]
    if unknown:
        parser.error(f"there is no section {unknown[0]!r}; there are {', '.join(names)}")
    for section in SECTIONS:
        if arguments.list:
            clock = (
                "wall time, needs a quiet machine"
                if section.needs_quiet_machine
                else "on any machine"
            )
            print(f"{section.name:10}{section.title} ({clock})")
        elif section.name in arguments.sections or not arguments.sections:
            text = measure_section(section)
            if arguments.write:
                replace_section(RESULTS, section.title, text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
