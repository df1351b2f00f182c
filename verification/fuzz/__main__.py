"""`python -m verification.fuzz --payloads 1000000 [--network]`: run, and print what became of every kind of payload.

Without `--network` the decoders are fed in this process. With it, a run of its own is armed, and a stranger on its
network sends to every key and asks every query.
"""

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

from verification.fuzz import bus, inputs, network, recordings
from verification.fuzz.run import run

GROWTH_MB = 16.0  # more than what an allocator keeps back
RATE = 4000.0  # a second: two cores bear the robot and this beside it


def main() -> int:
    """0 when nothing raised anything but a WireError, memory stayed flat, and a running robot took no harm."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--payloads", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--network", action="store_true", help="against a robot that runs, over its network"
    )
    parser.add_argument(
        "--rate", type=float, default=RATE, help="payloads a second over the network (%(default)g)"
    )
    parser.add_argument("--backend", default="sim", help="of the robot that runs: sim or can")
    parser.add_argument(
        "--robot-hz", type=float, default=100.0, help="the robot's own rate (%(default)g)"
    )
    parser.add_argument(
        "--out", type=Path, help="folder of the run over the network (default: a temporary one)"
    )
    asked = parser.parse_args()
    return over_network(asked) if asked.network else in_process(asked)


def over_network(asked: argparse.Namespace) -> int:
    """A robot of its own, and a stranger."""
    with tempfile.TemporaryDirectory(prefix="snakesim-fuzz-") as temporary:
        out = (asked.out or Path(temporary) / "run").resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        request = network.FuzzRequest(
            asked.payloads, asked.rate, asked.seed, asked.backend, robot_hz=asked.robot_hz
        )
        verdict = network.fuzz(out, request)
    print(network.table(verdict))
    return 1 if verdict.violations else 0


def in_process(asked: argparse.Namespace) -> int:
    """Every decoder, and a HAL without a network; of the payloads a tenth more goes to files, and a tenth to a bus.

    For every 10,000 a damaged recording goes into each command that reads one.
    """
    beside_the_wire(asked.payloads // 10, asked.seed)
    if harmed := of_recordings(asked.payloads // 10_000, asked.seed):
        return harmed
    started = time.monotonic()
    report = run(asked.payloads, asked.seed)
    total: Counter[str] = Counter()
    for kind, outcomes in sorted(report.outcomes.items()):
        print(
            f"{kind:14} " + ", ".join(f"{count} {word}" for word, count in outcomes.most_common())
        )
        total.update(outcomes)
    print("in all         " + ", ".join(f"{count} {word}" for word, count in total.most_common()))
    print(
        "a HAL said     "
        + ", ".join(f"{word} {count}" for word, count in sorted(report.answers.items()))
    )
    print(
        f"{asked.payloads} payloads of seed {asked.seed} in {time.monotonic() - started:.0f} s; longest error "
        f"{report.longest_reason} characters; memory {report.resident_mb[0]:.0f} MB after a tenth, "
        f"{report.resident_mb[-1]:.0f} MB at the end, {report.peak_mb:.0f} MB at most"
    )
    return 0 if report.growth_mb <= GROWTH_MB else 1


def of_recordings(copies: int, seed: int) -> int:
    """Damaged copies of a recording. 1 when a command did what it must not."""
    with tempfile.TemporaryDirectory(prefix="snakesim-fuzz-") as folder:
        verdict = recordings.fuzz(Path(folder), copies, seed)
    print(recordings.table(verdict))
    return 1 if verdict.violations else 0


def beside_the_wire(payload_count: int, seed: int) -> None:
    """Datagrams, files, flags; and frames on a CAN bus."""
    with (
        tempfile.TemporaryDirectory(prefix="snakesim-fuzz-") as folder,
        inputs.all_inputs(Path(folder)) as found,
    ):
        for name, outcome in inputs.run(found, max(payload_count // len(found), 1), seed).items():
            words = ", ".join(f"{count} {word}" for word, count in outcome.words.most_common())
            print(f"{name:24} {words}; {1e3 * outcome.longest_s:.0f} ms at most")
    words = bus.run(payload_count, seed)
    print(
        "frames on a CAN bus      "
        + ", ".join(f"{count} {word}" for word, count in words.most_common())
    )


if __name__ == "__main__":
    raise SystemExit(main())
