"""Provides the programs of a lab, which run on this computer and end with the test."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_testing.runs.lab_programs import LabPrograms


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[LabPrograms]:
    """Provide a starter of programs; it ends all of them after the test."""
    with contextlib.ExitStack() as stack:
        yield LabPrograms(tmp_path, stack)
