"""Feeds damaged and forged recordings to every command: a small part of what `python -m verification.fuzz` tries."""

from collections import Counter
from pathlib import Path

import pytest

from verification.fuzz.recording_damages import DAMAGES
from verification.fuzz.recordings import (
    COMMANDS,
    DONE,
    INCOMPLETE,
    REFUSED,
    format_verdict,
    fuzz_recordings,
)

pytest.importorskip("viser", reason="needs the extra `console`")
pytest.importorskip("pyarrow", reason="needs the extra `report`")
MAX_PEAK_MB = 700  # the renderer of MuJoCo takes 260 MB, and all imports take 130 MB
MAX_CPU_S = 20.0  # a recording that unpacks to gigabytes takes a few seconds


@pytest.mark.slow
def test_fuzz_recordings_harm_no_command_and_losses_are_reported(tmp_path: Path) -> None:
    verdict = fuzz_recordings(tmp_path, len(DAMAGES), seed=1, commands_per_recording=2)
    assert not verdict.violations, format_verdict(verdict)
    assert verdict.exit_codes.keys() == COMMANDS.keys()
    assert verdict.peak_mb < MAX_PEAK_MB
    assert verdict.max_cpu_s < MAX_CPU_S
    exit_codes: Counter[int] = Counter()
    for codes_of_command in verdict.exit_codes.values():
        exit_codes += codes_of_command
    assert {DONE, REFUSED, INCOMPLETE} <= exit_codes.keys()
