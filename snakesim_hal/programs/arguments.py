"""Command-line arguments that several commands and processes share: a scenario, and how to reach the network.

Every command reads this first, an emergency stop too: what takes long to import is imported where it is used.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT, check_endpoint, check_namespace

if TYPE_CHECKING:
    from snakesim_hal.model.scenario import LoadedScenario, RunConfig
    from snakesim_hal.network.session import ConnectionSettings
    from snakesim_hal.network.session_file import SessionFile

# Environment variable: the session file of an operator's tools.
SESSION_VARIABLE = "SNAKESIM_SESSION"


def make_number_parser(
    min_value: float, max_value: float, unit: str = ""
) -> Callable[[str], float]:
    """Make a function for the `type` of an argparse option, which parses a number within bounds.

    Args:
        min_value: Minimum of the number. If it is an int, the number must be a whole number.
        max_value: Maximum of the number.
        unit: Unit of the number, for the error message.

    Returns:
        A function that converts a text to a number. It raises `argparse.ArgumentTypeError` if the text is not a number
        within the bounds.
    """
    must_be_whole = isinstance(min_value, int)

    def parse_number(text: str) -> float:
        try:
            value = int(text) if must_be_whole else float(text)
        except ValueError:
            value = float("nan")  # every comparison with NaN is false, so that it is rejected below
        if not min_value <= value <= max_value:
            kind = "a whole number" if must_be_whole else "a number"
            suffix = f" {unit}" if unit else ""
            bounds = f"from {min_value:.12g} to {max_value:.12g}{suffix}"
            raise argparse.ArgumentTypeError(f"{shorten(text, 40)!r}: give {kind} {bounds}")
        return value

    return parse_number


def add_scenario_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument SCENARIO, and the options that change values of the scenario."""
    add_scenario_name_argument(parser)
    parser.add_argument("--backend", metavar="NAME", help="backend, such as sim, can or odrive")
    parser.add_argument(
        "--controller", metavar="NAME", help="installed controller, or ./file.py:Class"
    )
    parser.add_argument(
        "--clock-mode",
        choices=["realtime", "lockstep", "free"],
        help="how robot time follows the wall clock",
    )
    add_duration_argument(parser, "seconds of robot time")
    add_seed_argument(parser, "default: the scenario's")
    add_set_argument(parser)
    parser.add_argument(
        "--unset",
        action="append",
        default=[],
        metavar="KEY",
        help="remove an optional key, such as robot.sensors.contacts (may be repeated)",
    )


def add_scenario_name_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument SCENARIO, without options that change the scenario."""
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="name of a shipped scenario, or path of a scenario file or a run's config.json",
    )


def add_set_argument(
    parser: argparse.ArgumentParser, help_text: str = "change any value of the configuration"
) -> None:
    """Add the option --set, with a text for the help."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help=f"{help_text} (may be repeated)",
    )


def add_seed_argument(
    parser: argparse.ArgumentParser, help_text: str, default: int | None = None
) -> None:
    """Add the option --seed, which fixes every random number, with more text for the help."""
    parser.add_argument(
        "--seed",
        type=int,
        default=default,
        metavar="SEED",
        help=f"seed of all random numbers ({help_text})",
    )


def add_output_argument(
    parser: argparse.ArgumentParser, help_text: str, *, required: bool = False
) -> None:
    """Add the option --out, the file or folder that a command writes, with a text for the help."""
    parser.add_argument("--out", type=Path, required=required, metavar="PATH", help=help_text)


def add_duration_argument(
    parser: argparse.ArgumentParser,
    help_text: str,
    parse: Callable[[str], float] = float,
    default: float | None = None,
) -> None:
    """Add `--duration`, in seconds.

    Args:
        parser: Parser of a command.
        about: Text for the help.
        parse: Function that converts the text to a number, and checks the number.
        default: Default in seconds. None leaves the choice to the command.
    """
    parser.add_argument("--duration", type=parse, default=default, metavar="S", help=help_text)


def add_seeds_argument(
    parser: argparse.ArgumentParser, help_text: str, default: int | None = None
) -> None:
    """Add the option --seeds, the number of seeds and so of random scenes, with more text for the help."""
    parser.add_argument(
        "--seeds",
        type=make_number_parser(1, 100_000),
        default=default,
        metavar="N",
        help=f"number of seeds {help_text}",
    )


