"""`snakesim completion bash|zsh`: tab completion, generated from the parsers.

source <(snakesim completion bash)        # in ~/.bashrc
source <(snakesim completion zsh)         # in ~/.zshrc

Not by shtab: the smallest installation completes, too, without one more dependency; commands of installed packages have
parsers of their own; and each shell gets the same function.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import entry_points

from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.fault_kinds import KINDS
from snakesim_hal.model.files import list_shipped
from snakesim_hal.model.plugins import BACKENDS, COMMANDS, CONTROLLERS, list_installed
from snakesim_hal.wire import keys

KNOWN: dict[str, Callable[[], list[str]]] = {  # values of arguments, by the argument's name in any command
    "scenario": lambda: list_shipped("scenarios"),
    "robot": lambda: list_shipped("robots"),
    "suite": lambda: list_shipped("suites"),
    "backend": lambda: list_installed(BACKENDS),
    "controller": lambda: list_installed(CONTROLLERS),
    "kind": lambda: sorted({kind for kinds in KINDS.values() for kind in kinds}),
    "key": lambda: [row.key for row in keys.SPACE if row.kind in ("stream", "latched")],
}
ZSH = "(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }; autoload -Uz bashcompinit && bashcompinit"
FUNCTION = """\
_snakesim() {
    local given=${COMP_WORDS[COMP_CWORD]} command='' before='' choices='' options='' i
    for ((i = 1; i < COMP_CWORD; i++)); do
        before=${COMP_WORDS[i]}
        case "$command $before" in
            @COMMANDS@) command="$command $before" ;;
        esac
    done
    case "$command:$before" in
@VALUES@
        *)
            case "$command" in
@WORDS@
            esac
            [[ $given == -* ]] && choices=$options
            ;;
    esac
    COMPREPLY=($(compgen -W "$choices" -- "$given"))
}
complete -o bashdefault -o default -F _snakesim snakesim
"""


@dataclass
class Command:
    """What can follow a command: its path is empty, ` run`, ` can load` and so on."""

    path: str
    options: list[str] = field(default_factory=list[str])
    words: list[str] = field(default_factory=list[str])  # subcommands and choices that stand alone
    values: dict[str, list[str]] = field(default_factory=dict[str, list[str]])  # of options that take one; [] is any


def completion(parser: argparse.ArgumentParser, shell: str) -> Iterator[str]:
    """The lines of a script for the shell."""
    commands = list(_walk(parser, ""))
    paths = "|".join(f'"{command.path}"' for command in commands if command.path)
    values: dict[str, list[str]] = {}
    for command in commands:
        for option, choices in command.values.items():
            values.setdefault(" ".join(choices), []).append(f'"{command.path}:{option}"')
    after = [f'        {"|".join(places)}) choices="{choices}" ;;' for choices, places in values.items()]
    words: list[str] = []
    for command in commands:
        lists = f'choices="{" ".join(command.words)}"; options="{" ".join(command.options)}"'
        words.append(f'                "{command.path}") {lists} ;;')
    text = FUNCTION.replace("@COMMANDS@", paths).replace("@VALUES@", "\n".join(after))
    if shell == "zsh":
        yield ZSH
    yield from text.replace("@WORDS@", "\n".join(words)).splitlines()


def _walk(parser: argparse.ArgumentParser, path: str) -> Iterator[Command]:
    """A parser and those below it, and those of installed packages."""
    here = Command(path)
    below: list[Command] = []
    for action in parser._actions:
        choices = _choices(action)
        if isinstance(action, argparse._SubParsersAction):
            here.words += choices
            for name, inner in action.choices.items():
                below += _walk(inner, f"{path} {name}")
        elif not action.option_strings:
            here.words += choices
        elif action.nargs == 0:
            here.options += action.option_strings
        else:
            here.options += action.option_strings
            here.values |= dict.fromkeys(action.option_strings, choices)
    if not path:
        for name in sorted({*list_installed(COMMANDS)} - {*here.words}):
            here.words.append(name)
            below += _of_package(name)
    yield here
    yield from below


def _of_package(name: str) -> list[Command]:
    """A command of an installed package, if it has a `parser` beside its `main`."""
    entry = next(iter(entry_points(group=COMMANDS, name=name)))
    try:
        parser = getattr(import_module(entry.module), "parser", None)
    except ImportError as error:
        if entry.extras and isinstance(error, ModuleNotFoundError):  # left out on purpose
            return [Command(f" {name}")]
        print_stderr(f"snakesim {name} cannot be completed: {error}")
        return []
    return list(_walk(parser(), f" {name}")) if parser is not None else [Command(f" {name}")]


def _choices(action: argparse.Action) -> list[str]:
    if action.dest in KNOWN:
        return KNOWN[action.dest]()
    return [str(choice) for choice in action.choices or ()]
