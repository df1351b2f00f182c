"""`python -m verification.fuzz [--payloads 1000000] [--network]`: feed invalid payloads to all decoders.

Without `--network`, the decoders run in this process: those of messages, files, datagrams and CAN frames. Damaged
recordings go into every command that reads one. With `--network`, a robot is started and armed, and an unauthorized
client on its network sends to every key and asks every query.

Prints how many payloads of each kind had which result. The exit code is 0 if only allowed errors were raised, memory
did not grow, and a running robot was not affected. It is 1 otherwise.
"""

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from verification.fuzz.all_inputs import open_all_inputs
from verification.fuzz.bus import fuzz_bus
from verification.fuzz.decoders import fuzz_decoders
from verification.fuzz.inputs import fuzz_inputs
from verification.fuzz.network import FuzzRequest, fuzz_network
from verification.fuzz.network_verdict import format_verdict
from verification.fuzz.recordings import format_verdict as format_recordings_verdict
from verification.fuzz.recordings import fuzz_recordings

MAX_GROWTH_MB = 16.0  # more than an allocator keeps
DEFAULT_RATE_HZ = 4000.0  # which two cores can process in addition to the robot
PAYLOADS_PER_RECORDING = 10_000
PAYLOADS_PER_FRAME = 10  # on a CAN bus, and per payload for files, datagrams and options
TEMPORARY_PREFIX = "snakesim-fuzz-"


def main() -> int:
    """Parse the options, feed the payloads, and return the exit code."""
    options = _parse_options()
    if options.network:
        return fuzz_running_robot(options)
    return fuzz_in_process(options)


def _parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m verification.fuzz",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--payloads",
        type=int,
        default=1_000_000,
        help="payloads for the decoders of messages, or over the network; a tenth of this number goes to all files, "
        "datagrams and options together, and a tenth to a CAN bus; 0 for recordings alone (%(default)s)",
    )
    parser.add_argument(
        "--seed", type=int, default=1, help="selects the payloads and the damages (%(default)s)"
    )
    in_process = parser.add_argument_group("in this process")
    in_process.add_argument(
        "--recordings",
        type=int,
        metavar="N",
        help=f"damaged recordings (default: one for every {PAYLOADS_PER_RECORDING} payloads)",
    )
    in_process.add_argument(
        "--commands-per-recording",
        type=int,
        metavar="N",
        help="commands that get each damaged recording, in turn, in addition to `export mcap` (default: all)",
    )
    over_network = parser.add_argument_group("over the network")
    over_network.add_argument(
        "--network", action="store_true", help="send to a running robot over its network"
    )
    over_network.add_argument(
        "--rate", type=float, default=DEFAULT_RATE_HZ, help="payloads per second (%(default)g)"
    )
    over_network.add_argument(
        "--backend", default="sim", help="backend of the robot: sim or can (%(default)s)"
    )
    over_network.add_argument(
        "--robot-hz", type=float, default=100.0, help="control rate of the robot (%(default)g)"
    )
    over_network.add_argument(
        "--out", type=Path, help="folder of the run (default: a temporary folder)"
    )
    return parser.parse_args()


def fuzz_running_robot(options: argparse.Namespace) -> int:
    """Start a robot, send payloads over its network, print the result, and return the exit code."""
    request = FuzzRequest(
        payload_count=options.payloads,
        rate_hz=options.rate,
        seed=options.seed,
        backend=options.backend,
        robot_hz=options.robot_hz,
    )
    with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX) as temporary:
        out = (options.out or Path(temporary) / "run").resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        verdict = fuzz_network(out, request)
    print(format_verdict(verdict))
    return 1 if verdict.violations else 0


def fuzz_in_process(options: argparse.Namespace) -> int:
    """Feed all payloads to decoders in this process, print the results, and return the exit code."""
    recording_count = options.recordings
    if recording_count is None:
        recording_count = options.payloads // PAYLOADS_PER_RECORDING
    if options.payloads > 0:
        _fuzz_all_inputs(options.payloads // PAYLOADS_PER_FRAME, options.seed)
        _fuzz_bus(options.payloads // PAYLOADS_PER_FRAME, options.seed)
    is_passed = True
    if recording_count > 0:
        is_passed = _fuzz_recordings(recording_count, options.seed, options.commands_per_recording)
    if options.payloads > 0 and is_passed:
        is_passed = _fuzz_decoders(options.payloads, options.seed)
    return 0 if is_passed else 1


def _fuzz_all_inputs(payload_count: int, seed: int) -> None:
    """Feed payloads to files, datagrams and options, an equal number to each, and print the results."""
    with (
        tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX) as folder,
        open_all_inputs(Path(folder)) as inputs,
    ):
        reports = fuzz_inputs(inputs, max(payload_count // len(inputs), 1), seed)
    for name, report in reports.items():
        outcomes = _format_counts(report.outcomes)
        print(f"{name:24} {outcomes}; {1e3 * report.max_duration_s:.0f} ms at most")


def _fuzz_bus(frame_count: int, seed: int) -> None:
    """Send frames on a CAN bus, and print the results."""
    counts = fuzz_bus(frame_count, seed)
    print(f"{'frames on a CAN bus':24} {_format_counts(counts)}")


def _fuzz_recordings(count: int, seed: int, commands_per_recording: int | None) -> bool:
    """Feed damaged recordings to commands, print the results, and return whether all is as it must be."""
    with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX) as folder:
        verdict = fuzz_recordings(Path(folder), count, seed, commands_per_recording)
    print(format_recordings_verdict(verdict))
    return not verdict.violations


def _fuzz_decoders(payload_count: int, seed: int) -> bool:
    """Feed payloads to the decoders of messages, print the results, and return whether memory did not grow."""
    start_s = time.monotonic()
    report = fuzz_decoders(payload_count, seed)
    totals: Counter[str] = Counter()
    for mutation, outcomes in sorted(report.outcomes.items()):
        print(f"{mutation:14} {_format_counts(outcomes)}")
        totals.update(outcomes)
    print(f"{'total':14} {_format_counts(totals)}")
    reactions = ", ".join(f"{name} {count}" for name, count in sorted(report.reactions.items()))
    print(f"{'HAL':14} {reactions}")
    print(
        f"{payload_count} payloads of seed {seed} in {time.monotonic() - start_s:.0f} s; "
        f"longest error {report.max_reason_characters} characters; "
        f"memory {report.resident_mb[0]:.0f} MB after a tenth, {report.resident_mb[-1]:.0f} MB at the end, "
        f"{report.peak_mb:.0f} MB at most"
    )
    return report.growth_mb <= MAX_GROWTH_MB


def _format_counts(counts: Mapping[str, int]) -> str:
    """Format counts by name, the largest first."""
    largest_first = Counter(counts).most_common()
    return ", ".join(f"{count} {name}" for name, count in largest_first)


if __name__ == "__main__":
    raise SystemExit(main())