class _FormerOption(argparse.Action):
    """An option that was renamed before the first release. It ends the command with the name of today, its `const`."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        parser.error(f"{option_string} is now called {self.const}")


def add_former_option(parser: argparse.ArgumentParser, former: str, new: str) -> None:
    """Add a hidden option that ends the command with an error, which names the option that replaced it."""
    parser.add_argument(former, action=_FormerOption, const=new, nargs="?", help=argparse.SUPPRESS)


def add_resume_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option that continues what is in `--out`."""
    parser.add_argument("--resume", action="store_true", help="continue with what is in --out")


def add_workers_argument(parser: argparse.ArgumentParser) -> None:
    """Add the options --cluster and --workers, which select the processors for runs."""
    parser.add_argument(
        "--cluster",
        metavar="tcp://HOST:PORT",
        help="scheduler of a Dask cluster (default: this computer)",
    )
    parser.add_argument(
        "--workers",
        type=make_number_parser(1, 100_000),
        metavar="N",
        help="processes on this computer (default: one a core)",
    )


def add_task_argument(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Add the option --task, which describes a demonstration, with a text for the help."""
    parser.add_argument("--task", metavar="TEXT", help=help_text)


def load_scenario_from_arguments(arguments: argparse.Namespace) -> "LoadedScenario":
    """Load a scenario with the overrides of the command line: --set, --unset, and options such as --backend.

    Args:
        arguments: Parsed command line with the arguments of `add_scenario_arguments`. The options --until-goal and
            --fault count too if the command has them.

    Raises:
        ConfigError: A file or an override is not valid.
    """
    from snakesim_hal.model.scenario import KeyOverride, load_scenario, parse_set_option

    # Options that set one key of the scenario.
    value_by_key = {
        "backend": arguments.backend,
        "controller": arguments.controller,
        "clock_mode": arguments.clock_mode,
        "duration_s": arguments.duration,
        "seed": arguments.seed,
    }
    overrides = [parse_set_option(text) for text in arguments.set]
    overrides += [KeyOverride(key, None, f"--unset {shorten(key)}") for key in arguments.unset]
    if getattr(arguments, "until_goal", False):
        overrides.append(KeyOverride("mission.until_goal", True, "--until-goal"))
    for key, value in value_by_key.items():
        if value is not None:
            flag = f"--{key.removesuffix('_s').replace('_', '-')} {shorten(str(value))}"
            overrides.append(KeyOverride(key, value, flag))
    faults = getattr(arguments, "fault", None)
    if faults:
        overrides.append(
            KeyOverride("faults", faults, " ".join(f"--fault {text}" for text in faults))
        )
    return load_scenario(arguments.scenario, overrides)


def add_network_arguments(
    parser: argparse.ArgumentParser, session: str = f"(default: ${SESSION_VARIABLE})"
) -> None:
    """Add the options that select the network, with a text about the default of --session for the help."""
    parser.add_argument(
        "--endpoint",
        metavar="ENDPOINT",
        help=f"Zenoh endpoint of the robot (default: {DEFAULT_ENDPOINT})",
    )
    parser.add_argument(
        "--router",
        metavar="ENDPOINT",
        help="connect to a lab's Zenoh router instead, such as tcp/10.0.0.1:7447",
    )
    parser.add_argument(
        "--session",
        type=Path,
        metavar="FILE",
        help=f"connect with the settings of a Zenoh session file (JSON5: router, certificates) {session}".rstrip(),
    )
    add_namespace_argument(parser)


def add_namespace_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option that selects a robot among those on a network."""
    parser.add_argument(
        "--namespace", metavar="NAME", help="namespace of the robot (default: the robot's name)"
    )


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option for output that scripts read."""
    parser.add_argument(
        "--json", action="store_true", help="print one line of JSON instead, for scripts"
    )


def add_insecure_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option that allows to listen without access control."""
    parser.add_argument(
        "--insecure",
        action="store_true",
        help="listen even where anybody on the network can command the robot",
    )


def add_parent_argument(parser: argparse.ArgumentParser) -> None:
    """Add the hidden option of the processes that `snakesim run` starts."""
    # Process id: this process dies with it.
    parser.add_argument("--parent", type=int, help=argparse.SUPPRESS)


def add_unchecked_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option of commands that arm a robot."""
    parser.add_argument(
        "--unchecked",
        action="store_true",
        help="arm also a robot whose joints were not checked as they are now (simulated and emulated ones need none)",
    )


def add_host_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a HAL host.

    Three options are hidden, because only `snakesim run` passes them to its host:

    --memory         path of an in-memory file for the host's statistics
    --parent-socket  file descriptor of an inherited socket to the parent process
    --stop-port      file descriptor of an inherited UDP socket for emergency stops
    """
    add_scenario_arguments(parser)
    add_network_arguments(parser, "")
    add_insecure_argument(parser)
    add_output_argument(parser, "folder for the record: black box, description, statistics")
    parser.add_argument(
        "--end-after-duration",
        action="store_true",
        help="end when the robot was armed for the scenario's duration",
    )
    parser.add_argument(
        "--end-after-fault", type=float, metavar="S", help="end so many seconds after a fault, too"
    )
    add_parent_argument(parser)
    for flag, kind in (("--memory", str), ("--parent-socket", int), ("--stop-port", int)):
        parser.add_argument(flag, type=kind, help=argparse.SUPPRESS)


def add_service_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a service."""
    parser.add_argument(
        "name", metavar="NAME", help="guidance, navigation, control, or another one of the scenario"
    )
    add_scenario_arguments(parser)
    add_network_arguments(parser, "")
    add_parent_argument(parser)


def check_network(arguments: argparse.Namespace) -> None:
    """Raise ConfigError unless the arguments of `add_network_arguments` are valid and do not contradict each other."""
    for flag, address in (("--endpoint", arguments.endpoint), ("--router", arguments.router)):
        if address is not None:
            check_endpoint(address, flag)
            if arguments.session is not None:
                raise ConfigError(
                    f"{flag} and --session: the session file names the endpoint; leave one out",
                    code="command/conflicting-options",
                )
    if arguments.namespace is not None:
        check_namespace(arguments.namespace, "--namespace")


def read_session_option(
    arguments: argparse.Namespace, *, or_environment: bool = False
) -> "SessionFile | None":
    """Read the Zenoh session file that the command line or the environment names.

    Args:
        arguments: Parsed network options, such as --session, --endpoint and --router.
        or_environment: Whether the environment variable SNAKESIM_SESSION is used if the arguments name no endpoint.
            This is for an operator's tools: a process that moves or emulates a robot connects only as its command line
            specifies.

    Returns:
        The checked session file, or None if none is named.

    Raises:
        ConfigError: The file cannot be read, or is not valid.
    """
    path: Path | None = arguments.session
    if path is None and or_environment and arguments.endpoint is None and arguments.router is None:
        from_environment = os.environ.get(SESSION_VARIABLE)
        if from_environment:
            path = Path(from_environment)
    if not path:
        return None
    from snakesim_hal.network.session_file import read_session

    return read_session(path.expanduser())


def create_link(
    arguments: argparse.Namespace, config: "RunConfig", *, is_host: bool = False
) -> "ConnectionSettings":
    """Create the description of how a process of a robot connects to its network.

    Args:
        arguments: Parsed network options, such as --endpoint, --router and --namespace.
        config: Configuration of the run, whose robot gives the default namespace and the largest image.
        is_host: Whether the process is the HAL host. Without a router, the host listens, and all other processes
            connect to it.

    Raises:
        ConfigError: The options contradict one another, or the session file is not valid.
    """
    from snakesim_hal.network.session import ConnectionSettings
    from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES

    check_network(arguments)
    session_file = read_session_option(arguments)
    max_bytes = max(MAX_PAYLOAD_BYTES, config.robot.sensors.max_image_bytes)
    if session_file is not None:
        namespace = session_file.resolve_namespace(arguments.namespace) or config.robot.name
        return ConnectionSettings(
            session_file.endpoints[0], namespace, max_bytes=max_bytes, session=session_file
        )
    return ConnectionSettings(
        endpoint=arguments.router or arguments.endpoint or DEFAULT_ENDPOINT,
        namespace=arguments.namespace or config.robot.name,
        listen=is_host and arguments.router is None,
        insecure=getattr(arguments, "insecure", False),
        max_bytes=max_bytes,
    )
