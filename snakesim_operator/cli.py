"""The `snakesim` command: its own commands, and those that entry points in the group `snakesim.commands` add.

An entry point names `add_commands(commands)`, in whose module `TASK` is the heading for the help, or `main(argv)` of a
command that parses its own arguments. Entry points are looked up only for the help, completion, and a command that is
not known here: an emergency stop does not wait for them.
"""

import argparse
import errno
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.base.terminal import discard_output, print_line, print_stderr, report_error, run_tool
from snakesim_operator.monitoring import watching
from snakesim_operator.playback import arguments as playback
from snakesim_operator.robot_commands import commanding
from snakesim_operator.run import arguments as run
from snakesim_operator.this_computer import setup

OK, FAILED, BAD_INPUT = 0, 1, 2
ADDS = "add_commands"  # the name of an entry point's function that adds to the parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: the arguments; None for those of this process, which runs nothing but this command then.

    Returns:
        The exit code: 0 done, 1 a fault, 2 wrong input and nothing started, 3 an incomplete record, 130 interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return run_tool("snakesim", lambda: _run_command(words, owns_process=argv is None), as_json="--json" in words)
    except ModuleNotFoundError as error:
        from snakesim_operator.base.extras import explained

        explanation = explained(error)
        if explanation is None:
            raise
        report_error(explanation, "snakesim")
        return BAD_INPUT
    except OSError as error:  # such as a full disk under what is printed
        discard_output(sys.stdout)
        return _report_os_error(error)


def _report_os_error(error: OSError) -> int:
    """Print an error of the system in one line. Returns the exit code; raises MemoryError when memory is used up."""
    if isinstance(error, BrokenPipeError):  # the reader of a pipe has closed it
        return OK
    if error.errno == errno.ENOMEM:
        raise MemoryError from error
    file = f"{error.filename}: " if error.filename else ""
    print_stderr(f"snakesim: {file}{error.strerror or error}")
    return FAILED


def _run_command(words: list[str], *, owns_process: bool) -> int:
    """Find the command, parse its arguments and run it. Raises ConfigError for wrong input."""
    if not words:
        parser().print_help()
        return OK
    _refuse_empty_words(words)
    commands = Commands()
    name = words[0]
    if name.startswith("-"):
        commands.add_installed()
    elif name not in commands.commands.choices:
        own_main = _find_installed_command(commands, name)
        if own_main is not None:
            return own_main(words[1:])
    arguments, unknown = commands.parse_known_args(words)
    if unknown:
        _refuse_unknown_word(unknown[0], commands.find_parser(words))
    arguments.owns_process = owns_process
    return arguments.act(arguments)


def _refuse_empty_words(words: list[str]) -> None:
    """Raise ConfigError for an empty word, or an option without its value, as of a shell variable that is not set."""
    for previous, word in zip(["", *words], words, strict=False):
        if not word or (word.startswith("--") and word.endswith("=")):
            option = word.rstrip("=") or previous or "the command"
            raise ConfigError(f"{option}: empty; give a value, or leave it out", code="command/invalid-option")


def _find_installed_command(commands: "Commands", name: str) -> Callable[[list[str]], int] | None:
    """Find a command of an entry point. Raises ConfigError when there is no such command.

    Returns:
        Its main function, if it parses its own arguments; None if the command was added to the parser.
    """
    from snakesim_hal.model.plugins import COMMANDS, find_plugin, list_installed

    if name not in list_installed(COMMANDS):
        commands.add_installed()
        hint = suggest_word(name, [*commands.commands.choices, *list_installed(COMMANDS)])
        raise ConfigError(
            f"no command {shorten(name)!r}; {hint}`snakesim` alone lists all", code="command/unknown-command"
        )
    plugin = find_plugin(COMMANDS, name)
    if getattr(plugin, "__name__", "") != ADDS:
        return plugin
    plugin(commands.commands)
    return None


def _refuse_unknown_word(word: str, parser: argparse.ArgumentParser) -> NoReturn:
    """Raise ConfigError for an argument that the command does not have."""
    options = [option for action in parser._actions for option in action.option_strings]
    hint = suggest_word(word.partition("=")[0], options) if word.startswith("-") else ""
    command = parser.prog.removeprefix("snakesim ")
    raise ConfigError(
        f"{command}: unknown argument {shorten(word)!r}; {hint}see `{parser.prog} --help`",
        code="command/unknown-argument",
    )


class Command(argparse.ArgumentParser):
    """The parser of one command."""

    def error(self, message: str) -> NoReturn:
        """End the process with one line instead of the whole usage."""
        plain = re.sub(r"invalid float value: (.*)", r"\1 is not a number; give it without a unit", message)
        plain = re.sub(r"invalid int value: (.*)", r"\1 is not a whole number; give it without a unit", plain)
        report_error(ConfigError(f"{plain}; see `{self.prog} --help`", code="command/invalid-option"), self.prog)
        sys.exit(BAD_INPUT)


class Commands(Command):
    """The parser of all commands but those of installed packages; its help lists the commands by task."""

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
        """Add the commands of entry points. A command that cannot be loaded is reported, and the others are added."""
        from importlib.metadata import entry_points

        from snakesim_hal.model.plugins import COMMANDS, find_plugin

        for entry in sorted(entry_points(group=COMMANDS)):
            if entry.attr != ADDS or entry.name in self.commands.choices:  # one `add_commands` may add several
                continue
            try:
                add = find_plugin(COMMANDS, entry.name)
            except ConfigError as error:
                report_error(error, "snakesim")
                continue
            before = len(self.commands._choices_actions)
            add(self.commands)
            task = getattr(sys.modules[add.__module__], "TASK", "more")
            self._tasks.setdefault(task, []).extend(self.commands._choices_actions[before:])

    def format_help(self) -> str:
        """Return the help: the commands by task, and those of installed packages by name."""
        from snakesim_hal.model.plugins import COMMANDS, list_installed

        others = [name for name in list_installed(COMMANDS) if name not in self.commands.choices]
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

    def find_parser(self, words: Sequence[str]) -> argparse.ArgumentParser:
        """Return the parser of the command, or of the part of a command, that the words name."""
        parser: argparse.ArgumentParser = self
        for word in words:
            for action in parser._actions:
                if isinstance(action, argparse._SubParsersAction) and word in action.choices:
                    parser = action.choices[word]
                    break
        return parser


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print_line(f"snakesim {version('snakesim')}")
        parser.exit()


def parser() -> Commands:
    """Return the parser of all commands, with those of entry points."""
    commands = Commands()
    commands.add_installed()
    return commands


def _add_completion(commands: Any) -> None:
    completion = commands.add_parser("completion", help="print a script for tab completion: source <(snakesim ...)")
    completion.add_argument("shell", choices=["bash", "zsh"])
    completion.set_defaults(act=_completion)


def _completion(arguments: argparse.Namespace) -> int:
    from snakesim_operator.this_computer.completion import completion

    for line in completion(parser(), arguments.shell):
        print_line(line)
    return OK


TASKS: Mapping[str, tuple[Callable[[Any], None], ...]] = {
    "run": (run.add_commands,),
    "watch": (watching.add_commands,),
    "command": (commanding.add_commands,),
    "results": (playback.add_commands,),
    "scenarios, robots, labs": (setup.add_files,),
    "this computer": (setup.add_commands, _add_completion),
}
