"""The grammar of `snakesim`: few top-level words, help and examples for each command, one meaning for each option."""

import argparse
import re
import shlex
from collections.abc import Iterator

import pytest

from docs.site.commands_page import PAGE, make_page
from snakesim_hal.model.plugins import COMMANDS, list_installed_plugins, register_plugin_temporarily
from snakesim_hal.programs.commands import Command, CommandGroup
from snakesim_operator.cli import CommandParser, MainParser, find_subparsers, main, make_parser

MAX_COMMANDS = 25
# These commands move, start or write something, and print only what they did.
COMMANDS_WITHOUT_REPORT = {
    *("run", "replay", "console", "teleop", "record", "estop", "completion"),
    *("start host", "start service", "start preview", "start ros2", "start router"),
    *("robot arm", "robot disarm", "robot reset", "robot export", "robot jog"),
    *(
        "robot calibrate zero",
        "robot calibrate direction",
        "robot calibrate limits",
        "robot calibrate gear",
    ),
    *("robot shape draw", "robot shape check"),
    *("param set", "fault inject", "sim pause", "sim resume", "sim step", "sim speed", "sim reset"),
    *(
        "drive emulate can",
        "drive emulate odrive",
        "drive emulate moteus",
        "drive emulate cia402",
        "drive emulate dynamixel",
        "drive emulate feetech",
    ),
    *("drive replay can", "drive dbc", "drive new"),
    *(
        "recording report",
        "recording export",
        "recording video",
        "recording plot",
        "recording rosbag",
    ),
    *("study evaluate", "study sweep", "study optimize", "policy train"),
    *("lab example", "lab render", "lab certs"),
    "topic echo",  # always JSON
}


def iterate_commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield the parsers of all commands below a parser, without the parsers of command groups."""
    subparsers = find_subparsers(parser)
    if not subparsers:
        yield parser
    for subparser in subparsers.values():
        yield from iterate_commands(subparser)


MAIN_PARSER = make_parser()
COMMAND_PARSERS = {
    command.prog.removeprefix("snakesim "): command for command in iterate_commands(MAIN_PARSER)
}


def test_command_tree_has_few_top_level_words() -> None:
    assert len(MAIN_PARSER.subparsers.choices) <= MAX_COMMANDS
    listed = [
        action.dest for _, actions in MAIN_PARSER.list_commands_by_heading() for action in actions
    ]
    assert sorted(listed) == sorted(MAIN_PARSER.subparsers.choices), "each word has a heading"


@pytest.mark.parametrize("name", COMMAND_PARSERS)
def test_command_has_help_and_two_examples_that_parse(name: str) -> None:
    parser = COMMAND_PARSERS[name]
    assert parser.description
    assert parser.description.endswith(".")
    assert parser.epilog
    _, _, examples = parser.epilog.rpartition("examples:\n")
    lines = [line.strip() for line in examples.splitlines()]
    assert len(lines) == 2 and len(set(lines)) == 2, lines
    for line in lines:
        program, *arguments = shlex.split(line.partition(" > ")[0])
        assert program == "snakesim" and " ".join(arguments).startswith(name), line
        assert MAIN_PARSER.parse_args(arguments).act is not None
    for action in parser._actions:
        assert action.help, f"{name}: {action.dest} has no help"


def test_command_option_has_the_same_meaning_everywhere() -> None:
    meanings: dict[str, dict[tuple[str, object], list[str]]] = {}
    for name, parser in COMMAND_PARSERS.items():
        for action in parser._actions:
            values = action.metavar if action.choices is None else tuple(action.choices)
            for option in action.option_strings:
                commands = meanings.setdefault(option, {}).setdefault((action.dest, values), [])
                commands.append(name)
    assert not {option: several for option, several in meanings.items() if len(several) > 1}


def test_command_with_report_has_json_option() -> None:
    with_json = {
        name for name, parser in COMMAND_PARSERS.items() if "--json" in parser.format_help()
    }
    assert with_json == COMMAND_PARSERS.keys() - COMMANDS_WITHOUT_REPORT


def test_command_with_network_options_has_all_four() -> None:
    for name, parser in COMMAND_PARSERS.items():
        options = {option for action in parser._actions for option in action.option_strings}
        network_options = {"--endpoint", "--router", "--session", "--namespace"} & options
        assert name == "replay" or len(network_options) in (0, 4), name


def test_command_reference_names_only_existing_commands() -> None:
    page = make_page()
    command_groups = {*MAIN_PARSER.subparsers.choices, "robot calibrate"}
    for command in re.findall(r"`snakesim ([a-z0-9 ]+)`", page):
        assert MAIN_PARSER.has_command(command.split()) or command in command_groups, command


def test_command_reference_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == make_page(), "run `make schemas`"


# --- packages that add commands ----------------------------------------------------------------------------

LOWER_COMMAND = Command(
    name="arm_rest lower",
    help="Lower the arm rest.",
    run=lambda arguments: arguments.mm,
    add=lambda parser: parser.add_argument("mm", type=int),  # pyright: ignore[reportArgumentType]
    examples=("arm_rest lower 5", "arm_rest lower 20"),
)
ARM_REST_GROUP = CommandGroup(name="arm_rest", heading="robot", help="Move the arm rest.")


def pretend_package_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the entry point `arm_rest` to those of the installed packages."""
    names = [*list_installed_plugins(COMMANDS), "arm_rest"]
    monkeypatch.setattr("snakesim_hal.model.plugins.list_installed_plugins", lambda _group: names)


def test_command_group_of_installed_package_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_package_is_installed(monkeypatch)
    with register_plugin_temporarily(COMMANDS, "arm_rest", (ARM_REST_GROUP, LOWER_COMMAND)):
        assert main(["arm_rest", "lower", "7"]) == 7
        assert "arm_rest" in make_parser().format_help()


def test_command_without_its_group_is_reported_and_others_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pretend_package_is_installed(monkeypatch)
    with register_plugin_temporarily(COMMANDS, "arm_rest", (LOWER_COMMAND,)):
        parser = MainParser()
        parser.add_installed_commands()
    assert "no Noun 'arm_rest' is registered" in capsys.readouterr().err
    assert isinstance(parser, CommandParser)
    assert parser.has_command(["robot", "check"])
