"""Tests of the programs in examples/ that have no other test, and of the page that describes all."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[3]


@pytest.mark.heavy
def test_example_policy_is_evaluated_on_an_unseen_scene() -> None:
    command = [sys.executable, "examples/held_out.py", "clutter", "98100", "1"]
    completed = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=110
    )
    assert completed.returncode == 0, completed.stderr
    assert re.search(
        r"^98100: (goal|stuck|.+), \d+\.\d\d m in \d+\.\d\d s, \d+ J$",
        completed.stdout,
        re.MULTILINE,
    )
    assert re.search(r"^clutter : reached the goal in [01] of 1$", completed.stdout, re.MULTILINE)


def test_examples_page_describes_every_example() -> None:
    page = (REPOSITORY / "examples" / "README.md").read_text()
    files = [
        path.name for path in (REPOSITORY / "examples").glob("*.*") if path.name != "README.md"
    ]
    assert files
    assert all(f"`{name}`" in page for name in files)
