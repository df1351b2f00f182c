"""The grammar of `snakesim`: few first words, help and examples for each command, one meaning for each option."""

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
WITHOUT_REPORT = {  # they move, start or write something; what they print says what was done
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


def walk(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """All commands below a parser, without the nouns."""
    below = find_subparsers(parser)
    if not below:
        yield parser
    for inner in below.values():
        yield from walk(inner)


def name_of(parser: argparse.ArgumentParser) -> str:
    return parser.prog.removeprefix("snakesim ")


TREE = make_parser()
LEAVES = {name_of(leaf): leaf for leaf in walk(TREE)}


def test_command_tree_has_few_top_level_words() -> None:
    assert len(TREE.subparsers.choices) <= MAX_COMMANDS
    listed = [action.dest for _, actions in TREE.list_commands_by_heading() for action in actions]
    assert sorted(listed) == sorted(TREE.subparsers.choices), "each has a heading"


@pytest.mark.parametrize("name", LEAVES)
def test_each_command_has_help_and_two_examples_that_parse(name: str) -> None:
    leaf = LEAVES[name]
    assert leaf.description
    assert leaf.description.endswith(".")
    assert leaf.epilog
    _, _, examples = leaf.epilog.rpartition("examples:\n")
    lines = [line.strip() for line in examples.splitlines()]
    assert len(lines) == 2 and len(set(lines)) == 2, lines
    for line in lines:
        program, *words = shlex.split(line.partition(" > ")[0])
        assert program == "snakesim" and " ".join(words).startswith(name), line
        assert TREE.parse_args(words).act is not None
    for action in leaf._actions:
        assert action.help, f"{name}: {action.dest} has no help"


def test_each_option_means_the_same_everywhere() -> None:
    meanings: dict[str, dict[tuple[str, object], list[str]]] = {}
    for name, leaf in LEAVES.items():
        for action in leaf._actions:
            for option in action.option_strings:
                meaning = (
                    action.dest,
                    action.metavar if action.choices is None else tuple(action.choices),
                )
                meanings.setdefault(option, {}).setdefault(meaning, []).append(name)
    assert not {option: found for option, found in meanings.items() if len(found) > 1}


def test_each_report_is_also_for_scripts() -> None:
    with_json = {name for name, leaf in LEAVES.items() if "--json" in leaf.format_help()}
    assert with_json == LEAVES.keys() - WITHOUT_REPORT


def test_each_robot_is_addressed_in_the_same_way() -> None:
    for name, leaf in LEAVES.items():
        options = {option for action in leaf._actions for option in action.option_strings}
        network = {"--endpoint", "--router", "--session", "--namespace"} & options
        assert name == "replay" or len(network) in (0, 4), name


def test_messages_and_pages_name_commands_that_exist() -> None:
    page = make_page()
    for words in re.findall(r"`snakesim ([a-z0-9 ]+)`", page):
        assert TREE.has_command(words.split()) or words in {
            *TREE.subparsers.choices,
            "robot calibrate",
        }, words


def test_command_reference_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == make_page(), "run `make schemas`"


# --- packages that add commands ----------------------------------------------------------------------------

LOWER = Command(
    name="arm_rest lower",
    help="Lower the arm rest.",
    run=lambda arguments: arguments.mm,
    add=lambda parser: parser.add_argument("mm", type=int),  # pyright: ignore[reportArgumentType]
    examples=("arm_rest lower 5", "arm_rest lower 20"),
)
NOUN = CommandGroup(name="arm_rest", heading="robot", help="Move the arm rest.")


def added(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a package with the entry point `arm_rest` be installed."""
    names = [*list_installed_plugins(COMMANDS), "arm_rest"]
    monkeypatch.setattr("snakesim_hal.model.plugins.list_installed_plugins", lambda _group: names)


def test_a_package_adds_a_noun_and_a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    added(monkeypatch)
    with register_plugin_temporarily(COMMANDS, "arm_rest", (NOUN, LOWER)):
        assert main(["arm_rest", "lower", "7"]) == 7
        assert "arm_rest" in make_parser().format_help()


def test_command_without_noun_is_reported_and_others_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    added(monkeypatch)
    with register_plugin_temporarily(COMMANDS, "arm_rest", (LOWER,)):
        parser = MainParser()
        parser.add_installed_commands()
    assert "no Noun 'arm_rest' is registered" in capsys.readouterr().err
    assert isinstance(parser, CommandParser)
    assert parser.has_command(["robot", "check"])
