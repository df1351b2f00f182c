"""Arguments of `snakesim sim`. Importable without Zenoh."""

import argparse
from dataclasses import dataclass
from typing import Any

from snakesim_hal.base.errors import ConfigError

ACTIONS = ("pause", "resume", "step", "speed", "reset")
MAX_TICKS = 1_000_000  # this and the speeds are the limits of SimulatorRequest
MIN_SPEED = 0.1  # robot time per wall time
MAX_SPEED = 10.0


@dataclass(frozen=True)
class SimulatorOrder:
    """A request to the simulator."""

    action: Any  # one of ACTIONS
    ticks: int = 1
    speed: float = 1.0
    requester: str | None = None  # None: this user

    def __str__(self) -> str:
        match self.action:
            case "step":
                return f"step {self.ticks}"
            case "speed":
                return f"speed {self.speed:g}"
            case _:
                return self.action


def add_command(commands: Any) -> argparse.ArgumentParser:
    """Add `snakesim sim` to the parser; the caller adds the robot's network options."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "sim",
        help="pause, step, speed up, slow down or reset a simulator",
        epilog="pause: robot time stands, also for leases and ages; resume: go on; step N: N ticks (1), then paused; "
        "speed X: robot time per wall time in real time, 0.1 to 10; reset: to the start, disarmed.",
    )
    parser.add_argument("action", choices=ACTIONS)
    parser.add_argument("number", nargs="?", type=float, metavar="N", help="of ticks to step (1), or the speed")
    return parser


def order_of(arguments: argparse.Namespace) -> SimulatorOrder:
    """Return the request of the command line. Raises ConfigError."""
    action = arguments.action
    number: float | None = arguments.number
    match action:
        case "step":
            return SimulatorOrder(action, ticks=_check_ticks(number))
        case "speed":
            return SimulatorOrder(action, speed=_check_speed(number))
        case _:
            if number is not None:
                raise ConfigError(f"sim {action} {number:g}: {action} takes no number", code="command/invalid-option")
            return SimulatorOrder(action)


def _check_ticks(number: float | None) -> int:
    """Return the number of ticks, by default 1. Raises ConfigError unless it is a whole number in its range."""
    ticks = 1 if number is None else number
    if not 1 <= ticks <= MAX_TICKS or ticks != int(ticks):  # in this order: NaN and infinity have no int()
        raise ConfigError(
            f"sim step {ticks:g}: give a whole number of ticks from 1 to {MAX_TICKS}", code="command/invalid-option"
        )
    return int(ticks)


def _check_speed(number: float | None) -> float:
    """Return the speed. Raises ConfigError if it is missing or outside its range."""
    if number is None or not MIN_SPEED <= number <= MAX_SPEED:
        given = "" if number is None else f" {number:g}"
        raise ConfigError(
            f"sim speed{given}: give a number from {MIN_SPEED:g} to {MAX_SPEED:g}; 1 is as the wall clock",
            code="command/invalid-option",
        )
    return number
