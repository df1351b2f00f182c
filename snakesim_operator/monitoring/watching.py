"""Arguments of the commands that read what a robot publishes: `snakesim status`, `top`, `echo`, `record`, `preview`."""

import argparse
import sys
from pathlib import Path
from typing import Any

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.programs.arguments import add_json, add_network, number_type
from snakesim_operator.base.robot_selection import select_robots
from snakesim_operator.recording.message import RAW_ONLY

MAX_TASK = 200


def add_commands(commands: Any) -> None:
    """Add them to the parser of `snakesim`."""
    status = commands.add_parser("status", help="print the state of the robots on the network, and its reason")
    add_network(status)
    add_json(status)
    status.set_defaults(act=_status)

    top = commands.add_parser("top", help="show rate, jitter, size and age of every key, and commands' latency")
    top.add_argument("--once", action="store_true", help="listen for two seconds, print one table, and end")
    add_network(top)
    add_json(top)
    top.set_defaults(act=_top)

    echo = commands.add_parser("echo", help="print what is published on a key, one JSON object a line")
    echo.add_argument("key", nargs="?", help="such as sensor/joints or sensor/*; without it, list the keys")
    echo.add_argument("--hz", action="store_true", help="print only rate and jitter")
    echo.add_argument("--count", type=number_type(1, 10**9), help="end after this many messages")
    add_network(echo)
    echo.set_defaults(act=_echo)

    record = commands.add_parser("record", help="record everything that a robot publishes into an MCAP file")
    record.add_argument("--out", type=Path, metavar="FILE.mcap", help="the file (default: NAMESPACE-TIME.mcap)")
    record.add_argument(
        "--episodes",
        type=Path,
        metavar="DIR",
        help="record demonstrations, one after the other, begun and ended by Enter",
    )
    record.add_argument("--task", metavar="TEXT", help="with --episodes: what is demonstrated, in words")
    record.add_argument(
        "--duration", type=number_type(0.0, 1e9, "s"), metavar="S", help="end after this time by the wall clock"
    )
    viewers = record.add_mutually_exclusive_group()
    viewers.add_argument("--raw-only", action="store_true", help=RAW_ONLY)
    viewers.add_argument(
        "--foxglove",
        type=number_type(0, 65535),
        nargs="?",
        const=8765,
        metavar="PORT",
        help="serve Foxglove live as well, at ws://127.0.0.1:PORT (8765)",
    )
    record.add_argument(
        "--foxglove-origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="a web page that may read the robot there, such as https://app.foxglove.dev; may be repeated",
    )
    add_network(record)
    record.set_defaults(act=_record)

    preview = commands.add_parser(
        "preview", help="publish small, compressed copies of a robot's images; beside its host"
    )
    preview.add_argument("--hz", type=float, default=2.0, metavar="HZ", help="most previews a second of a camera (2)")
    preview.add_argument("--width", type=int, default=320, metavar="PIXELS", help="widest preview (320)")
    add_network(preview)
    preview.set_defaults(act=_preview)


def _status(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.status import show_status

    return show_status(select_robots(arguments), as_json=arguments.json)


def _top(arguments: argparse.Namespace) -> int:
    from snakesim_operator.monitoring.top import top

    return top(select_robots(arguments), once=arguments.once, as_json=arguments.json)


def _echo(arguments: argparse.Namespace) -> int:
    from snakesim_operator.monitoring.echo import echo

    return echo(arguments.key, select_robots(arguments), rate_only=arguments.hz, count=arguments.count)


def _record(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    if arguments.episodes is not None:
        return _record_episodes(arguments)
    if arguments.task is not None:
        raise ConfigError(
            "--task is for --episodes DIR; add it, or leave --task out", code="command/conflicting-options"
        )
    if arguments.foxglove is not None:
        extras.require("console", "--foxglove")
    from snakesim_operator.playback.record_command import record_robot

    return record_robot(
        select_robots(arguments),
        arguments.out,
        arguments.duration,
        arguments.foxglove,
        arguments.foxglove_origin,
        raw_only=arguments.raw_only,
    )


def _record_episodes(arguments: argparse.Namespace) -> int:
    for name in ("out", "duration", "foxglove"):
        if getattr(arguments, name) is not None:
            raise ConfigError(
                f"--{name} and --episodes: episodes are files in a folder, begun and ended by Enter",
                code="command/conflicting-options",
            )
    task = (arguments.task or "").strip()
    if not 0 < len(task) <= MAX_TASK:
        raise ConfigError(
            f"--task: say what is demonstrated, in at most {MAX_TASK} characters: --task 'through the pegs'",
            code="command/invalid-option",
        )
    from snakesim_operator.playback.demonstrations import record_demonstrations

    return record_demonstrations(select_robots(arguments), arguments.episodes, task, iter(sys.stdin))


def _preview(arguments: argparse.Namespace) -> int:
    from snakesim_operator.monitoring.preview import preview

    return preview(select_robots(arguments), arguments.hz, arguments.width)
