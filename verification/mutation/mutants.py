"""Generates the mutants of a source file. Each mutant makes one small change in the syntax tree."""

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

# Replacements of each operator.
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
OPPOSITE_FUNCTIONS = {"min": "max", "max": "min", "any": "all", "all": "any"}
REMOVABLE_STATEMENTS = (
    ast.Expr,
    ast.Assign,
    ast.AugAssign,
    ast.AnnAssign,
    ast.If,
    ast.For,
    ast.Return,
    ast.Continue,
)

Change = Callable[[], object]
"""Changes a syntax tree in place."""


@dataclass(frozen=True)
class SourceMutant:
    """A source file with one change."""

    file: str  # such as limiter.py
    scope: str  # name of the function or class that contains the change
    line: int
    change: str  # code before -> code after, and the statement that contains it
    source: str  # the whole file with the change

    def __str__(self) -> str:
        return f"{self.file}:{self.line} in {self.scope}: {self.change}"


@dataclass(frozen=True)
class CodeNode:
    """A node of a syntax tree, and what surrounds it."""

    node: ast.AST
    block: list[Any] | None  # statements among which the node is one; None: it is not a statement
    scope: str  # name of the function or class that contains the node
    statement: ast.AST  # innermost statement that contains the node

    def is_removed(self) -> bool:
        """Return whether a change has replaced the statement in its block."""
        if self.block is None:
            return False
        return not any(statement is self.node for statement in self.block)


def generate_mutants(file: str, source: str) -> Iterator[SourceMutant]:
    """Yield every different mutant of a source text, from top to bottom.

    Args:
        file: Name that the mutants get.
        source: Source text of the file.
    """
    tree = ast.parse(source)
    known_sources = {ast.unparse(tree)}
    for node_index, original in enumerate(_walk_code(tree)):
        change_count = len(_list_changes(original.node, original.block))
        for change_index in range(change_count):
            changed_tree = copy.deepcopy(tree)
            changed = list(_walk_code(changed_tree))[node_index]
            code_before = _format_head(changed.node)
            apply_change = _list_changes(changed.node, changed.block)[change_index]
            apply_change()
            changed_source = ast.unparse(ast.fix_missing_locations(changed_tree))
            if changed_source in known_sources:
                continue
            known_sources.add(changed_source)
            code_after = "(removed)" if changed.is_removed() else _format_head(changed.node)
            change = f"{code_before} -> {code_after}"
            if original.node is not original.statement:
                change += f" in `{_format_head(original.statement)}`"
            line = getattr(changed.node, "lineno", 0)
            yield SourceMutant(file, original.scope, line, change, changed_source)


