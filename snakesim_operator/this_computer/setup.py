"""The commands that need no robot: `snakesim doctor`, `start router`, `scenario`, `config` and `schema`."""

import argparse
import threading
from pathlib import Path

from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.programs.arguments import (
    add_insecure_argument,
    add_json_argument,
    add_network_arguments,
    add_output_argument,
    add_scenario_arguments,
    load_scenario_from_arguments,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands


def _add_config(parser: argparse.ArgumentParser) -> None:
    add_scenario_arguments(parser)
    parser.add_argument(
        "--explain", metavar="KEY", help="show what one key or table means, and what it may be"
    )
    add_json_argument(parser)


def _add_doctor(parser: argparse.ArgumentParser) -> None:
    add_network_arguments(parser)
    add_json_argument(parser)


def _add_router(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "config",
        type=Path,
        nargs="?",
        metavar="FILE",
        help="JSON5 file (default: the shipped one, for this computer)",
    )
    add_insecure_argument(parser)


def _add_schema(parser: argparse.ArgumentParser) -> None:
    add_output_argument(parser, "folder into which to write schemas and key space, from the code")
    add_json_argument(parser)


def _print_bundled_files(arguments: argparse.Namespace) -> int:
    from snakesim_operator.this_computer.scenario_files import print_shipped_files

    return print_shipped_files(as_json=arguments.json)


def _print_config_or_explain_key(arguments: argparse.Namespace) -> int:
    if arguments.explain is not None:
        from snakesim_operator.this_computer.explain import explain_key

        return explain_key(
            load_scenario_from_arguments(arguments), arguments.explain, as_json=arguments.json
        )

    from snakesim_operator.this_computer.scenario_files import print_config

    return print_config(load_scenario_from_arguments(arguments), as_json=arguments.json)


def _run_doctor(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base.robot_selection import select_robots
    from snakesim_operator.this_computer.doctor import run_doctor

    return run_doctor(select_robots(arguments), as_json=arguments.json)


def _run_router(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.files import ROUTER_CONFIG_PATH
    from snakesim_hal.network.router import open_router

    path: Path = arguments.config or ROUTER_CONFIG_PATH
    with open_router(path, insecure=arguments.insecure):
        print_line(f"router running from {path}; Ctrl-C ends it")
        threading.Event().wait()
    return 0


def _list_or_write_schemas(arguments: argparse.Namespace) -> int:
    from snakesim_operator.this_computer.schemas import list_published_files, write_schemas

    paths = [
        str(path)
        for path in (
            list_published_files() if arguments.out is None else write_schemas(arguments.out)
        )
    ]
    if arguments.json:
        print_json({"files": paths})
        return 0
    for path in paths:
        print_line(path)
    return 0


COMMANDS: Commands = (
    Command(
        name="doctor",
        heading="daily work",
        help="Check this computer, and print the commands that add what is missing.",
        add=_add_doctor,
        run=_run_doctor,
        examples=("doctor", "doctor --json"),
    ),
    Command(
        name="start router",
        help="Start a Zenoh router, which connects the processes of robots on several machines.",
        add=_add_router,
        run=_run_router,
        examples=("start router", "start router lab/hub/router.main.json5"),
    ),
    CommandGroup(
        name="scenario", heading="files and computers", help="List what is shipped to be run."
    ),
    Command(
        name="scenario list",
        help="List the shipped scenarios, robots, scenes and suites.",
        add=add_json_argument,
        run=_print_bundled_files,
        examples=("scenario list", "scenario list --json"),
    ),
    Command(
        name="config",
        heading="files and computers",
        help="Show every effective value of a scenario, and the file or option that it came from.",
        add=_add_config,
        run=_print_config_or_explain_key,
        examples=("config triplet", "config peg_row --explain robot.motor.stiffness_nm_per_rad"),
    ),
    Command(
        name="schema",
        heading="files and computers",
        help="Print where the JSON Schemas, the key space and the DBC file are.",
        add=_add_schema,
        run=_list_or_write_schemas,
        examples=("schema", "schema --out schemas"),
    ),
)
