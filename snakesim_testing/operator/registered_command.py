"""Runs a command that a package registers, without the `snakesim` program around it."""

import argparse
from collections.abc import Sequence

from snakesim_hal.programs.commands import Command, Commands


def run_registered_command(commands: Commands, arguments: Sequence[str]) -> int:
    """Find a command by its name, and run it in this process. Errors of the command are raised.

    Args:
        commands: The commands that a package registers.
        arguments: The name of the command, then its arguments, as after `snakesim`.

    Returns:
        The exit status of the command.

    Raises:
        LookupError: If no registered command has this name.
    """
    for command in commands:
        name_parts = command.name.split()
        has_this_name = list(arguments[: len(name_parts)]) == name_parts
        if isinstance(command, Command) and has_this_name:
            parser = argparse.ArgumentParser(prog=f"snakesim {command.name}")
            command.add(parser)
            return command.run(parser.parse_args(arguments[len(name_parts) :]))
    raise LookupError(f"no command {' '.join(arguments)}")
