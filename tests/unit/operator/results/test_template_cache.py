"""The cache of compiled templates, which stores them near the template and compiles them again after a change."""

import importlib.util
import sys
from pathlib import Path

import jinja2
import pytest

from snakesim_operator.results.page.template_cache import TemplateCache


def render_page(folder: Path, options: str = "same") -> str:
    """Render the template in a folder with these compiler options."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder), bytecode_cache=TemplateCache(options)
    )
    return environment.get_template("page.html").render(value=7)


@pytest.fixture
def compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The path of the compiled template, after its template was rendered once."""
    monkeypatch.setattr(sys, "dont_write_bytecode", False)  # independent of PYTHONDONTWRITEBYTECODE
    (tmp_path / "page.html").write_text("first {{ value }}")
    assert render_page(tmp_path) == "first 7"
    return Path(importlib.util.cache_from_source(str(tmp_path / "page.html.py")))


def refuse_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every compilation of a template fail."""

    def fail(*_arguments: object, **_options: object) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(jinja2.Environment, "compile", fail)


def test_template_cache_reuses_compiled_template(
    compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [path.name for path in compiled.parent.iterdir()] == [compiled.name]
    refuse_to_compile(monkeypatch)
    assert render_page(tmp_path) == "first 7"


@pytest.mark.usefixtures("compiled")
def test_template_cache_compiles_changed_template_again(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("second {{ value }}")
    assert render_page(tmp_path) == "second 7"


@pytest.mark.usefixtures("compiled")
def test_template_cache_compiles_again_for_other_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_to_compile(monkeypatch)
    with pytest.raises(AssertionError, match="compiled again"):
        render_page(tmp_path, options="other")


@pytest.mark.parametrize("kept", [slice(0), slice(5), slice(40), slice(-20)])
def test_template_cache_replaces_damaged_compiled_template(
    compiled: Path, tmp_path: Path, kept: slice
) -> None:
    undamaged = compiled.read_bytes()
    compiled.write_bytes(undamaged[kept])
    assert render_page(tmp_path) == "first 7"
    assert compiled.read_bytes() == undamaged


def test_template_cache_writes_nothing_without_bytecode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "page.html").write_text("first {{ value }}")
    assert render_page(tmp_path) == "first 7"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_template_cache_in_unwritable_folder_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("first {{ value }}")
    (tmp_path / "__pycache__").write_text("no folder")
    assert render_page(tmp_path) == "first 7"
    assert (tmp_path / "__pycache__").read_text() == "no folder"
