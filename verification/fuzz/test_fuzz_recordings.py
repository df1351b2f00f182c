"""Damaged and forged recordings, into every command: some of what `make fuzz` tries."""

from collections import Counter
from pathlib import Path

import pytest

from verification.fuzz.recordings import COMMANDS, DAMAGES, fuzz, table

pytest.importorskip("viser", reason="needs the extra `console`")
pytest.importorskip("pyarrow", reason="needs the extra `report`")
# MuJoCo's renderer takes 260 MB; what a bomb may unpack to takes a few seconds.
PEAK_MB, CPU_S = 700, 20.0


@pytest.mark.slow
def test_fuzz_recordings_harm_no_command_and_losses_are_reported(tmp_path: Path) -> None:
    verdict = fuzz(tmp_path, copies=len(DAMAGES), seed=1, command_count=2)
    assert not verdict.violations, table(verdict)
    assert (
        verdict.codes.keys() == COMMANDS.keys()
        and verdict.peak_mb < PEAK_MB
        and verdict.longest_cpu_s < CPU_S
    )
    assert {0, 2, 3} <= sum((codes for codes in verdict.codes.values()), Counter[int]()).keys()
