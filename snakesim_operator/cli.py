"""The `snakesim` command: its parser, made of the commands that all packages register.

Each package lists its commands as `snakesim_hal.programs.commands` describes. This package names its most important
lists in `BUILT_IN_COMMANDS`; all others are found by entry points in the group `snakesim.commands`. Entry points are
looked up only for the help, for completion, and for a command that is not built in: an emergency stop does not wait
for them.
"""

import argparse
import errno
import re
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.base.terminal import (
    discard_output,
    print_line,
    print_stderr,
    report_error,
    run_tool,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands
from snakesim_operator.monitoring import watching
from snakesim_operator.playback import arguments as playback
from snakesim_operator.robot_commands import commanding
from snakesim_operator.run import arguments as run
from snakesim_operator.this_computer import setup

OK, FAILED, BAD_INPUT = 0, 1, 2
NO_NOUN = ""  # noun of a command of one word, such as `snakesim run`
# In the order of the help.
HEADINGS = "daily work", "robot", "runs and studies", "files and computers"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command of `snakesim`, and report its errors on stderr.

    Args:
        argv: Arguments of the command. If None, the arguments of this process are used, and the command may change the
            state of the process, such as its signal handlers.

    Returns:
        The exit code: 0 done, 1 a fault, 2 wrong input and nothing started, 3 an incomplete record, 130 interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return run_tool(
            "snakesim",
            lambda: _run_command(words, owns_process=argv is None),
            as_json="--json" in words,
        )
    except ModuleNotFoundError as error:
        from snakesim_operator.base.extras import explain_missing_package

        explanation = explain_missing_package(error)
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
    """Find the command that some words name, parse its arguments and run it.

    Args:
        words: Words of the command line, without the name of the program.
        owns_process: Whether this process runs nothing but this command.

    Returns:
        The exit code of the command.

    Raises:
        ConfigError: There is no such command, or its arguments are wrong.
    """
    if not words:
        make_parser().print_help()
        return OK
    _reject_empty_words(words)
    parser = MainParser()
    if not parser.has_command(words):
        parser.add_installed_commands()
        _reject_unknown_command(words[0], parser)
    arguments, unknown = parser.parse_known_args(words)
    if unknown:
        _reject_unknown_argument(unknown[0], parser.find_parser(words))
    arguments.owns_process = owns_process
    return arguments.act(arguments)  # `act` is the command's function, which `_add_command` has set


def _reject_empty_words(words: list[str]) -> None:
    """Raise ConfigError for an empty word, or an option without its value, as of a shell variable that is not set."""
    for previous, word in zip(["", *words], words, strict=False):
        if not word or (word.startswith("--") and word.endswith("=")):
            option = word.rstrip("=") or previous or "the command"
            raise ConfigError(
                f"{option}: empty; give a value, or leave it out", code="command/invalid-option"
            )


def _reject_unknown_command(name: str, parser: "MainParser") -> None:
    """Raise ConfigError if the first word is no command."""
    names = list(parser.subparsers.choices)
    if name.startswith("-") or name in names:
        return
    raise ConfigError(
        f"no command {shorten(name)!r}; {suggest_word(name, names)}`snakesim` alone lists all",
        code="command/unknown-command",
    )


def _reject_unknown_argument(argument: str, parser: argparse.ArgumentParser) -> NoReturn:
    """Raise ConfigError for an argument that the command does not have."""
    options = [option for action in parser._actions for option in action.option_strings]
    hint = suggest_word(argument.partition("=")[0], options) if argument.startswith("-") else ""
    command = parser.prog.removeprefix("snakesim ")
    raise ConfigError(
        f"{command}: unknown argument {shorten(argument)!r}; {hint}see `{parser.prog} --help`",
        code="command/unknown-argument",
    )


class CommandHelpFormatter(argparse.HelpFormatter):
    """Wraps each line of a description or an epilog by itself; an indented line stays as it is."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines: list[str] = []
        for line in text.splitlines():
            if not line or line.startswith(" "):
                lines.append(line)
            else:
                lines += textwrap.wrap(line, width)
        return "\n".join(indent + line for line in lines)


class CommandParser(argparse.ArgumentParser):
    """The parser of one command."""

    def error(self, message: str) -> NoReturn:
        """End the process with one line instead of the whole usage."""
        plain = re.sub(
            r"invalid float value: (.*)", r"\1 is not a number; give it without a unit", message
        )
        plain = re.sub(
            r"invalid int value: (.*)", r"\1 is not a whole number; give it without a unit", plain
        )
        report_error(
            ConfigError(f"{plain}; see `{self.prog} --help`", code="command/invalid-option"),
            self.prog,
        )
        sys.exit(BAD_INPUT)


class MainParser(CommandParser):
    """The parser of all commands. Its help lists the commands by heading."""

    def __init__(self) -> None:
        """Create the parser with the built-in commands."""
        super().__init__(
            prog="snakesim",
            description="Snake robots that push themselves off obstacles: one controller, simulator or robot.",
            epilog="`snakesim COMMAND --help` explains a command. Begin with: snakesim run triplet --console",
        )
        self.add_argument("--version", action=_PrintVersion, nargs=0, help="print the version")
        # `Any`, because the class of subparsers is private in argparse.
        self.subparsers: Any = self.add_subparsers(
            required=True, metavar="COMMAND", parser_class=CommandParser
        )
        # The commands below each noun, such as "robot" of `snakesim robot arm`. Those of one word have the noun "".
        self._subparsers_by_noun: dict[str, Any] = {NO_NOUN: self.subparsers}
        self._actions_by_heading: dict[str, list[argparse.Action]] = {
            heading: [] for heading in HEADINGS
        }
        for registered in BUILT_IN_COMMANDS:
            self._add_commands(registered)

    def add_installed_commands(self) -> None:
        """Add the commands of entry points. A package that cannot be loaded is reported, and the others are added."""
        from snakesim_hal.model.plugins import COMMANDS, list_installed_plugins, load_plugin

        for name in list_installed_plugins(COMMANDS):
            try:
                self._add_commands(load_plugin(COMMANDS, name))
            except ConfigError as error:
                report_error(error, "snakesim")

    def _add_commands(self, registered: Commands) -> None:
        """Add nouns and commands to the parser. Those that have been added before stay as they are.

        Args:
            registered: Nouns and commands, each noun before its commands.

        Raises:
            ConfigError: The noun of a command is missing.
        """
        for entry in registered:
            noun, _, word = entry.name.rpartition(" ")
            if noun not in self._subparsers_by_noun:
                raise ConfigError(
                    f"command {entry.name!r} cannot be added: no Noun {noun!r} is registered before it"
                )
            siblings = self._subparsers_by_noun[noun]
            if word in siblings.choices:
                continue
            if isinstance(entry, CommandGroup):
                self._add_noun(entry, siblings, word)
            else:
                _add_command(entry, siblings, word)
            if not noun:
                self._actions_by_heading.setdefault(entry.heading, []).append(
                    siblings._choices_actions[-1]
                )

    def _add_noun(self, noun: CommandGroup, siblings: Any, word: str) -> None:
        parser = siblings.add_parser(
            word, help=_format_list_entry(noun.help), description=noun.help
        )
        parser.epilog = f"`{parser.prog} COMMAND --help` explains a command."
        self._subparsers_by_noun[noun.name] = parser.add_subparsers(
            required=True, metavar="COMMAND", parser_class=CommandParser
        )

    def list_commands_by_heading(self) -> list[tuple[str, list[argparse.Action]]]:
        """Return the headings of the help, each with its nouns and commands."""
        return [
            (heading, actions) for heading, actions in self._actions_by_heading.items() if actions
        ]

    def has_command(self, words: Sequence[str]) -> bool:
        """Return whether the words begin with a command that has been added, not only with a noun."""
        noun = NO_NOUN
        for word in words:
            path = f"{noun} {word}".strip()
            if path not in self._subparsers_by_noun:
                return word in self._subparsers_by_noun[noun].choices
            noun = path
        return False

    def find_parser(self, words: Sequence[str]) -> argparse.ArgumentParser:
        """Return the parser of the command or noun with which the words begin; this parser if there is none."""
        parser: argparse.ArgumentParser = self
        for word in words:
            subparsers = find_subparsers(parser)
            if word in subparsers:
                parser = subparsers[word]
        return parser

    def format_help(self) -> str:
        """Return the help, with the commands by heading."""
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        for heading, actions in self.list_commands_by_heading():
            formatter.start_section(heading)
            formatter.add_arguments(actions)
            formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()


def _add_command(command: Command, siblings: Any, word: str) -> None:
    """Add the parser of a command."""
    parser = siblings.add_parser(
        word,
        help=_format_list_entry(command.help),
        description=command.help,
        epilog=_format_epilog(command),
        formatter_class=CommandHelpFormatter,
    )
    command.add(parser)
    parser.set_defaults(act=command.run)


def _format_list_entry(sentence: str) -> str:
    """Return a sentence as an entry of a list: with a small first letter, and without a full stop.

    A first word in capitals, such as an abbreviation, stays as it is.
    """
    first_word = sentence.partition(" ")[0]
    text = sentence.removesuffix(".")
    return text if first_word.isupper() else text[0].lower() + text[1:]


def _format_epilog(command: Command) -> str:
    """Return the text below the options in the help of a command: details, and the examples, one a line."""
    lines = [command.details, ""] if command.details else []
    return "\n".join(
        [*lines, "examples:", *(f"  snakesim {example}" for example in command.examples)]
    )


def find_subparsers(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of a parser's subcommands by name; empty for a command without subcommands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return action.choices
    return {}


class _PrintVersion(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print_line(f"snakesim {version('snakesim')}")
        parser.exit()


def make_parser() -> MainParser:
    """Return the parser of all commands, with those of entry points."""
    parser = MainParser()
    parser.add_installed_commands()
    return parser


def _add_completion(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=["bash", "zsh"], help="shell that reads the script")


def _print_completion_script(arguments: argparse.Namespace) -> int:
    from snakesim_operator.this_computer.completion import generate_completion_script

    for line in generate_completion_script(make_parser(), arguments.shell):
        print_line(line)
    return OK


COMPLETION = Command(
    name="completion",
    heading="files and computers",
    help="Print a script for tab completion.",
    add=_add_completion,
    run=_print_completion_script,
    details="Add to ~/.bashrc: source <(snakesim completion bash)",
    examples=("completion bash", "completion zsh"),
)
BUILT_IN_COMMANDS: tuple[Commands, ...] = (
    run.COMMANDS,
    playback.COMMANDS,
    watching.COMMANDS,
    commanding.COMMANDS,
    setup.COMMANDS,
    (COMPLETION,),
)
