"""`snakesim completion bash|zsh`: tab completion, generated from the parsers.

source <(snakesim completion bash)        # in ~/.bashrc
source <(snakesim completion zsh)         # in ~/.zshrc

Not by shtab: it completes commands, options and choices, but names of scenarios, robots and keys would need a function
in each shell's language. Here bash and zsh get the same function, and the smallest installation completes, too.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from snakesim_hal.model.fault_kinds import FAULT_KINDS
from snakesim_hal.model.files import SHIPPED_FILES_DIR, list_shipped_names
from snakesim_hal.model.plugins import BACKENDS, CONTROLLERS, list_installed_plugins
from snakesim_hal.wire import keys

LIST_VALUES_BY_ARGUMENT: dict[
    str, Callable[[], list[str]]
] = {  # values of arguments, by the argument's name in any command
    "scenario": lambda: list_shipped_names("scenarios"),
    "robot": lambda: list_shipped_names("robots"),
    "suite": lambda: list_shipped_names("suites"),
    "backend": lambda: list_installed_plugins(BACKENDS),
    "controller": lambda: list_installed_plugins(CONTROLLERS),
    "kind": lambda: sorted({kind for kinds in FAULT_KINDS.values() for kind in kinds}),
    "policy": lambda: sorted(path.stem for path in (SHIPPED_FILES_DIR / "policies").glob("*.onnx")),
    "key": lambda: [row.key for row in keys.SPACE if row.kind in ("stream", "latched")],
}
ZSH_PREAMBLE = (
    "(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }; autoload "
    "-Uz bashcompinit && bashcompinit"
)
SHELL_FUNCTION = """\
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
class CommandCompletions:
    """The words that can follow one command; the path of the command is empty, ` run`, ` robot arm` and so on."""

    path: str
    options: list[str] = field(default_factory=list[str])
    words: list[str] = field(default_factory=list[str])  # subcommands and choices that stand alone
    # Of options that take one; [] is any.
    values: dict[str, list[str]] = field(default_factory=dict[str, list[str]])


def generate_completion_script(parser: argparse.ArgumentParser, shell: str) -> Iterator[str]:
    """Yield the lines of a completion script.

    Args:
        parser: Parser of all commands.
        shell: "bash" or "zsh".
    """
    commands = list(_find_completions(parser, ""))
    paths = "|".join(f'"{command.path}"' for command in commands if command.path)
    values: dict[str, list[str]] = {}
    for command in commands:
        for option, choices in command.values.items():
            values.setdefault(" ".join(choices), []).append(f'"{command.path}:{option}"')
    after = [
        f'        {"|".join(places)}) choices="{choices}" ;;' for choices, places in values.items()
    ]
    words: list[str] = []
    for command in commands:
        lists = f'choices="{" ".join(command.words)}"; options="{" ".join(command.options)}"'
        words.append(f'                "{command.path}") {lists} ;;')
    text = SHELL_FUNCTION.replace("@COMMANDS@", paths).replace("@VALUES@", "\n".join(after))
    if shell == "zsh":
        yield ZSH_PREAMBLE
    yield from text.replace("@WORDS@", "\n".join(words)).splitlines()


def _find_completions(
    parser: argparse.ArgumentParser, command_path: str
) -> Iterator[CommandCompletions]:
    """Yield the completions of a command, then those of each of its subcommands.

    Args:
        parser: Parser of the command.
        command_path: Words of the command behind `snakesim`, each after a space, such as ` robot arm`; empty for
            `snakesim` itself.
    """
    completions = CommandCompletions(command_path)
    subcommand_completions: list[CommandCompletions] = []
    for action in parser._actions:
        # Only other processes use it.
        is_internal = action.help == argparse.SUPPRESS and action.option_strings
        if is_internal:
            continue
        choices = _list_choices(action)
        if isinstance(action, argparse._SubParsersAction):
            completions.words += choices
            for name, subparser in action.choices.items():
                subcommand_completions += _find_completions(subparser, f"{command_path} {name}")
        elif not action.option_strings:
            completions.words += choices
        else:
            completions.options += action.option_strings
            takes_value = action.nargs != 0
            if takes_value:
                completions.values |= dict.fromkeys(action.option_strings, choices)
    yield completions
    yield from subcommand_completions


def _list_choices(action: argparse.Action) -> list[str]:
    if action.dest in LIST_VALUES_BY_ARGUMENT:
        return LIST_VALUES_BY_ARGUMENT[action.dest]()
    return [str(choice) for choice in action.choices or ()]
