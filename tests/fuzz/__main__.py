"""`python -m tests.fuzz --payloads 1000000`: run, and print what became of every kind of payload."""

import argparse
import time
from collections import Counter

from tests.fuzz.run import run

GROWTH_MB = 16.0  # more than what an allocator keeps back


def main() -> int:
    """0 when no decoder raised anything but a WireError and memory stayed flat."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--payloads", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    started = time.monotonic()
    report = run(asked.payloads, asked.seed)
    total: Counter[str] = Counter()
    for kind, outcomes in sorted(report.outcomes.items()):
        print(f"{kind:14} " + ", ".join(f"{count} {word}" for word, count in outcomes.most_common()))
        total.update(outcomes)
    print("in all         " + ", ".join(f"{count} {word}" for word, count in total.most_common()))
    print("a HAL said     " + ", ".join(f"{word} {count}" for word, count in sorted(report.answers.items())))
    print(
        f"{asked.payloads} payloads of seed {asked.seed} in {time.monotonic() - started:.0f} s; longest error "
        f"{report.longest_reason} characters; memory {report.resident_mb[0]:.0f} MB after a tenth, "
        f"{report.resident_mb[-1]:.0f} MB at the end, {report.peak_mb:.0f} MB at most"
    )
    return 0 if report.growth_mb <= GROWTH_MB else 1


if __name__ == "__main__":
    raise SystemExit(main())
