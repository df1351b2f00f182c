"""The commands that read what a robot publishes: `snakesim status`, `topic`, `record` and `start preview`."""

import argparse
import sys
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.programs.arguments import (
    add_duration_argument,
    add_json_argument,
    add_network_arguments,
    add_output_argument,
    add_task_argument,
    make_number_parser,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands
from snakesim_operator.base.robot_selection import select_robots
from snakesim_operator.recording.log_clock import LOG_TIME_CLOCK_HELP, LOG_TIME_CLOCKS
from snakesim_operator.recording.message import RAW_ONLY_HELP

MAX_TASK_CHARACTERS = 200


def _add_status(parser: argparse.ArgumentParser) -> None:
    add_network_arguments(parser)
    add_json_argument(parser)


def _add_topic_list(parser: argparse.ArgumentParser) -> None:
    add_json_argument(parser)


def _add_echo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "key",
        metavar="KEY",
        help="such as sensor/joints or sensor/* (`snakesim topic list` has all)",
    )
    _add_count(parser, "end after this many messages")
    add_network_arguments(parser)


def _add_rate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "key", nargs="?", metavar="KEY", help="only this key, such as sensor/joints or sensor/*"
    )
    parser.add_argument(
        "--once", action="store_true", help="listen for two seconds, print one table, and end"
    )
    _add_count(parser, "end after this many seconds, with KEY")
    add_network_arguments(parser)
    add_json_argument(parser)


def _add_count(parser: argparse.ArgumentParser, help_text: str) -> None:
    parser.add_argument("--count", type=make_number_parser(1, 10**9), metavar="N", help=help_text)


