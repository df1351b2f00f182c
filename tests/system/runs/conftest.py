"""The programs of a lab on this computer, ended with the test."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_testing.runs.lab_programs import LabPrograms


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[LabPrograms]:
    with contextlib.ExitStack() as stack:
        yield LabPrograms(tmp_path, stack)
