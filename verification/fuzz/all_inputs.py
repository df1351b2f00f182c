"""Opens all inputs that decode datagrams, files and options."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from snakesim_testing.runs.in_process_command import snakesim
from verification.fuzz.datagram_inputs import open_motion_capture, open_stop_server
from verification.fuzz.file_inputs import list_file_inputs, list_run_inputs, list_text_inputs
from verification.fuzz.inputs import DecoderInput

# Each payload for a file of the run makes a command read all files of the run, so the run is as short as it may be.
RUN_DURATION_S = 0.1


@contextmanager
def open_all_inputs(folder: Path) -> Iterator[list[DecoderInput]]:
    """Open every input, and close all with the `with` block.

    Args:
        folder: An empty folder for the files. A short run is recorded there, whose files the payloads replace.
    """
    with pytest.MonkeyPatch.context() as patched:
        # Where the product keeps what outlives a run.
        patched.setenv("XDG_STATE_HOME", str(folder))
        run = _record_run(folder)
        with open_motion_capture() as motion_capture, open_stop_server() as stop_server:
            yield [
                motion_capture,
                stop_server,
                *list_text_inputs(),
                *list_file_inputs(folder, run),
                *list_run_inputs(run),
            ]


def _record_run(folder: Path) -> Path:
    """Record a short run, and return its folder."""
    run = folder / "record"
    options = ("--in-process", "--duration", str(RUN_DURATION_S), "--out", str(run))
    ended = snakesim("run", "triplet", *options, cwd=folder)
    assert ended.code == 0, ended.out + ended.err
    return run
