"""The examples of the Python API and of the docstring of `Controller` run without errors."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import snakesim
from docs.site.api_contents import PAGES, Page

PAGES_THAT_RUN = [
    page for page in PAGES if "snakesim.run" in page.example or "gymnasium" in page.example
]


@pytest.mark.heavy
@pytest.mark.parametrize("page", PAGES_THAT_RUN, ids=lambda page: page.file)
def test_api_page_example_runs(page: Page, tmp_path: Path) -> None:
    program = tmp_path / "example.py"
    program.write_text(page.example, encoding="utf-8")
    completed = subprocess.run(
        [sys.executable, program], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert completed.returncode == 0, completed.stderr


def test_controller_docstring_example_runs(tmp_path: Path) -> None:
    docstring = snakesim.Controller.__doc__ or ""
    _, _, rest = docstring.partition("with one parameter:\n")
    program = tmp_path / "swing.py"
    code = textwrap.dedent(rest.partition("Run it with")[0])
    program.write_text(f"import math\n\nimport snakesim\n{code}", encoding="utf-8")
    result = snakesim.run(
        "triplet", controller=f"{program}:Swing", duration=0.5, set={"control.amplitude_rad": 0.1}
    )
    assert result.complete
