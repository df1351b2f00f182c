"""The commands `snakesim sim`. Importable without Zenoh."""

import argparse

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.programs.arguments import add_network_arguments
from snakesim_hal.programs.commands import Command, CommandGroup, Commands
from snakesim_operator.robot_commands.simulator_order import SimulatorOrder

MAX_TICKS = 1_000_000  # this and the speeds are the limits of SimulatorRequest
MIN_SPEED = 0.1  # robot time per wall time
MAX_SPEED = 10.0


def _add_step(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "number", nargs="?", type=float, metavar="TICKS", help="number of ticks (default: 1)"
    )
    add_network_arguments(parser)


def _add_speed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "number", type=float, metavar="X", help="robot time over wall time, from 0.1 to 10"
    )
    add_network_arguments(parser)


def _pause_simulator(arguments: argparse.Namespace) -> int:
    return _send_order(SimulatorOrder("pause"), arguments)


def _resume_simulator(arguments: argparse.Namespace) -> int:
    return _send_order(SimulatorOrder("resume"), arguments)


def _step_simulator(arguments: argparse.Namespace) -> int:
    return _send_order(
        SimulatorOrder("step", ticks=_validate_tick_count(arguments.number)), arguments
    )


def _set_simulator_speed(arguments: argparse.Namespace) -> int:
    return _send_order(SimulatorOrder("speed", speed=_validate_speed(arguments.number)), arguments)


def _reset_simulator(arguments: argparse.Namespace) -> int:
    return _send_order(SimulatorOrder("reset"), arguments)


def _send_order(order: SimulatorOrder, arguments: argparse.Namespace) -> int:
    """Send a request to the simulator that the arguments address. Returns the exit code."""
    from snakesim_operator.base.robot_selection import select_robots
    from snakesim_operator.robot_commands.command import control_simulator

    return control_simulator(order, select_robots(arguments))


def _validate_tick_count(number: float | None) -> int:
    """Return the number of ticks, by default 1. Raises ConfigError unless it is a whole number in its range."""
    ticks = 1 if number is None else number
    if not 1 <= ticks <= MAX_TICKS or ticks != int(
        ticks
    ):  # in this order: NaN and infinity have no int()
        raise ConfigError(
            f"sim step {ticks:g}: give a whole number of ticks from 1 to {MAX_TICKS}",
            code="command/invalid-option",
        )
    return int(ticks)


def _validate_speed(speed: float) -> float:
    """Return the speed. Raises ConfigError if it is outside its range."""
    if not MIN_SPEED <= speed <= MAX_SPEED:
        raise ConfigError(
            f"sim speed {speed:g}: give a number from {MIN_SPEED:g} to {MAX_SPEED:g}; 1 is as the wall clock",
            code="command/invalid-option",
        )
    return speed


SIMULATOR_COMMANDS: Commands = (
    CommandGroup(
        name="sim", heading="robot", help="Pause, step, speed up, slow down or reset a simulator."
    ),
    Command(
        name="sim pause",
        help="Pause a simulator: robot time is paused, also for leases and ages.",
        add=add_network_arguments,
        run=_pause_simulator,
        examples=("sim pause", "sim pause --namespace planar13"),
    ),
    Command(
        name="sim resume",
        help="Resume a simulator that is paused.",
        add=add_network_arguments,
        run=_resume_simulator,
        examples=("sim resume", "sim resume --namespace planar13"),
    ),
    Command(
        name="sim step",
        help="Advance a simulator by some ticks, and pause it then.",
        add=_add_step,
        run=_step_simulator,
        examples=("sim step", "sim step 100"),
    ),
    Command(
        name="sim speed",
        help="Set the speed of a simulator in real time.",
        add=_add_speed,
        run=_set_simulator_speed,
        examples=("sim speed 0.5", "sim speed 2 --namespace planar13"),
    ),
    Command(
        name="sim reset",
        help="Set a simulator back to its start. The robot is disarmed then.",
        add=add_network_arguments,
        run=_reset_simulator,
        examples=("sim reset", "sim reset --namespace planar13"),
    ),
)
