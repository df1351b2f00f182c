"""Finds out within a second whether a change of the firmware changes its answers to random traffic.

The traffic is that of tests/system/firmware/test_agreement.py. There, the emulator agrees with the unchanged firmware.
So that test fails for each change that this check finds, and need not run.
"""

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from snakesim_native.compile import list_compilers, run_and_get_error
from snakesim_native.libraries import PACKAGE
from snakesim_native.programs import JOINT_MODULE_REPLAY, POSIX_FLAGS, STRICT_FLAGS
from snakesim_testing.can.firmware_replay import Answer, parse_answers
from snakesim_testing.can.firmware_traffic import Traffic
from verification.mutation.firmware.faulty_copy import FIRMWARE_FOLDER, DoesNotCompileError

EVENTS_PER_SEED = 2000
SEEDS = range(6)
# A change may let the program run or print without end. Seconds of processor time, and blocks of 512 bytes.
LIMITED_RUN = 'ulimit -t 10 && ulimit -f 100000 && exec "$0"'


class TrafficCheck:
    """The random traffic, and the answers of the unchanged firmware."""

    def __init__(self, folder: Path) -> None:
        """Compile the unchanged firmware, and run the traffic.

        Args:
            folder: Empty folder for compiled files.

        Raises:
            DoesNotCompileError: The firmware does not compile.
        """
        self._folder = folder
        self._traffic = [Traffic(seed).generate_events(EVENTS_PER_SEED) for seed in SEEDS]
        self._object_by_file = {
            source.name: _compile_object(source, folder / f"{source.stem}.o")
            for source in JOINT_MODULE_REPLAY.list_sources()
        }
        program = _link([*self._object_by_file.values()], folder / "unchanged")
        self._expected = [_run_limited(program, events) for events in self._traffic]

    def finds_difference(self, file: str, source: str) -> bool:
        """Return whether the firmware answers differently if a file has another content.

        Args:
            file: Name of a C file of the firmware.
            source: Its content.

        Raises:
            DoesNotCompileError: The compiler refuses it.
        """
        changed_file = self._folder / file
        changed_file.write_text(source, encoding="utf-8")
        changed_object = _compile_object(changed_file, self._folder / "changed.o")
        objects = {**self._object_by_file, file: changed_object}
        program = _link([*objects.values()], self._folder / "changed")
        return any(
            not _are_equal(expected, _run_limited(program, events))
            for events, expected in zip(self._traffic, self._expected, strict=True)
        )


def _compile_object(source: Path, compiled: Path) -> Path:
    """Compile one file, as `get_program` does. It finds the headers of the unchanged firmware."""
    headers = ["-iquote", str(PACKAGE / FIRMWARE_FOLDER)]
    _run_compiler([*STRICT_FLAGS, *POSIX_FLAGS, *headers, "-c", str(source), "-o", str(compiled)])
    return compiled


def _link(objects: Sequence[Path], program: Path) -> Path:
    _run_compiler([*map(str, objects), "-lm", "-o", str(program)])
    return program


def _run_compiler(arguments: Sequence[str]) -> None:
    problem = run_and_get_error([*list_compilers()[0], *arguments])
    if problem:
        raise DoesNotCompileError(problem)


def _run_limited(program: Path, events: Sequence[str]) -> list[Answer] | None:
    """Return the answers to some events; None if the program crashed, or did not end."""
    with tempfile.TemporaryFile("w+") as output:
        completed = subprocess.run(
            ["sh", "-c", LIMITED_RUN, str(program)],
            input="\n".join(events) + "\n",
            stdout=output,
            stderr=subprocess.DEVNULL,
            text=True,
            check=False,
        )
        if completed.returncode != 0:
            return None
        output.seek(0)
        return parse_answers(events, output.read().splitlines())


def _are_equal(expected: list[Answer] | None, actual: list[Answer] | None) -> bool:
    if expected is None or actual is None:
        return False
    return all(a.agrees_with(b) for a, b in zip(expected, actual, strict=True))
