"""Runs a command that a package registers, without the `snakesim` command around it."""

import argparse
from collections.abc import Sequence

from snakesim_hal.programs.commands import Command, Commands


def run_registered(commands: Commands, words: Sequence[str]) -> int:
    """Parse the words behind the name of a command, and run it. Errors of the command are raised."""
    for command in commands:
        name = command.name.split()
        if isinstance(command, Command) and list(words[: len(name)]) == name:
            parser = argparse.ArgumentParser(prog=f"snakesim {command.name}")
            command.add(parser)
            return command.run(parser.parse_args(words[len(name) :]))
    raise LookupError(f"no command {' '.join(words)}")
