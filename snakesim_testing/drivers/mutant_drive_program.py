"""Runs `snakesim` with emulated drives that have an error, for tests that must detect it.

Run it with

    python -m snakesim_testing.drivers.mutant_drive_program MUTANT drive emulate moteus ...
"""

import sys
from collections.abc import Callable

from snakesim_can_backend.moteus.emulator import EmulatedMoteus
from snakesim_can_backend.moteus.protocol import MoteusMode
from snakesim_operator.cli import main as run_command


def disable_watchdog() -> None:
    """Let the emulated controller follow its last command forever."""

    def on_step(self: EmulatedMoteus, now_us: float) -> None:
        del self, now_us

    EmulatedMoteus.on_step = on_step


def enable_again() -> None:
    """Let the emulated controller return to position mode 0.5 s after its watchdog has stopped it."""
    correct_on_step = EmulatedMoteus.on_step

    def on_step(self: EmulatedMoteus, now_us: float) -> None:
        correct_on_step(self, now_us)
        for controller in self.controllers:
            if controller.mode == MoteusMode.TIMEOUT and now_us - controller.watchdog_fed_us > 6e5:
                controller.mode = MoteusMode.POSITION
                controller.watchdog_fed_us = now_us

    EmulatedMoteus.on_step = on_step


MUTANTS: dict[str, Callable[[], None]] = {
    "no_watchdog": disable_watchdog,
    "enables_again": enable_again,
}


if __name__ == "__main__":
    MUTANTS[sys.argv[1]]()
    sys.exit(run_command(sys.argv[2:]))
