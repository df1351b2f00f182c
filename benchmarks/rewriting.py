"""`python -m benchmarks.rewriting RUN...`: what a recorder costs and an hour takes, by writing recordings again.

CPU time, so that a busy machine matters little. Topics for viewers are made again, or left out. The share of a core
is that of the writing alone, without what receiving the messages costs.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from snakesim_hal.network.session import Arrival
from snakesim_operator.playback.info import recording_of
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recording import FLUSH_S, Recording

TIMES = 5


def rewrite(arrivals: Sequence[Arrival], path: Path, shown_as: str | None) -> tuple[float, int]:
    """CPU seconds and bytes of a recording of these messages, in chunks as in real time."""
    recording, began_s = Recording(path, shown_as), time.process_time()
    flush_ns = 0
    for arrival in arrivals:
        recording.take(arrival)
        if arrival.monotonic_ns >= flush_ns:
            recording.flush()
            flush_ns = arrival.monotonic_ns + round(FLUSH_S * 1e9)
    recording.close({})
    return time.process_time() - began_s, path.stat().st_size


def main() -> int:
    """Print a row for each recording, with and without topics for viewers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folders of runs, or MCAP files")
    print("| recording | messages/s | CPU a message | of a core | an hour on disk |\n|---|---|---|---|---|")
    for run in parser.parse_args().runs:
        found = list(RecordingReader(recording_of(run)).messages())
        arrivals = [Arrival(one.key, one.payload, one.encoding, one.time_ns) for one in found]
        times_ns = [one.time_ns for one in found if one.time_ns]
        lasted_s = (max(times_ns) - min(times_ns)) * 1e-9
        for what, shown_as in (("", "robot"), (", `--raw-only`", None)):
            with tempfile.TemporaryDirectory() as folder:
                written = [rewrite(arrivals, Path(folder) / f"{i}.mcap", shown_as) for i in range(TIMES)]
            cpu_s, size = min(written)
            print(
                f"| {run}{what} | {len(found) / lasted_s:.0f} | {cpu_s / len(found) * 1e6:.1f} us "
                f"| {100 * cpu_s / lasted_s:.2f} % | {size / lasted_s * 3600 / 1e9:.2f} GB |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
