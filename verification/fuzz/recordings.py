"""Feeds damaged and forged copies of a recording to every command that reads one.

A command may do its work, do it and report what is lost, or refuse the recording in a few lines, within the limits of
`forked_commands`. It violates its promise if it raises an error, exceeds a limit, or hides a loss that another command
reports.
"""

import random
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.operator.damaged_recordings import record_short_run
from verification.fuzz.forked_commands import CommandOutcome, RunCommand, start_command_server
from verification.fuzz.recording_damages import DAMAGES

DURATION_S = 0.6
CHUNK_BYTES = 40_000  # which gives the recording about 16 chunks
# More than a campaign damages, so that no two seeds share a damage.
MAX_RECORDINGS_PER_SEED = 100_000

DAMAGED_FILENAME = "damaged.mcap"
WHOLE_FILENAME = "whole.mcap"
OUTPUT_NAME = "output"
FILM_OPTIONS = ("--out", "film.gif", "--width", "32", "--height", "32", "--fps", "5")
EXPORT_FORMATS = ("csv", "npz", "mcap", "parquet", "lerobot")


def _make_export_command(export_format: str) -> list[str]:
    options = ["--format", export_format, "--out", OUTPUT_NAME]
    return ["recording", "export", DAMAGED_FILENAME, *options]


COMMANDS: dict[str, list[str]] = {
    "info": ["recording", "info", DAMAGED_FILENAME],
    "info --json": ["recording", "info", DAMAGED_FILENAME, "--json"],
    "report": ["recording", "report", DAMAGED_FILENAME],
    "compare with it": ["study", "compare", WHOLE_FILENAME, DAMAGED_FILENAME],
    "compare it": ["study", "compare", DAMAGED_FILENAME, WHOLE_FILENAME, "--json"],
    **{f"export {name}": _make_export_command(name) for name in EXPORT_FORMATS},
    "replay": ["replay", DAMAGED_FILENAME, "--speed", "1000000"],
    "replay --control": ["replay", DAMAGED_FILENAME, "--control"],
    "video": ["recording", "video", DAMAGED_FILENAME, *FILM_OPTIONS],
    "console": ["console", DAMAGED_FILENAME, "--port", "0"],
}
# Reads every message. If it reports a loss, every other command must report one.
REFERENCE_COMMAND = "export mcap"

DONE = 0
FAILED = 1
REFUSED = 2
INCOMPLETE = 3
ALLOWED_EXIT_CODES = (DONE, FAILED, REFUSED, INCOMPLETE)
MAX_REFUSAL_LINES = 4
MAX_QUOTED_CHARACTERS = 1500  # of the end of stderr in a violation


@dataclass
class RecordingsVerdict:
    """How all commands ended, and which of them violated their promise."""

    # By command.
    exit_codes: dict[str, Counter[int]] = field(default_factory=dict[str, Counter[int]])
    violations: list[str] = field(default_factory=list[str])
    max_cpu_s: float = 0.0
    peak_mb: float = 0.0

    def add_outcome(self, command_name: str, outcome: CommandOutcome) -> None:
        """Count the exit code of a command, and remember the largest use of CPU time and memory."""
        self.exit_codes.setdefault(command_name, Counter())[outcome.exit_code] += 1
        self.max_cpu_s = max(self.max_cpu_s, outcome.cpu_s)
        self.peak_mb = max(self.peak_mb, outcome.peak_mb)


def fuzz_recordings(
    folder: Path, recording_count: int, seed: int, commands_per_recording: int | None = None
) -> RecordingsVerdict:
    """Record a short run, and feed damaged copies of the recording to commands.

    Args:
        folder: An empty folder for all files.
        recording_count: The number of damaged copies. The damages take turns.
        seed: Selects the damages.
        commands_per_recording: How many commands get each copy in addition to the reference command. The commands
            take turns. None for all commands.
    """
    record_short_run(folder / "run", DURATION_S, CHUNK_BYTES)
    whole = (folder / "run" / RECORDING_FILENAME).read_bytes()
    names = [name for name in COMMANDS if name != REFERENCE_COMMAND]
    if commands_per_recording is None:
        commands_per_recording = len(names)
    verdict = RecordingsVerdict()
    with start_command_server(folder) as run_command:
        for number in range(recording_count):
            damage = DAMAGES[number % len(DAMAGES)]
            damaged = damage(random.Random(seed * MAX_RECORDINGS_PER_SEED + number), whole)
            first = number * commands_per_recording
            chosen_names = [
                names[i % len(names)] for i in range(first, first + commands_per_recording)
            ]
            trial = _RecordingTrial(folder / f"{number}", damaged, whole, run_command, verdict)
            trial.run(f"{damage.__name__} {number}", [REFERENCE_COMMAND, *chosen_names])
    return verdict


@dataclass(frozen=True)
class _RecordingTrial:
    """One damaged recording that is fed to several commands, each in a fresh folder."""

    folder: Path
    damaged: bytes
    whole: bytes
    run_command: RunCommand
    verdict: RecordingsVerdict

    def run(self, description: str, command_names: Sequence[str]) -> None:
        """Run the commands, of which the reference command must be the first."""
        has_loss = False
        for name in command_names:
            outcome = self._run_command(name)
            self.verdict.add_outcome(name, outcome)
            if name == REFERENCE_COMMAND:
                has_loss = outcome.exit_code == INCOMPLETE
            if violation := _find_violation(outcome, has_loss=has_loss):
                quoted = outcome.stderr[-MAX_QUOTED_CHARACTERS:]
                self.verdict.violations.append(
                    f"{description}, {name}: exit code {outcome.exit_code}, {violation}: {quoted}"
                )
        shutil.rmtree(self.folder)

    def _run_command(self, name: str) -> CommandOutcome:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        (self.folder / DAMAGED_FILENAME).write_bytes(self.damaged)
        (self.folder / WHOLE_FILENAME).write_bytes(self.whole)
        arguments = list(COMMANDS[name])
        if name == "replay":
            arguments += ["--endpoint", find_free_endpoint()]
        return self.run_command(self.folder, *arguments)


def _find_violation(outcome: CommandOutcome, *, has_loss: bool) -> str | None:
    """Return which promise a command has violated, or None.

    Args:
        outcome: How the command ended.
        has_loss: Whether the reference command has reported that messages are lost.
    """
    if outcome.exit_code not in ALLOWED_EXIT_CODES:
        return "which no command may end with"
    if "Traceback" in outcome.stdout + outcome.stderr:
        return "with a traceback"
    if outcome.exit_code == DONE and has_loss:
        return "although messages are lost"
    if outcome.exit_code == INCOMPLETE and "incomplete: " not in outcome.stderr:
        return "without the message what is lost"
    if outcome.exit_code == REFUSED and not _is_short_message(outcome.stderr):
        return "without a short message"
    return None


def _is_short_message(text: str) -> bool:
    return 0 < len(text.splitlines()) <= MAX_REFUSAL_LINES


def format_verdict(verdict: RecordingsVerdict) -> str:
    """Format how often each command ended with which exit code, and all violations."""
    lines: list[str] = []
    for name, exit_codes in verdict.exit_codes.items():
        counts = ", ".join(
            f"{count} with exit code {code}" for code, count in sorted(exit_codes.items())
        )
        lines.append(f"{name:<18}{counts}")
    lines.append(f"at most {verdict.max_cpu_s:.1f} s of CPU time, and {verdict.peak_mb:.0f} MB")
    return "\n".join([*lines, *verdict.violations])
