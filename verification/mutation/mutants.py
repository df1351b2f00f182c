"""Every mutant of a source file: one small change each, to the syntax tree."""

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
TWINS = {"min": "max", "max": "min", "any": "all", "all": "any"}
REMOVABLE = (
    ast.Expr,
    ast.Assign,
    ast.AugAssign,
    ast.AnnAssign,
    ast.If,
    ast.For,
    ast.Return,
    ast.Continue,
)

Change = Callable[[], object]  # makes one change, in place


@dataclass(frozen=True)
class SourceMutant:
    """One change of one file."""

    file: str  # such as limiter.py
    where: str  # the function or class around it
    line: int
    change: str  # before -> after, and the statement that it is in
    source: str  # the whole file with the change

    def __str__(self) -> str:
        return f"{self.file}:{self.line} in {self.where}: {self.change}"


def mutants_of(file: str, source: str) -> Iterator[SourceMutant]:
    """All mutants of a file, from top to bottom."""
    tree = ast.parse(source)
    seen = {ast.unparse(tree)}
    for place, (original, _, where, statement) in enumerate(_walk(tree)):
        for choice in range(len(_changes(original, None)) + _removable(original)):
            changed = copy.deepcopy(tree)
            node, block, _, _ = list(_walk(changed))[place]
            before = _shown(node)
            changes = _changes(node, block)
            changes[choice]()
            text = ast.unparse(ast.fix_missing_locations(changed))
            if text not in seen:
                seen.add(text)
                removed = block is not None and not any(inner is node for inner in block)
                change = f"{before} -> {'(removed)' if removed else _shown(node)}"
                if original is not statement:
                    change += f" in `{_shown(statement)}`"
                yield SourceMutant(file, where, getattr(node, "lineno", 0), change, text)


def _walk(
    node: ast.AST,
    where: str = "module",
    block: list[Any] | None = None,
    statement: ast.AST | None = None,
) -> Iterator[tuple[ast.AST, list[Any] | None, str, ast.AST]]:
    """Every node that is code: with the block that it is a statement of, the function and the statement around it."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        where = node.name if where == "module" else f"{where}.{node.name}"
    if isinstance(node, ast.stmt) or statement is None:
        statement = node
    yield node, block, where, statement
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns"):
            continue
        for child in list(value) if isinstance(value, list) else [value]:
            if (
                isinstance(child, ast.Return)
                and isinstance(node, ast.FunctionDef)
                and _shown(child) == "return None"
            ):
                continue  # at the end of a function, which does so anyway
            if isinstance(child, ast.AST) and not _is_no_code(child):
                yield from _walk(
                    child, where, value if isinstance(child, ast.stmt) else None, statement
                )


def _is_no_code(node: ast.AST) -> bool:
    """Docstrings, texts for people, and aliases of types."""
    if isinstance(node, ast.JoinedStr):
        return True
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant)
    return isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript)


def _shown(node: ast.AST) -> str:
    """A node in one line; of a compound statement only its head."""
    return (ast.unparse(node).splitlines() or [""])[0]


def _removable(node: ast.AST) -> bool:
    return isinstance(node, REMOVABLE) and not (
        isinstance(node, ast.AnnAssign) and node.value is None
    )


def _changes(node: ast.AST, block: list[Any] | None) -> list[Change]:
    """What can be done to a node; last, where it is a statement of a block, its removal."""
    found: list[Change] = []
    match node:
        case ast.Compare():
            for i, op in enumerate(node.ops):
                found += [_put(node.ops, i, other()) for other in COMPARISONS[type(op)]]
        case ast.BoolOp():
            found.append(_set(node, "op", ast.Or() if isinstance(node.op, ast.And) else ast.And()))
            found += [_drop(node.values, i) for i in range(len(node.values))]
        case ast.BinOp() | ast.AugAssign():
            found.append(_set(node, "op", ARITHMETIC[type(node.op)]()))
        case ast.UnaryOp(op=ast.Not()):
            found.append(_set(node, "operand", ast.UnaryOp(ast.Not(), node.operand)))
        case ast.UnaryOp(op=ast.USub() | ast.Invert()):
            found.append(_set(node, "op", ast.UAdd()))
        case ast.Constant():
            found += [_set(node, "value", other) for other in _other_constants(node.value)]
        case ast.Dict():
            found += [_drop_entry(node, i) for i in range(len(node.keys))]
        case ast.Call():
            found += _changes_of_call(node)
        case ast.If() | ast.IfExp():
            found.append(_set(node, "test", ast.UnaryOp(ast.Not(), node.test)))
        case _:
            pass
    if block is not None and _removable(node):
        found.append(
            _put(block, next(i for i, inner in enumerate(block) if inner is node), ast.Pass())
        )
    return found


def _changes_of_call(node: ast.Call) -> list[Change]:
    swapped = [_swap_values(node.keywords, i) for i in range(len(node.keywords) - 1)]
    if isinstance(node.func, ast.Name) and node.func.id in TWINS:
        return [_set(node.func, "id", TWINS[node.func.id]), *swapped]
    return [_swap(node.args, i) for i in range(len(node.args) - 1)] + swapped


def _other_constants(value: object) -> list[object]:
    match value:
        case bool():
            return [not value]
        case int() | float():
            return [value + 1, value - 1]
        case str() if (
            value.isidentifier()
        ):  # a word that the program goes by, not a text for people
            return [value + "_"]
        case _:
            return []


def _set(node: ast.AST, name: str, value: object) -> Change:
    return lambda: setattr(node, name, value)


def _put(values: list[Any], at: int, value: object) -> Change:
    return lambda: values.__setitem__(at, value)


def _drop(values: list[Any], at: int) -> Change:
    return lambda: values.pop(at)


def _drop_entry(node: ast.Dict, at: int) -> Change:
    return lambda: (node.keys.pop(at), node.values.pop(at))


def _swap(values: list[Any], at: int) -> Change:
    return lambda: values.__setitem__(slice(at, at + 2), [values[at + 1], values[at]])


def _swap_values(keywords: list[ast.keyword], at: int) -> Change:
    def change() -> None:
        keywords[at].value, keywords[at + 1].value = keywords[at + 1].value, keywords[at].value

    return change
