"""How a package adds commands to `snakesim`.

A package lists its commands in a tuple, which an entry point in the group `snakesim.commands` names:

    COMMANDS = (
        Noun(name="arm_rest", heading="robots", help="Move the arm rest."),
        Command(
            name="arm_rest lower",
            help="Lower the arm rest by some millimeters.",
            add=add_arguments,
            run=lower,
            examples=("arm_rest lower 5", "arm_rest lower 20 --endpoint tcp/127.0.0.1:7447"),
        ),
    )

Every command reads this first, an emergency stop too. A module with `COMMANDS` imports what takes long, or what an
extra installs, only where a command runs.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass


def add_nothing(_parser: argparse.ArgumentParser) -> None:
    """Add no arguments."""


@dataclass(frozen=True, kw_only=True)
class CommandGroup:
    """A word that groups commands, such as `robot` in `snakesim robot arm`. Several packages may register the same."""

    name: str  # with the nouns before it, such as "drive scan"
    help: str  # one sentence
    heading: str = ""  # in `snakesim --help`; empty below another noun


@dataclass(frozen=True, kw_only=True)
class Command:
    """One command of `snakesim`."""

    name: str  # with its nouns, such as "drive scan odrive"
    help: str  # one sentence
    run: Callable[[argparse.Namespace], int]  # returns the exit code
    examples: tuple[str, str]  # two command lines, without the word `snakesim`
    add: Callable[[argparse.ArgumentParser], None] = add_nothing  # adds the arguments
    details: str = ""  # paragraphs below the options, such as the exit codes
    heading: str = ""  # in `snakesim --help`; empty below a noun


Commands = tuple[CommandGroup | Command, ...]