def _walk_code(
    node: ast.AST,
    scope: str = "module",
    block: list[Any] | None = None,
    statement: ast.AST | None = None,
) -> Iterator[CodeNode]:
    """Yield a node and every node below it that affects the behavior of the program."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        scope = node.name if scope == "module" else f"{scope}.{node.name}"
    if isinstance(node, ast.stmt) or statement is None:
        statement = node
    yield CodeNode(node, block, scope, statement)
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns"):
            continue
        children = list(value) if isinstance(value, list) else [value]
        for child in children:
            if not isinstance(child, ast.AST) or _has_no_effect(child, node):
                continue
            child_block = value if isinstance(child, ast.stmt) else None
            yield from _walk_code(child, scope, child_block, statement)


def _has_no_effect(node: ast.AST, parent: ast.AST) -> bool:
    """Return whether a change of a node cannot change the behavior of the program."""
    match node:
        case ast.JoinedStr():  # a text for people
            return True
        case ast.Expr():  # a docstring
            return isinstance(node.value, ast.Constant)
        case ast.Assign():  # an alias of a type
            return isinstance(node.value, ast.Subscript)
        case ast.Return():  # a function without this return also returns None
            return isinstance(parent, ast.FunctionDef) and _format_head(node) == "return None"
        case _:
            return False


def _format_head(node: ast.AST) -> str:
    """Return the code of a node in one line. A compound statement is reduced to its head."""
    lines = ast.unparse(node).splitlines()
    return lines[0] if lines else ""


def _list_changes(node: ast.AST, block: list[Any] | None) -> list[Change]:
    """Return every change of a node. The last change of a removable statement is its removal."""
    changes = _list_changes_in_place(node)
    if block is not None and _is_removable(node):
        index = next(i for i, statement in enumerate(block) if statement is node)
        changes.append(_replace_item(block, index, ast.Pass()))
    return changes


def _list_changes_in_place(node: ast.AST) -> list[Change]:
    """Return the changes of a node that leave it in the tree."""
    match node:
        case ast.Compare():
            return _list_comparison_changes(node)
        case ast.BoolOp():
            opposite = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            operand_drops = [_drop_item(node.values, i) for i in range(len(node.values))]
            return [_set_field(node, "op", opposite), *operand_drops]
        case ast.BinOp() | ast.AugAssign():
            return [_set_field(node, "op", ARITHMETIC[type(node.op)]())]
        case ast.UnaryOp(op=ast.Not()):
            return [_set_field(node, "operand", ast.UnaryOp(ast.Not(), node.operand))]
        case ast.UnaryOp(op=ast.USub() | ast.Invert()):
            return [_set_field(node, "op", ast.UAdd())]
        case ast.Constant():
            constants = _list_other_constants(node.value)
            return [_set_field(node, "value", constant) for constant in constants]
        case ast.Dict():
            return [_drop_entry(node, i) for i in range(len(node.keys))]
        case ast.Call():
            return _list_call_changes(node)
        case ast.If() | ast.IfExp():
            return [_set_field(node, "test", ast.UnaryOp(ast.Not(), node.test))]
        case _:
            return []


def _is_removable(node: ast.AST) -> bool:
    if isinstance(node, ast.AnnAssign) and node.value is None:
        return False  # a declaration of a type has no effect
    return isinstance(node, REMOVABLE_STATEMENTS)


def _list_comparison_changes(node: ast.Compare) -> list[Change]:
    """Return the changes of a comparison: each of its operators becomes another one."""
    changes: list[Change] = []
    for i, operator in enumerate(node.ops):
        for replacement in COMPARISONS[type(operator)]:
            changes.append(_replace_item(node.ops, i, replacement()))
    return changes


def _list_call_changes(node: ast.Call) -> list[Change]:
    """Return the changes of a call: another function, or two neighboring arguments in the other order."""
    keyword_swaps = [_swap_keyword_values(node.keywords, i) for i in range(len(node.keywords) - 1)]
    if isinstance(node.func, ast.Name) and node.func.id in OPPOSITE_FUNCTIONS:
        opposite = OPPOSITE_FUNCTIONS[node.func.id]
        return [_set_field(node.func, "id", opposite), *keyword_swaps]
    argument_swaps = [_swap_items(node.args, i) for i in range(len(node.args) - 1)]
    return argument_swaps + keyword_swaps


def _list_other_constants(value: object) -> list[object]:
    """Return the constants that replace a constant. Texts for people are not replaced."""
    match value:
        case bool():
            return [not value]
        case int() | float():
            return [value + 1, value - 1]
        case str() if value.isidentifier():  # a name that the program compares or looks up
            return [value + "_"]
        case _:
            return []


# --- changes that are applied later, when they are called ----------------------------------------------------------


def _set_field(node: ast.AST, name: str, value: object) -> Change:
    return lambda: setattr(node, name, value)


def _replace_item(items: list[Any], index: int, item: object) -> Change:
    return lambda: items.__setitem__(index, item)


def _drop_item(items: list[Any], index: int) -> Change:
    return lambda: items.pop(index)


def _drop_entry(node: ast.Dict, index: int) -> Change:
    return lambda: (node.keys.pop(index), node.values.pop(index))


def _swap_items(items: list[Any], index: int) -> Change:
    """Return a change that swaps an item with the next one."""
    swapped = [items[index + 1], items[index]]
    return lambda: items.__setitem__(slice(index, index + 2), swapped)


def _swap_keyword_values(keywords: list[ast.keyword], index: int) -> Change:
    """Return a change that swaps the values of a keyword argument and the next one."""
    first = keywords[index]
    second = keywords[index + 1]

    def swap() -> None:
        first.value, second.value = second.value, first.value

    return swap
