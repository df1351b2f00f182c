"""Compiled templates: kept beside the template, compiled again after a change, and never needed."""

import importlib.util
import sys
from pathlib import Path

import jinja2
import pytest

from snakesim_operator.results.page.template_cache import TemplateCache


def render(folder: Path, options: str = "same") -> str:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder), bytecode_cache=TemplateCache(options)
    )
    return environment.get_template("page.html").render(value=7)


@pytest.fixture
def compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The compiled form of a template that was rendered once."""
    monkeypatch.setattr(sys, "dont_write_bytecode", False)  # whatever PYTHONDONTWRITEBYTECODE is
    (tmp_path / "page.html").write_text("first {{ value }}")
    assert render(tmp_path) == "first 7"
    return Path(importlib.util.cache_from_source(str(tmp_path / "page.html.py")))


def refuse_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_arguments: object, **_options: object) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(jinja2.Environment, "compile", fail)


def test_compiled_template_is_used_again(
    compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [path.name for path in compiled.parent.iterdir()] == [compiled.name]
    refuse_to_compile(monkeypatch)
    assert render(tmp_path) == "first 7"


@pytest.mark.usefixtures("compiled")
def test_changed_template_is_compiled_again(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("second {{ value }}")
    assert render(tmp_path) == "second 7"


@pytest.mark.usefixtures("compiled")
def test_other_options_are_compiled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_to_compile(monkeypatch)
    with pytest.raises(AssertionError, match="compiled again"):
        render(tmp_path, options="other")


@pytest.mark.parametrize("kept", [slice(0), slice(5), slice(40), slice(-20)])
def test_damaged_compiled_template_is_replaced(compiled: Path, tmp_path: Path, kept: slice) -> None:
    whole = compiled.read_bytes()
    compiled.write_bytes(whole[kept])
    assert render(tmp_path) == "first 7"
    assert compiled.read_bytes() == whole


def test_nothing_is_written_where_python_keeps_no_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "page.html").write_text("first {{ value }}")
    assert render(tmp_path) == "first 7"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_folder_that_cannot_be_written_is_left(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("first {{ value }}")
    (tmp_path / "__pycache__").write_text("no folder")
    assert render(tmp_path) == "first 7"
    assert (tmp_path / "__pycache__").read_text() == "no folder"