def _add_record(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim record`, which records the messages of a running robot, or demonstrations."""
    add_output_argument(parser, "the MCAP file (default: NAMESPACE-TIME.mcap)")
    parser.add_argument(
        "--episodes",
        type=Path,
        metavar="DIR",
        help="record demonstrations into this folder, one after the other, begun and ended by Enter",
    )
    add_task_argument(parser, "with --episodes: what is demonstrated, in words")
    add_duration_argument(
        parser, "end after this time by the wall clock", make_number_parser(0.0, 1e9, "s")
    )
    parser.add_argument(
        "--stamps", choices=LOG_TIME_CLOCKS, help=f"{LOG_TIME_CLOCK_HELP} (default: robot)"
    )
    viewers = parser.add_mutually_exclusive_group()
    viewers.add_argument("--raw-only", action="store_true", help=RAW_ONLY_HELP)
    viewers.add_argument(
        "--foxglove",
        type=make_number_parser(0, 65535),
        nargs="?",
        const=8765,
        metavar="PORT",
        help="serve Foxglove live as well, at ws://127.0.0.1:PORT (8765)",
    )
    parser.add_argument(
        "--foxglove-origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="a web page that may read the robot there, such as https://app.foxglove.dev (may be repeated)",
    )
    add_network_arguments(parser)


def _add_preview(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--hz",
        type=float,
        default=2.0,
        metavar="HZ",
        help="maximum previews a second of a camera (default: 2)",
    )
    parser.add_argument(
        "--width",
        type=int,
        default=320,
        metavar="PIXELS",
        help="maximum width of a preview (default: 320)",
    )
    add_network_arguments(parser)


def _print_status(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.status import print_status

    return print_status(select_robots(arguments), as_json=arguments.json)


def _print_topics(arguments: argparse.Namespace) -> int:
    from snakesim_operator.monitoring.echo import print_topics

    return print_topics(as_json=arguments.json)


def _echo_messages(arguments: argparse.Namespace) -> int:
    from snakesim_operator.monitoring.echo import echo_messages

    return echo_messages(arguments.key, select_robots(arguments), count=arguments.count)


def _print_rates(arguments: argparse.Namespace) -> int:
    if arguments.key is None:
        if arguments.count is not None:
            raise ConfigError("--count is for one KEY; name it, or give --once")
        from snakesim_operator.monitoring.top import show_traffic

        return show_traffic(select_robots(arguments), once=arguments.once, as_json=arguments.json)
    from snakesim_operator.monitoring.echo import print_rates

    count = 1 if arguments.once else arguments.count
    return print_rates(arguments.key, select_robots(arguments), count=count, as_json=arguments.json)


def _record_robot_or_demonstrations(arguments: argparse.Namespace) -> int:
    """Run `snakesim record`: record a running robot into a file, or demonstrations into a folder with --episodes.

    Returns:
        The exit code.

    Raises:
        ConfigError: Options contradict each other, such as --task without --episodes, or an extra is not installed.
    """
    from snakesim_operator.base import extras

    if arguments.episodes is not None:
        return _record_demonstrations(arguments)
    if arguments.task is not None:
        raise ConfigError(
            "--task is for --episodes DIR; add it, or leave --task out",
            code="command/conflicting-options",
        )
    if arguments.foxglove is not None:
        extras.require_extra("console", "--foxglove")
    from snakesim_operator.playback.record_command import record_robot

    return record_robot(
        select_robots(arguments),
        arguments.out,
        arguments.duration,
        foxglove_port=arguments.foxglove,
        foxglove_origins=arguments.foxglove_origin,
        raw_only=arguments.raw_only,
        stamps=arguments.stamps
        or "robot",  # no default in argparse: None means that --stamps was not given
    )


def _record_demonstrations(arguments: argparse.Namespace) -> int:
    """Run `snakesim record --episodes`, which requires --task and excludes the options of a single file.

    Returns:
        The exit code.

    Raises:
        ConfigError: Options contradict each other, or --task is missing or too long.
    """
    for name in ("out", "duration", "foxglove", "stamps"):
        if getattr(arguments, name) is not None:
            raise ConfigError(
                f"--{name} and --episodes: episodes are files in a folder, begun and ended by Enter",
                code="command/conflicting-options",
            )
    task = (arguments.task or "").strip()
    if not 0 < len(task) <= MAX_TASK_CHARACTERS:
        raise ConfigError(
            f"--task: describe what is demonstrated, in at most {MAX_TASK_CHARACTERS} characters: "
            "--task 'through the pegs'",
            code="command/invalid-option",
        )
    from snakesim_operator.playback.demonstrations import record_demonstrations

    return record_demonstrations(
        select_robots(arguments), arguments.episodes, task, iter(sys.stdin)
    )


def _publish_previews(arguments: argparse.Namespace) -> int:
    from snakesim_operator.monitoring.preview import publish_previews

    return publish_previews(select_robots(arguments), arguments.hz, arguments.width)


COMMANDS: Commands = (
    Command(
        name="record",
        heading="daily work",
        help="Record everything that a robot publishes into an MCAP file.",
        add=_add_record,
        run=_record_robot_or_demonstrations,
        examples=(
            "record --out test.mcap --duration 30",
            "record --episodes demos --task 'through the pegs'",
        ),
    ),
    Command(
        name="status",
        heading="daily work",
        help="Print the state of the robots on the network, and its reason.",
        add=_add_status,
        run=_print_status,
        details="Exit code: 0 every robot is armed or disarmed without a fault, 1 otherwise or without a robot.",
        examples=("status", "status --json --endpoint tcp/127.0.0.1:7447"),
    ),
    CommandGroup(
        name="topic",
        heading="robot",
        help="List keys, print their messages, and measure their rates.",
    ),
    Command(
        name="topic list",
        help="List the keys on which a robot publishes.",
        add=_add_topic_list,
        run=_print_topics,
        examples=("topic list", "topic list --json"),
    ),
    Command(
        name="topic echo",
        help="Print what is published on a key, one JSON object a line.",
        add=_add_echo,
        run=_echo_messages,
        examples=("topic echo sensor/joints --count 1", "topic echo 'sensor/*'"),
    ),
    Command(
        name="topic rate",
        help="Show rate, jitter, size and age of every key, and the latency of commands.",
        add=_add_rate,
        run=_print_rates,
        examples=("topic rate", "topic rate sensor/joints --count 5"),
    ),
    Command(
        name="start preview",
        help="Start the process that publishes small, compressed copies of a robot's images, beside its host.",
        add=_add_preview,
        run=_publish_previews,
        examples=("start preview", "start preview --hz 5 --width 160"),
    ),
)
