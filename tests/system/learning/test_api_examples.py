"""The examples of the Python API that run a scenario, and the one in the docstring of `Controller`."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import snakesim
from docs.site.api_contents import PAGES, Page

RUNS = [page for page in PAGES if "snakesim.run" in page.example or "gymnasium" in page.example]


@pytest.mark.parametrize("page", RUNS, ids=lambda page: page.file)
def test_the_example_runs(page: Page, tmp_path: Path) -> None:
    program = tmp_path / "example.py"
    program.write_text(page.example, encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, program], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr


def test_the_controller_of_the_docstring_runs(tmp_path: Path) -> None:
    _, _, rest = (snakesim.Controller.__doc__ or "").partition("with one parameter:\n")
    program = tmp_path / "swing.py"
    code = textwrap.dedent(rest.partition("Run it with")[0])
    program.write_text(f"import math\n\nimport snakesim\n{code}", encoding="utf-8")
    result = snakesim.run(
        "triplet", controller=f"{program}:Swing", duration=0.5, set={"control.amplitude_rad": 0.1}
    )
    assert result.complete
