"""The `snakesim` command: its own commands, and those that entry points in the group `snakesim.commands` add.

An entry point names `add_commands(commands)`, beside which `TASK` says where the help lists them, or `main(argv)` of a
command that parses its own words. They are looked up only for the help, completion, and a command not known here: an
emergency stop does not wait for them.
"""

import argparse
import errno
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

from snakesim_hal.base.errors import ConfigError, did_you_mean, short
from snakesim_hal.base.terminal import discard, exit_code, print_stderr, report_error, say
from snakesim_operator.monitoring import watching
from snakesim_operator.playback import arguments as playback
from snakesim_operator.robot_commands import commanding
from snakesim_operator.run import arguments as run
from snakesim_operator.this_computer import setup

OK, FAILED, BAD_INPUT = 0, 1, 2
ADDS = "add_commands"  # the name of an entry point's function that adds to the parser


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 done, 1 a fault, 2 wrong input and nothing started, 3 an incomplete record, 130 interrupted."""
    given = list(sys.argv[1:] if argv is None else argv)
    try:
        return exit_code("snakesim", lambda: _act(given, owns_process=argv is None))
    except ModuleNotFoundError as error:
        from snakesim_operator.base.extras import explained

        if (why := explained(error)) is None:
            raise
        report_error(why, "snakesim")
        return BAD_INPUT
    except OSError as error:  # such as a full disk under what is printed
        discard(sys.stdout)
        if isinstance(error, BrokenPipeError):  # the reader of a pipe has closed it
            return OK
        if error.errno == errno.ENOMEM:
            raise MemoryError from error
        print_stderr(f"snakesim: {f'{error.filename}: ' if error.filename else ''}{error.strerror or error}")
        return FAILED


def _act(given: list[str], *, owns_process: bool) -> int:
    if not given:
        parser().print_help()
        return OK
    name = given[0]
    for before, word in zip(["", *given], given, strict=False):
        if not word or (word.startswith("--") and word.endswith("=")):  # as of a variable that is not set
            raise ConfigError(f"{word.rstrip('=') or before or 'the command'}: empty; give a value, or leave it out")
    ours = Commands()
    if name.startswith("-"):
        ours.add_installed()
    elif name not in ours.commands.choices:
        from snakesim_hal.model.plugins import COMMANDS, find_plugin, installed

        if name in installed(COMMANDS):
            found = find_plugin(COMMANDS, name)
            if getattr(found, "__name__", "") != ADDS:
                return found(given[1:])
            found(ours.commands)
        else:
            ours.add_installed()
            meant = did_you_mean(name, [*ours.commands.choices, *installed(COMMANDS)])
            raise ConfigError(f"no command {short(name)!r}; {meant}`snakesim` alone lists all")
    arguments, unknown = ours.parse_known_args(given)
    if unknown:
        _refuse(unknown[0], ours.of(given))
    arguments.owns_process = owns_process  # whether nothing but this command runs in this process
    return arguments.act(arguments)


def _refuse(word: str, parser: argparse.ArgumentParser) -> None:
    """Raise ConfigError for a word on the command line that means nothing to its command."""
    options = [option for action in parser._actions for option in action.option_strings]
    meant = did_you_mean(word.partition("=")[0], options) if word.startswith("-") else ""
    raise ConfigError(
        f"{parser.prog.removeprefix('snakesim ')}: unknown argument {short(word)!r}; {meant}see `{parser.prog} --help`"
    )


class Command(argparse.ArgumentParser):
    """The arguments of one command."""

    def error(self, message: str) -> NoReturn:
        """End, with one line instead of the whole usage."""
        plain = re.sub(r"invalid float value: (.*)", r"\1 is not a number; give it without a unit", message)
        plain = re.sub(r"invalid int value: (.*)", r"\1 is not a whole number; give it without a unit", plain)
        print_stderr(f"{self.prog}: {plain}; see `{self.prog} --help`")
        sys.exit(BAD_INPUT)


class Commands(Command):
    """The command's arguments, without the commands of installed packages; its help lists the commands by task."""

    def __init__(self) -> None:
        super().__init__(
            prog="snakesim",
            description="Snake robots that push themselves off obstacles: one controller, simulator or robot.",
            epilog="`snakesim COMMAND --help` tells more. Begin with: snakesim run triplet --console",
        )
        self.add_argument("--version", action=_Version, nargs=0, help="print the version")
        self.commands = self.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Command)
        self._tasks: dict[str, list[argparse.Action]] = {}
        for task, adders in TASKS.items():
            before = len(self.commands._choices_actions)
            for add in adders:
                add(self.commands)
            self._tasks[task] = self.commands._choices_actions[before:]

    def add_installed(self) -> None:
        """Add the commands of entry points. One that cannot be loaded is reported, and keeps no other from its work."""
        from importlib.metadata import entry_points

        from snakesim_hal.model.plugins import COMMANDS, find_plugin

        for entry in sorted(entry_points(group=COMMANDS)):
            if entry.attr != ADDS or entry.name in self.commands.choices:  # another of the same `add_commands`
                continue
            try:
                found = find_plugin(COMMANDS, entry.name)
            except ConfigError as error:
                report_error(error, "snakesim")
                continue
            before = len(self.commands._choices_actions)
            found(self.commands)
            task = getattr(sys.modules[found.__module__], "TASK", "more")
            self._tasks.setdefault(task, []).extend(self.commands._choices_actions[before:])

    def format_help(self) -> str:
        """The commands by task, and those of installed packages by name."""
        from snakesim_hal.model.plugins import COMMANDS, installed

        others = [name for name in installed(COMMANDS) if name not in self.commands.choices]
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        for task, actions in self._tasks.items():
            formatter.start_section(task)
            formatter.add_arguments(actions)
            formatter.end_section()
        formatter.start_section("from installed backends")
        formatter.add_text(f"{', '.join(others) or 'none'}; see their --help")
        formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()

    def of(self, given: Sequence[str]) -> argparse.ArgumentParser:
        """The parser of the command, or part of one, that is given."""
        found: argparse.ArgumentParser = self
        for word in given:
            for action in found._actions:
                if isinstance(action, argparse._SubParsersAction) and word in action.choices:
                    found = action.choices[word]
                    break
        return found


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        say(f"snakesim {version('snakesim')}")
        parser.exit()


def parser() -> Commands:
    """The arguments of all commands, those of entry points among them."""
    made = Commands()
    made.add_installed()
    return made


def _add_completion(commands: Any) -> None:
    completion = commands.add_parser("completion", help="print a script for tab completion: source <(snakesim ...)")
    completion.add_argument("shell", choices=["bash", "zsh"])
    completion.set_defaults(act=_completion)


def _completion(arguments: argparse.Namespace) -> int:
    from snakesim_operator.this_computer.completion import completion

    for line in completion(parser(), arguments.shell):
        say(line)
    return OK


TASKS: Mapping[str, tuple[Callable[[Any], None], ...]] = {
    "run": (run.add_commands,),
    "watch": (watching.add_commands,),
    "command": (commanding.add_commands,),
    "results": (playback.add_commands,),
    "scenarios, robots, labs": (setup.add_files,),
    "this computer": (setup.add_commands, _add_completion),
}
