"""The commands `snakesim run`, `snakesim start host` and `snakesim start service`."""

import argparse
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import tune_garbage_collector
from snakesim_hal.base.terminal import tolerate_failed_output
from snakesim_hal.programs.arguments import (
    add_host_arguments,
    add_insecure_argument,
    add_network_arguments,
    add_output_argument,
    add_scenario_arguments,
    add_service_arguments,
    add_unchecked_argument,
    check_network,
    load_scenario_from_arguments,
    read_session_option,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands
from snakesim_operator.recording.message import RAW_ONLY_HELP

if TYPE_CHECKING:
    from snakesim_hal.base.step_limit import SharedStepTimes
    from snakesim_hal.model.scenario import RunConfig


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim run`, which runs a scenario with all of its processes."""
    add_scenario_arguments(parser)
    parser.add_argument(
        "--fault",
        action="append",
        metavar="FAULT",
        help="inject a fault, as KIND:TARGET@START[-END][=AMOUNT] in seconds after arming, instead of the scenario's "
        "faults (may be repeated)",
    )
    parser.add_argument(
        "--stay",
        action="store_true",
        help="faults do not end the run: processes restart, you reset and arm",
    )
    add_unchecked_argument(parser)
    parser.add_argument(
        "--with-router", action="store_true", help="start a router for the run, as in a lab"
    )
    parser.add_argument(
        "--in-process",
        action="store_true",
        help="run in one process, without a network: lockstep, and faster, where nothing can connect, arm or stop it",
    )
    parser.add_argument(
        "--until-goal", action="store_true", help="end when the mission's goal is reached"
    )
    parser.add_argument(
        "--no-record", action="store_true", help="keep no recording of the messages"
    )
    parser.add_argument("--raw-only", action="store_true", help=RAW_ONLY_HELP)
    parser.add_argument(
        "--console",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="show the run in the browser, and print the address",
    )
    add_output_argument(parser, "folder for the run's record (default: runs/NAME-TIME)")
    add_network_arguments(parser, session="")  # --session has no default
    add_insecure_argument(parser)


def _run_scenario(arguments: argparse.Namespace) -> int:
    """Run `snakesim run`, in processes or in this one, and return its exit code."""
    check_network(arguments)
    if arguments.in_process:
        # Before anything large is loaded.
        from snakesim_operator.run.processes.guarded_process import run_in_guarded_child

        return run_in_guarded_child(
            lambda step_times: _run_scenario_in_process(arguments, step_times),
            owns_process=arguments.owns_process,
        )
    config = _load_checked_config(arguments)

    from snakesim_operator.run.run import RunRequest, run_in_processes

    request = RunRequest(
        config,
        out=arguments.out,
        endpoint=arguments.endpoint,
        router=arguments.router,
        session=read_session_option(arguments),
        namespace=arguments.namespace,
        stay=arguments.stay,
        unchecked=arguments.unchecked,
        with_router=arguments.with_router,
        insecure=arguments.insecure,
        record=not arguments.no_record,
        raw_only=arguments.raw_only,
        console=arguments.console,
    )
    with tolerate_failed_output():
        return run_in_processes(request)


def _run_scenario_in_process(
    arguments: argparse.Namespace, step_times: "SharedStepTimes | None"
) -> int:
    config = _load_checked_config(arguments)
    for flag in ("endpoint", "router", "session", "namespace", "stay", "with_router", "console"):
        if getattr(arguments, flag):
            raise ConfigError(
                f"--in-process and --{flag.replace('_', '-')}: there is no network; leave one out",
                code="command/conflicting-options",
            )

    from snakesim_operator.run.in_process import run_in_process

    if arguments.owns_process:
        tune_garbage_collector()  # what has been imported by now is never garbage
    with tolerate_failed_output():
        return run_in_process(
            config,
            arguments.out,
            record=not arguments.no_record,
            raw_only=arguments.raw_only,
            step_times=step_times,
        )


def _load_checked_config(arguments: argparse.Namespace) -> "RunConfig":
    from snakesim_hal.programs.preflight import validate_and_complete_config

    loaded = load_scenario_from_arguments(arguments)
    # Here, because only the table knows which flag set what.
    return validate_and_complete_config(loaded.config, loaded.table)


def _start_host(arguments: argparse.Namespace) -> int:
    from snakesim_operator.run.host import run_host

    with tolerate_failed_output():
        return run_host(arguments)


def _start_service(arguments: argparse.Namespace) -> int:
    from snakesim_hal.programs import service_program as serve

    return serve.run(arguments)


COMMANDS: Commands = (
    Command(
        name="run",
        heading="daily work",
        help="Run a scenario: backend, guidance, navigation and control.",
        add=_add_run_options,
        run=_run_scenario,
        details="Exit code 0: complete, armed for all of the requested time. 1: a fault, or ended before that. 2: "
        "wrong input, nothing was started. 3: complete, but the record has gaps. 130: interrupted. 1 and 130 take "
        "precedence.",
        examples=(
            "run triplet --console",
            "run peg_row --controller obstacle_aided --duration 10 --out runs/demo",
        ),
    ),
    CommandGroup(
        name="start",
        heading="robot",
        help="Start one process of a robot that is distributed over machines.",
    ),
    Command(
        name="start host",
        help="Start the HAL host of a robot, which moves the drives or the simulator.",
        add=add_host_arguments,
        run=_start_host,
        details="It runs until Ctrl-C, and boots disarmed: `snakesim robot arm` arms it. Faults do not end it. Exit "
        "code: 0 ended with --end-after-duration and without a fault, 1 ended otherwise, 2 wrong input.",
        examples=(
            "start host triplet",
            "start host triplet --backend can --router tcp/10.0.0.1:7447 --out runs/host",
        ),
    ),
    Command(
        name="start service",
        help="Start one service of a robot: guidance, navigation, control, or another one of the scenario.",
        add=add_service_arguments,
        run=_start_service,
        details="It waits for the network and for the robot's host, and joins the next host after a restart.",
        examples=(
            "start service control triplet",
            "start service guidance triplet --router tcp/10.0.0.1:7447",
        ),
    ),
)
