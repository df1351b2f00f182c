"""A result that was made of an incomplete record: said on stderr, and by one exit code, whatever the command."""

from collections.abc import Sequence
from pathlib import Path

from snakesim_hal.base.terminal import print_stderr

INCOMPLETE = 3
"""Exit code: done, but the record lacks something."""


def exit_code(given: Path, lacks: Sequence[str], code: int = 0) -> int:
    """The exit code of a command whose own one is `code`. Says on stderr what the record lacks."""
    if lacks:
        print_stderr(f"snakesim: incomplete: {given} lacks {'; '.join(lacks)}")
    return code or (INCOMPLETE if lacks else 0)
