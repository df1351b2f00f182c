"""Arguments of the commands that need no robot: `snakesim doctor`, `router`, `schemas`, `scenarios`, `config`."""

import argparse
import threading
from pathlib import Path
from typing import Any

from snakesim_hal.base.terminal import print_line
from snakesim_hal.programs.arguments import add_insecure, add_json, add_network, add_scenario, load_scenario


def add_files(commands: Any) -> None:
    """Add those for scenarios and what they name to the parser of `snakesim`."""
    scenarios = commands.add_parser("scenarios", help="list the shipped scenarios, robots, scenes and suites")
    add_json(scenarios)
    scenarios.set_defaults(act=_scenarios)

    config = commands.add_parser("config", help="show every effective value, and the file or flag it came from")
    add_scenario(config)
    config.add_argument("--explain", metavar="KEY", help="show what one key or table means, and what it may be")
    add_json(config)
    config.set_defaults(act=_config)


def add_commands(commands: Any) -> None:
    """Add the others."""
    doctor = commands.add_parser("doctor", help="check this computer, and print the commands that add what it lacks")
    add_network(doctor)
    add_json(doctor)
    doctor.set_defaults(act=_doctor)

    router = commands.add_parser("router", help="run a Zenoh router from a JSON5 file")
    router.add_argument("config", type=Path, nargs="?", help="JSON5 file (default: the shipped one, for this computer)")
    add_insecure(router)
    router.set_defaults(act=_router)

    schemas = commands.add_parser("schemas", help="print where the JSON Schemas, the key space and the DBC file are")
    schemas.add_argument("--write", type=Path, metavar="FOLDER", help="write schemas and key space, from the code")
    schemas.set_defaults(act=_schemas)


def _scenarios(arguments: argparse.Namespace) -> int:
    from snakesim_operator.this_computer.scenario_files import print_shipped_files

    return print_shipped_files(as_json=arguments.json)


def _config(arguments: argparse.Namespace) -> int:
    if arguments.explain is not None:
        from snakesim_operator.this_computer.explain import explain_key

        return explain_key(load_scenario(arguments), arguments.explain, as_json=arguments.json)

    from snakesim_operator.this_computer.scenario_files import show_config

    return show_config(load_scenario(arguments), as_json=arguments.json)


def _doctor(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base.robot_selection import select_robots
    from snakesim_operator.this_computer.doctor import doctor

    return doctor(select_robots(arguments), as_json=arguments.json)


def _router(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.files import ROUTER
    from snakesim_hal.network.router import open_router

    path: Path = arguments.config or ROUTER
    with open_router(path, insecure=arguments.insecure):
        print_line(f"router running from {path}; Ctrl-C ends it")
        threading.Event().wait()
    return 0


def _schemas(arguments: argparse.Namespace) -> int:
    from snakesim_operator.this_computer.schemas import published, write_schemas

    for path in published() if arguments.write is None else write_schemas(arguments.write):
        print_line(str(path))
    return 0
