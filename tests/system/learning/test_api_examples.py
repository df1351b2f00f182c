"""The examples of the Python API that run a scenario, and the one in the docstring of `Controller`."""

import math
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import snakesim
from docs.site.api_pages import PAGES, Page

RUNS = [page for page in PAGES if "snakesim.run" in page.example or "gymnasium" in page.example]


@pytest.mark.parametrize("page", RUNS, ids=lambda page: page.file)
def test_the_example_runs(page: Page, tmp_path: Path) -> None:
    program = tmp_path / "example.py"
    program.write_text(page.example, encoding="utf-8")
    ended = subprocess.run([sys.executable, program], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr


def test_the_controller_of_the_docstring_runs() -> None:
    _, _, rest = (snakesim.Controller.__doc__ or "").partition("with one parameter:\n")
    names: dict[str, object] = {"snakesim": snakesim, "math": math}
    exec(textwrap.dedent(rest.partition("Run it with")[0]), names)
    result = snakesim.run("triplet", controller=names["Swing"], duration=0.5, set={"control.amplitude_rad": 0.1})  # pyright: ignore[reportArgumentType]
    assert result.complete
