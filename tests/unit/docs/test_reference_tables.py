"""Tests that hand-written tables of the documentation have all extras, plugins, variables and keys of the product."""

import re
import tomllib
from collections.abc import Iterator

import pytest

from docs.style.check_prose import PRODUCT_CODE, ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
VARIABLE = re.compile(r"""["'](SNAKESIM_[A-Z_]+)["']""")  # a whole string, and no macro of C
CONSTANTS = {"SNAKESIM_COMMAND"}  # in the `__all__` of a module


def read_page(path: str) -> str:
    return (ROOT / "docs" / path).read_text(encoding="utf-8")


def list_variables() -> Iterator[str]:
    """Yield the environment variables that the product reads or sets, and those of the tests' packages."""
    for pattern in PRODUCT_CODE:
        for folder in ROOT.glob(pattern):
            for file in folder.rglob("*.py"):
                yield from VARIABLE.findall(file.read_text(encoding="utf-8"))


@pytest.mark.parametrize("extra", PROJECT["optional-dependencies"])
def test_extra_has_a_row_with_its_size(extra: str) -> None:
    assert re.search(
        rf"^\| `{extra}` \|.*\| \d+ MB \|$", read_page("get-started/installation.md"), re.MULTILINE
    )


@pytest.mark.parametrize(
    "group", [group for group in PROJECT["entry-points"] if group.startswith("snakesim.")]
)
def test_entry_point_group_has_a_row(group: str) -> None:
    assert f"| `{group}` |" in read_page("reference/plugins.md")


@pytest.mark.parametrize("controller", PROJECT["entry-points"]["snakesim.controllers"])
def test_controller_has_a_row(controller: str) -> None:
    assert re.search(
        rf"^\| [^|]*`{controller}`[^|]* \|", read_page("reference/controllers.md"), re.MULTILINE
    )


@pytest.mark.parametrize("backend", PROJECT["entry-points"]["snakesim.backends"])
def test_backend_is_introduced_in_the_concepts(backend: str) -> None:
    assert f"`{backend}`" in read_page("get-started/concepts.md")


@pytest.mark.parametrize("variable", sorted(set(list_variables()) - CONSTANTS))
def test_environment_variable_has_a_row(variable: str) -> None:
    assert f"`{variable}`" in read_page("reference/environment-variables.md")


def test_configuration_keys_have_descriptions() -> None:
    rows = re.findall(
        r"^\| `([^`]+)` \|.*\| (.*) \|$", read_page("reference/configuration.md"), re.MULTILINE
    )
    assert len(rows) > 500
    assert [key for key, description in rows if len(description.split()) < 2] == []
