"""Reads classes and functions from their source, as the pages of the Python API show them.

The source keeps what a running program does not have: annotations and defaults as they are written, and the meaning of
an attribute, which is the text after it, the comment on its line, or the comment above it.
"""

import ast
import inspect
import re
import textwrap
from dataclasses import dataclass, field
from functools import cache
from typing import Any

SECTIONS = ("Args", "Returns", "Yields", "Raises", "Source")
INDENT = re.compile(r"\s+")


@dataclass
class Parameter:
    """One parameter of a function."""

    name: str  # with its stars, such as `*signals`
    annotation: str
    default: str  # empty: the caller must give it
    meaning: str = ""


@dataclass
class Docstring:
    """A docstring, split into its sections."""

    text: str = ""
    arguments: dict[str, str] = field(default_factory=dict[str, str])
    returns: str = ""
    raises: dict[str, str] = field(default_factory=dict[str, str])
    source: str = ""


@dataclass
class Function:
    """A function, a method or a property."""

    name: str
    parameters: list[Parameter]
    returns: str  # the annotation
    docstring: Docstring
    # Index of the first parameter that needs its name; None: there is none.
    keyword_only: int | None = None
    is_property: bool = False


@dataclass
class Attribute:
    """A field or a class attribute."""

    name: str
    annotation: str
    default: str
    meaning: str


@dataclass
class Class:
    """A class with its public members, those of the source only."""

    docstring: Docstring
    constructor: Function | None
    attributes: list[Attribute]
    methods: list[Function]


def read_function(function: Any) -> Function:
    """Return a function as its source shows it."""
    (node,) = _parse(function).body
    assert isinstance(node, ast.FunctionDef)
    return _make_function(node)


@cache
def read_class(plugin: type) -> Class:
    """Return a class as its source shows it, with the docstrings of base classes where it has none."""
    (node,) = _parse(plugin).body
    assert isinstance(node, ast.ClassDef)
    lines = textwrap.dedent(inspect.getsource(plugin)).splitlines()
    constructor = None
    attributes: list[Attribute] = []
    methods: list[Function] = []
    for position, part in enumerate(node.body):
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            if not part.target.id.startswith("_"):
                following = node.body[position + 1] if position + 1 < len(node.body) else None
                attributes.append(_make_attribute(part, following, lines))
        elif isinstance(part, ast.FunctionDef):
            function = _make_function(part)
            if not function.docstring.text:
                function.docstring = parse_docstring(
                    inspect.getdoc(getattr(plugin, part.name, None)) or ""
                )
            if part.name == "__init__":
                constructor = function
            elif not part.name.startswith("_") or part.name == "__getitem__":
                methods.append(function)
    return Class(parse_docstring(ast.get_docstring(node) or ""), constructor, attributes, methods)


def _parse(thing: Any) -> ast.Module:
    return ast.parse(textwrap.dedent(inspect.getsource(thing)))


def _read_comment_above(lines: list[str], line_number: int) -> str:
    """Return the comment that ends on the line before the given one, without its marks."""
    comment: list[str] = []
    for line in reversed(lines[: line_number - 1]):
        if not line.lstrip().startswith("#"):
            break
        comment.insert(0, line.strip().lstrip("# "))
    return " ".join(comment).removesuffix(".")


def _make_attribute(node: ast.AnnAssign, following: ast.stmt | None, lines: list[str]) -> Attribute:
    assert isinstance(node.target, ast.Name)
    meaning = ""
    if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
        meaning = inspect.cleandoc(str(following.value.value))
    else:
        last_line = lines[(node.end_lineno or node.lineno) - 1]
        code_length = len(last_line.encode()[: node.end_col_offset].decode())
        meaning = last_line[code_length:].partition("#")[2].strip()
        if not meaning:
            meaning = _read_comment_above(lines, node.lineno)
    default = "" if node.value is None else _shorten(ast.unparse(node.value))
    return Attribute(node.target.id, _shorten(ast.unparse(node.annotation)), default, meaning)


def _make_function(node: ast.FunctionDef) -> Function:
    decorators = {ast.unparse(decorator).rpartition(".")[2] for decorator in node.decorator_list}
    docstring = parse_docstring(ast.get_docstring(node) or "")
    parameters = [
        parameter for parameter in _list_parameters(node) if parameter.name not in ("self", "cls")
    ]
    for parameter in parameters:
        parameter.meaning = docstring.arguments.get(parameter.name.lstrip("*"), "")
    returns = "" if node.returns is None else ast.unparse(node.returns).strip("'\"")
    is_property = bool(decorators & {"property", "cached_property"})
    keyword_only = len(parameters) - len(node.args.kwonlyargs) if node.args.kwonlyargs else None
    return Function(node.name, parameters, returns, docstring, keyword_only, is_property)


def _list_parameters(node: ast.FunctionDef) -> list[Parameter]:
    arguments = node.args
    positional = [*arguments.posonlyargs, *arguments.args]
    defaults: list[ast.expr | None] = [None] * (len(positional) - len(arguments.defaults)) + list(
        arguments.defaults
    )
    found = [
        _make_parameter(argument, default)
        for argument, default in zip(positional, defaults, strict=True)
    ]
    if arguments.vararg:
        found.append(_make_parameter(arguments.vararg, None, "*"))
    for argument, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        found.append(_make_parameter(argument, default))
    if arguments.kwarg:
        found.append(_make_parameter(arguments.kwarg, None, "**"))
    return found


def _make_parameter(argument: ast.arg, default: ast.expr | None, stars: str = "") -> Parameter:
    annotation = (
        "" if argument.annotation is None else ast.unparse(argument.annotation).strip("'\"")
    )
    return Parameter(
        stars + argument.arg, annotation, "" if default is None else ast.unparse(default)
    )


def _shorten(code: str) -> str:
    """Return an annotation without the wrapper that marks an attribute of a class."""
    inner = re.fullmatch(r"ClassVar\[(.*)\]", code.strip("'\""))
    return inner[1] if inner else code.strip("'\"")


def parse_docstring(text: str) -> Docstring:
    """Return a docstring split by its headings `Args:`, `Returns:`, `Yields:`, `Raises:` and `Source:`."""
    found = Docstring()
    parts: dict[str, list[str]] = {"": []}
    section = ""
    for line in inspect.cleandoc(text).splitlines():
        heading = line.removesuffix(":")
        if line.endswith(":") and heading in SECTIONS:
            section = heading
            parts[section] = []
        elif section and line.startswith(f"{section}: "):
            parts[section].append(line)
        else:
            parts[section].append(line)
    found.text = "\n".join(parts[""]).strip()
    found.arguments = _parse_entries(parts.get("Args", []))
    found.raises = _parse_entries(parts.get("Raises", []))
    found.returns = _join(parts.get("Returns") or parts.get("Yields") or [])
    found.source = _join(parts.get("Source", []))
    return found


def _join(lines: list[str]) -> str:
    return " ".join(line.strip() for line in lines if line.strip())


def _parse_entries(lines: list[str]) -> dict[str, str]:
    """Return the entries `name: meaning` of a section; further lines of an entry are indented more."""
    entries: dict[str, str] = {}
    name = ""
    for line in textwrap.dedent("\n".join(lines)).splitlines():
        if not line.strip():
            continue
        if not line.startswith(" "):
            name, _, meaning = line.partition(":")
            name = name.strip().lstrip("*")
            entries[name] = meaning.strip()
        elif name:
            entries[name] += f" {line.strip()}"
    return entries
