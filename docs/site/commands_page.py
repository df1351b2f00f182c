"""Writes docs/reference/commands.md, which lists every command: `python -m docs.site.commands_page`."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from snakesim_operator.cli import find_subparsers, make_parser

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "commands.md"
HEAD = """\
# Commands

Made by `make schemas` from the parsers of `snakesim`; `snakesim COMMAND --help` prints the same. Commands for daily
work are verbs, such as `snakesim run`. All others are a noun and a verb, such as `snakesim robot arm`.
[The command](../how-to/command-line.md) explains them by task.

The table lists the first word of each command; follow its link for arguments and examples.

| command | for | what it does |
|---|---|---|
"""


def make_page() -> str:
    """Return the page as it should be."""
    parser = make_parser()
    about = {action.dest: action.help for action in parser.commands._choices_actions}
    lines: list[str] = []
    for heading, actions in parser.commands_by_heading():
        for action in actions:
            lines.append(f"| [`snakesim {action.dest}`](#snakesim-{action.dest}) | {heading} | {about[action.dest]} |")
    for name in about:
        lines += describe_all(find_subparsers(parser)[name])
    return HEAD + "\n".join(lines) + "\n"


def describe_all(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the lines of a noun or command, and of all commands below it."""
    level = "#" * min(parser.prog.count(" ") + 1, 4)
    yield from ("", f"{level} {parser.prog}", "", f"{parser.description}")
    below = find_subparsers(parser)
    for command in below.values():
        yield from describe_all(command)
    if not below:
        yield from describe_command(parser)


def describe_command(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the arguments, the details and the examples of a command."""
    arguments = [action for action in parser._actions if is_shown(action)]
    if arguments:
        yield from ("", "| argument | what it is |", "|---|---|")
    for action in arguments:
        yield f"| {name_argument(action)} | {escape(action.help or '')} |"
    details, _, examples = (parser.epilog or "").rpartition("examples:\n")
    if details:
        yield from ("", *describe_details(details.strip()))
    yield from ("", "```sh", *(line.strip() for line in examples.splitlines()), "```")


def is_shown(action: argparse.Action) -> bool:
    """Return whether an argument is listed: not `--help`, and none that only other processes use."""
    return action.help != argparse.SUPPRESS and not isinstance(action, argparse._HelpAction)


def name_argument(action: argparse.Action) -> str:
    """Return an argument as it is typed, as code."""
    value = ""
    if action.nargs != 0:
        choices = "|".join(map(str, action.choices or ()))
        value = str(action.metavar or choices or action.dest.upper())
        if action.nargs in ("*", "+"):
            value += " ..."
    words = [f"{option} {value}".strip() for option in action.option_strings] or [value]
    text = ", ".join(words)
    is_optional = not action.option_strings and action.nargs in ("?", "*")
    return f"`{escape(f'[{text}]' if is_optional else text)}`"


def describe_details(details: str) -> Iterator[str]:
    """Yield paragraphs; indented lines, such as a list of faults, as a block of text."""
    paragraphs, _, block = details.partition("\n  ")
    yield paragraphs
    if block:
        yield from ("", "```text", *("  " + block).splitlines(), "```")


def escape(text: str) -> str:
    """Return a text for a cell of a table."""
    return text.replace("|", "\\|").replace("%%", "%")


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")
