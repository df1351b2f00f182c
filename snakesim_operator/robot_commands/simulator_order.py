"""Arguments of `snakesim sim`. Importable without Zenoh."""

import argparse
from dataclasses import dataclass
from typing import Any

from snakesim_hal.base.errors import ConfigError

ACTIONS = ("pause", "resume", "step", "speed", "reset")
MAX_TICKS, SLOWEST, FASTEST = 1_000_000, 0.1, 10.0  # as the message allows


@dataclass(frozen=True)
class SimulatorOrder:
    """What is asked for."""

    action: Any  # one of ACTIONS
    ticks: int = 1
    speed: float = 1.0
    who: str | None = None  # None: this user

    def __str__(self) -> str:
        number = {"step": f" {self.ticks}", "speed": f" {self.speed:g}"}.get(self.action, "")
        return f"{self.action}{number}"


def add_command(commands: Any) -> argparse.ArgumentParser:
    """Add it to the parser of `snakesim`; the caller adds the robot's network options."""
    made: argparse.ArgumentParser = commands.add_parser(
        "sim",
        help="pause, step, speed up, slow down or reset a simulator",
        epilog="pause: robot time stands, also for leases and ages; resume: go on; step N: N ticks (1), then paused; "
        "speed X: robot time per wall time in real time, 0.1 to 10; reset: to the start, disarmed.",
    )
    made.add_argument("action", choices=ACTIONS)
    made.add_argument("number", nargs="?", type=float, metavar="N", help="of ticks to step (1), or the speed")
    return made


def order_of(arguments: argparse.Namespace) -> SimulatorOrder:
    """What the command line asks for. Raises ConfigError."""
    action, number = arguments.action, arguments.number
    if action == "step":
        ticks = 1 if number is None else number
        if not 1 <= ticks <= MAX_TICKS or ticks != int(ticks):  # in this order: NaN and infinity have no int()
            raise ConfigError(f"sim step {ticks:g}: give a whole number of ticks from 1 to {MAX_TICKS}")
        return SimulatorOrder(action, ticks=int(ticks))
    if action == "speed":
        if number is None or not SLOWEST <= number <= FASTEST:
            given = "" if number is None else f" {number:g}"
            raise ConfigError(
                f"sim speed{given}: give a number from {SLOWEST:g} to {FASTEST:g}; 1 is as the wall clock"
            )
        return SimulatorOrder(action, speed=number)
    if number is not None:
        raise ConfigError(f"sim {action} {number:g}: {action} takes no number")
    return SimulatorOrder(action)
