"""Control of emulated drives that run as a process: faults typed into its terminal, and a log of their torque.

A program can type as well: it starts the process with a pipe as its standard input.
"""

import argparse
import json
import re
import select
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.fault_kinds import (
    MAX_TEXT_LENGTH,
    FaultInjection,
    validate_and_complete_injection,
)

TYPED_FAULT_PATTERN = re.compile(
    r"(?P<kind>[a-z_]+)[ :]+(?P<target>(joint|bus)_[0-9]+)(?: +(?P<off>off))?"
)
LOGGED_STEP_RAD = 0.001  # change of an angle after which the log gets a line


@dataclass(frozen=True)
class TrueState:
    """What the drives really do at one instant, tail to head."""

    enabled: Sequence[bool]  # whether each would follow a setpoint
    angle_rad: Sequence[float]  # true angle of each joint


class DriveLog:
    """Writes the state of emulated drives to a file whenever it changes, with the time of the monotonic clock."""

    def __init__(self, file: TextIO) -> None:
        """Begin with an empty log. `file` is flushed after each line."""
        self._file = file
        self._logged: TrueState | None = None

    def write(self, state: TrueState) -> None:
        """Write a line if a drive was enabled or disabled, or if a joint has moved."""
        logged = self._logged
        if logged is not None and list(logged.enabled) == list(state.enabled):
            moved_rad = max(
                abs(a - b) for a, b in zip(logged.angle_rad, state.angle_rad, strict=True)
            )
            if moved_rad < LOGGED_STEP_RAD:
                return
        self._logged = TrueState(list(state.enabled), list(state.angle_rad))
        line = {
            "monotonic_ns": time.monotonic_ns(),
            "enabled": list(state.enabled),
            "angle_rad": [round(angle, 5) for angle in state.angle_rad],
        }
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()


class EmulatorControl:
    """Reads typed faults, and writes the log, once in each cycle of emulated drives."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        inject_fault: Callable[[FaultInjection, bool], object],
        read_state: Callable[[], TrueState],
        exit_stack: ExitStack,
    ) -> None:
        """Open the log, if the command line names one.

        Args:
            arguments: Parsed command line, with the options of `add_control_arguments`.
            inject_fault: Function that starts or ends a fault of a joint or of a bus. Its second argument is True for
                the start, and False for the end.
            read_state: Function that returns the true state of the drives. The log has a JSON line for each change of
                it.
            exit_stack: Closes the log.

        Raises:
            ConfigError: The log cannot be written.
        """
        self._inject_fault = inject_fault
        self._read_state = read_state
        self._is_interactive: bool = arguments.interactive
        self._log: DriveLog | None = None
        if arguments.drive_log is not None:
            try:
                file = Path(arguments.drive_log).open("w", encoding="utf-8")  # noqa: SIM115 - the stack closes it
                exit_stack.enter_context(file)
            except OSError as error:
                raise ConfigError(
                    f"--drive-log {arguments.drive_log}: {error.strerror}; give another name",
                    code="file/not-writable",
                ) from error
            self._log = DriveLog(file)

    def run(self) -> None:
        """Inject what was typed since the last call, and log what has changed."""
        while self._is_interactive and select.select([sys.stdin], [], [], 0)[0]:
            line = sys.stdin.readline()
            if not line:
                self._is_interactive = False
            elif line.strip():
                self._inject_typed_fault(line)
        if self._log is not None:
            self._log.write(self._read_state())

    def _inject_typed_fault(self, line: str) -> None:
        try:
            fault, begins = parse_typed_fault(line)
            self._inject_fault(fault, begins)
        except ConfigError as error:
            print_line(str(error))


def format_typed_fault(fault: FaultInjection, *, begins: bool) -> str:
    """Return the text of a fault that `parse_typed_fault` reads."""
    if begins:
        return f"{fault.kind} {fault.target}"
    return f"{fault.kind} {fault.target} off"


def parse_typed_fault(text: str) -> tuple[FaultInjection, bool]:
    """Parse a typed fault such as `mute joint_3`, `mute joint_3 off` or `cut bus_1`.

    Returns:
        The fault, and whether it starts (True) or ends (False).

    Raises:
        ConfigError: The text has another form, or there is no such kind of fault.
    """
    match = TYPED_FAULT_PATTERN.fullmatch(text.strip()[:MAX_TEXT_LENGTH])
    if match is None:
        raise ConfigError(
            f"{text.strip()[:40]!r}: type KIND joint_N or KIND bus_N, and later the same with `off`, such as "
            f"`mute joint_3` or `cut bus_1`",
            code="injection/unknown-fault",
        )
    fault = validate_and_complete_injection(
        FaultInjection(match["kind"], match["target"]), text.strip()
    )
    return fault, match["off"] is None
