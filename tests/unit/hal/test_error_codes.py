"""Every used code is in a registry, every registered code is used, and docs/reference/errors.md is current."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from docs.site.error_pages import PAGE, make_page
from snakesim_can_backend.protocol.definitions import ModuleFault
from snakesim_hal.base import errors
from snakesim_hal.base.error_codes import ERROR_CODES
from snakesim_hal.base.fault_codes import FAULT_CODES, REFUSAL_CODES
from snakesim_hal.base.terminal import run_tool

REPOSITORY = Path(__file__).parents[3]
REGISTRIES = ("error_codes.py", "fault_codes.py")
MODULE_FAULTS = {  # composed from the names of fault bits and states
    *(f"module_{fault.name.lower()}" for fault in ModuleFault),
    "module_fault",
    "module_emergency",
}


CODE_NODES = (ast.Assign, ast.Call, ast.Constant, ast.FunctionDef, ast.keyword)
# A file without any of these words contains no code. Parsing all files takes seconds.
CODE_WORDS = (
    "code=",
    "code =",
    "INCOMPLETE_ERROR_CODE =",
    "_choose_error_code",
    "Fault(",
    "FaultFinding(",
    "report(",
    *(f'"{code}"' for code in (*FAULT_CODES, *REFUSAL_CODES)),
)


def iterate_nodes() -> Iterator[ast.AST]:
    """Yield the nodes of the source of the product that may contain a code."""
    for path in sorted(REPOSITORY.glob("snakesim*/**/*.py")):
        if path.name in REGISTRIES or path.parts[len(REPOSITORY.parts)] == "snakesim_testing":
            continue
        source = path.read_text(encoding="utf-8")
        if any(word in source for word in CODE_WORDS):
            yield from (
                node for node in ast.walk(ast.parse(source)) if isinstance(node, CODE_NODES)
            )


def find_texts(node: ast.AST) -> set[str]:
    """Return all string literals in a node."""
    return {
        child.value
        for child in ast.walk(node)
        if isinstance(child, ast.Constant) and isinstance(child.value, str)
    }


def find_codes(nodes: list[ast.AST]) -> Iterator[str]:
    """Yield the texts of `code`: arguments, defaults of classes, constants, and returned values."""
    for node in nodes:
        match node:
            case (
                ast.keyword(arg="code", value=value)
                | ast.Assign(targets=[ast.Name(id="code")], value=value)
            ):
                yield from find_texts(value)
            case ast.Assign(targets=[ast.Name(id="INCOMPLETE_ERROR_CODE")], value=value):
                yield from find_texts(value)
            case ast.FunctionDef(name="_choose_error_code", body=[_, *body]):
                for statement in body:
                    yield from find_texts(statement)


@pytest.fixture(scope="module")
def nodes() -> list[ast.AST]:
    return list(iterate_nodes())


def test_error_codes_in_source_equal_the_registry(nodes: list[ast.AST]) -> None:
    used = {code for code in find_codes(nodes) if re.fullmatch(r"[a-z0-9]+/[a-z-]+", code)}
    assert used == set(ERROR_CODES)


def test_fault_codes_in_source_equal_the_registry(nodes: list[ast.AST]) -> None:
    constants = [node.value for node in nodes if isinstance(node, ast.Constant)]
    texts = {value for value in constants if isinstance(value, str)}
    assert set(FAULT_CODES) - texts <= MODULE_FAULTS
    assert set(REFUSAL_CODES) <= texts
    used: set[str] = set()
    for node in nodes:
        match node:
            case ast.Call(func=ast.Name(id="Fault"), keywords=keywords):
                used |= {
                    text
                    for word in keywords
                    if word.arg == "what"
                    for text in find_texts(word.value)
                }
            case ast.Call(
                func=ast.Name(id="FaultFinding" | "report"),
                args=[ast.Constant(value=str(word)), *_],
            ):
                used.add(word)
            case _:
                pass
    assert used <= set(FAULT_CODES)


def test_error_classes_have_registered_default_codes() -> None:
    classes = [
        value
        for value in vars(errors).values()
        if isinstance(value, type) and hasattr(value, "code")
    ]
    assert len(classes) > 8
    assert all(error_type.code in ERROR_CODES for error_type in classes)


def test_registry_entries_are_sentences() -> None:
    for code, entry in [*ERROR_CODES.items(), *FAULT_CODES.items(), *REFUSAL_CODES.items()]:
        texts = (entry.title, entry.cause, entry.remedy)
        assert all(text.endswith(".") and "|" not in text for text in texts), code


def test_registry_links_pages_that_contain_the_code() -> None:
    docs = PAGE.parents[1]
    linked = {
        code: entry.page
        for code, entry in [*ERROR_CODES.items(), *FAULT_CODES.items(), *REFUSAL_CODES.items()]
    }
    for code, page in linked.items():
        assert not page or code in (docs / page).read_text(encoding="utf-8"), f"{code}: docs/{page}"
    troubleshooting = {
        f"troubleshooting/{path.name}" for path in (docs / "troubleshooting").glob("*.md")
    }
    assert troubleshooting - {"troubleshooting/README.md"} <= set(linked.values())
    table = (docs / "troubleshooting" / "README.md").read_text(encoding="utf-8")
    assert all(
        f"]({page.removeprefix('troubleshooting/')})" in table for page in linked.values() if page
    )


def test_error_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == make_page(), "run `make schemas`"


def test_error_code_ends_the_first_line_of_a_message(capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> int:
        raise errors.RefusedError("choose one:", "  a", code="network/several-robots")

    assert run_tool("snakesim", fail, as_json=True) == 1
    out, err = capsys.readouterr()
    assert err == "snakesim: choose one: [network/several-robots]\n  a\n"
    assert out == '{"error":{"code":"network/several-robots","message":"choose one:\\n  a"}}\n'
