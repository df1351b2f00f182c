"""Generates small changes of a C file: one operator, one number, one condition or one statement.

The file is read line by line, not parsed. Comments, directives and declarations of types are left out.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

# Replacements of each operator. Binary operators have spaces around them; those of pointers and signs have not.
OPERATORS = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
    "&&": ("||",),
    "||": ("&&",),
    "+": ("-",),
    "-": ("+",),
    "*": ("/",),
    "/": ("*",),
    "%": ("/",),
    "&": ("|",),
    "|": ("&",),
    "^": ("|",),
    "<<": (">>",),
    ">>": ("<<",),
    "+=": ("-=",),
    "|=": ("&=",),
}
COMMENT_PATTERN = re.compile(r"/\*.*?\*/", re.DOTALL)
OPERATOR_PATTERN = re.compile(r"(?<= )(<<|>>|<=|>=|==|!=|&&|\|\||\+=|\|=|[-+*/%&|^<>])(?= )")
NUMBER_PATTERN = re.compile(
    r"(?<![\w.\"])(0x[0-9A-Fa-f]+|\d+\.\d+|\d+(?:\.\d*)?e-?\d+|\d+)(f|u)?\b"
)
BOOLEAN_PATTERN = re.compile(r"\b(true|false)\b")
NEGATION_PATTERN = re.compile(r"!(?=[\w(])")
CONDITION_PATTERN = re.compile(r"^( *(?:\} else )?if \()(.*)(\) \{)$")
CHOICE_PATTERN = re.compile(r"(\? )([^?:;]+)( : )([^?:;]+)(;)$")
# A whole statement in one line: an assignment, a call, a count or a return without a value.
STATEMENT_PATTERN = re.compile(
    r"^ +(?!return |const |static )(?:\*?[\w.>\[\]-]+(?: [-+|^&]?= .*|\(.*\)|\+\+|--)|return);$"
)
INCREMENT_PATTERN = re.compile(r"\+\+|--")
FUNCTION_PATTERN = re.compile(r"^\w[\w *]*?(\w+)\(")


@dataclass(frozen=True)
class SmallChange:
    """A file of the firmware with one small change.

    Attributes:
        file: Name of the file, such as states.c.
        scope: Name of the function that contains the change; "file" outside of functions.
        line: Number of the line.
        description: Text before -> text after, and the line that contains it. Equal ones in one function are numbered.
        source: The whole file with the change.
    """

    file: str
    scope: str
    line: int
    description: str
    source: str

    @property
    def key(self) -> str:
        """Return a text that stays the same if lines are added elsewhere; `equivalent.toml` has such texts."""
        return f"{self.file} in {self.scope}: {self.description}"

    def __str__(self) -> str:
        return f"{self.file}:{self.line} in {self.scope}: {self.description}"


def generate_small_changes(file: str, source: str) -> Iterator[SmallChange]:
    """Yield every small change of a C file, from top to bottom.

    Args:
        file: Name of the file.
        source: Its content.
    """
    lines = source.split("\n")
    code_lines = blank_comments(source).split("\n")
    scope = "file"
    counts = Counter[tuple[str, str]]()
    for i, code in enumerate(code_lines):
        function = FUNCTION_PATTERN.match(code)
        if function is not None and not code.rstrip().endswith(";"):
            scope = function[1]
        elif code.startswith("}"):
            scope = "file"
        if code.startswith("#") or function is not None:
            continue
        for change, changed in _list_changes_of_line(code.rstrip()):
            changed_source = "\n".join([*lines[:i], changed, *lines[i + 1 :]])
            description = f"{change} in `{code.strip()}`"
            counts[scope, description] += 1
            count = counts[scope, description]
            if count > 1:  # the same operator or number again
                description += f" ({count})"
            yield SmallChange(file, scope, i + 1, description, changed_source)


def blank_comments(source: str) -> str:
    """Return a C text whose comments are spaces, so that all other text keeps its position."""
    return COMMENT_PATTERN.sub(lambda comment: re.sub(r"[^\n]", " ", comment[0]), source)


def _list_changes_of_line(code: str) -> Iterator[tuple[str, str]]:
    """Yield what a change does, and the changed line, for each change of a line without its comments."""
    for operator in OPERATOR_PATTERN.finditer(code):
        for replacement in OPERATORS[operator[1]]:
            yield f"{operator[1]} -> {replacement}", _replace(code, operator, replacement)
    for number in NUMBER_PATTERN.finditer(code):
        for replacement in _list_other_numbers(number[1]):
            suffix = number[2] or ""
            yield (
                f"{number[0]} -> {replacement}{suffix}",
                _replace(code, number, replacement + suffix),
            )
    for boolean in BOOLEAN_PATTERN.finditer(code):
        opposite = "false" if boolean[1] == "true" else "true"
        yield f"{boolean[1]} -> {opposite}", _replace(code, boolean, opposite)
    for negation in NEGATION_PATTERN.finditer(code):
        yield "! -> (removed)", _replace(code, negation, "")
    condition = CONDITION_PATTERN.match(code)
    if condition is not None:
        yield "condition -> its opposite", f"{condition[1]}!({condition[2]}){condition[3]}"
    choice = CHOICE_PATTERN.search(code)
    if choice is not None:
        swapped = f"{choice[1]}{choice[4]}{choice[3]}{choice[2]}{choice[5]}"
        yield "choice -> the other", _replace(code, choice, swapped)
    for increment in INCREMENT_PATTERN.finditer(code):
        opposite = "--" if increment[0] == "++" else "++"
        yield f"{increment[0]} -> {opposite}", _replace(code, increment, opposite)
    if STATEMENT_PATTERN.match(code):
        yield "statement -> (removed)", ""


def _list_other_numbers(text: str) -> list[str]:
    """Return the numbers that replace a number: one more and one less, or twice and half of a fraction."""
    if "." in text or ("e" in text and not text.startswith("0x")):
        value = float(text)
        return [repr(value * 2.0), repr(value / 2.0)] if value != 0.0 else ["1.0"]
    value = int(text, 0)
    return [str(value + 1), str(value - 1)] if value > 0 else ["1"]


def _replace(code: str, found: re.Match[str], replacement: str) -> str:
    return code[: found.start()] + replacement + code[found.end() :]
