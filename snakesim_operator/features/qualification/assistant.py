"""Who acts at the bench: a person, or for emulated drives a program."""

import contextlib
import select
import sys
import termios
import time
from abc import ABC, abstractmethod
from typing import Literal

from snakesim_hal.base.terminal import PrintLine
from snakesim_operator.features.qualification.emulated_drive import EmulatedDrive
from snakesim_operator.features.qualification.protocol.checks import Source

Action = Literal[
    "unplug_bus",
    "plug_bus",
    "lower_supply",
    "restore_supply",
    "cut_relay",
    "close_relay",
    "restart_drive",
    "block",
]
Actor = Literal["program", "operator"]

INSTRUCTIONS: dict[Action, str] = {
    "unplug_bus": "Unplug the bus cable from the drive.",
    "plug_bus": "Plug the bus cable in again.",
    "lower_supply": "Lower the supply below `min_voltage_v` of the robot file.",
    "restore_supply": "Restore the supply.",
    "cut_relay": "Press the red button that cuts the motor supply.",
    "close_relay": "Release the red button, and wait until the drive has started.",
    "restart_drive": "Switch the drive's supply off and on again, and wait until it has started.",
    "block": "Block the shaft: hold the lever against a stop.",
}
TYPED_FAULTS: dict[Action, str] = {
    "unplug_bus": "cut bus_1",
    "plug_bus": "cut bus_1 off",
    "lower_supply": "undervoltage joint_1",
    "restore_supply": "undervoltage joint_1 off",
    "cut_relay": "reboot joint_1",  # a drive that has lost its supply starts again when it is back
    "restart_drive": "reboot joint_1",
}
BOOT_S = 1.0  # after which an emulated drive has started again
SKIP = "skip"  # what the operator types to leave a step out


class Assistant(ABC):
    """Carries out what a program cannot do to a real drive, and answers what a program cannot see."""

    actor: Actor
    source: Source  # of its answers

    @abstractmethod
    def confirm_step(self, text: str) -> bool:
        """Wait until the operator is ready for a step, and return False if the operator skips it.

        Args:
            text: What will happen in the step; empty: nothing moves.
        """

    @abstractmethod
    def wait_for_enter(self, text: str) -> None:
        """Print a text, and wait until the operator presses Enter in the middle of a step."""

    @abstractmethod
    def perform(self, action: Action) -> int | None:
        """Carry out an action.

        Returns:
            When, by the monotonic clock in ns; None if the time is not known.
        """

    @abstractmethod
    def ask_turned_positive(self, start_ns: int) -> str:
        """Return whether the shaft has turned the positive way since an instant: "yes", "no", or empty if unknown."""

    @abstractmethod
    def ask_without_torque(self) -> str:
        """Return whether the motor is without torque: "yes", "no", or empty if unknown."""


class Person(Assistant):
    """The operator at the terminal."""

    actor = "operator"
    source = "operator"

    def __init__(self, print_text: PrintLine) -> None:
        self._print = print_text

    def confirm_step(self, text: str) -> bool:
        if text:
            self._print(f"       > {text}")
        question = f'Press Enter when you are ready, or type "{SKIP}" to leave this step out:'
        while True:
            match self._ask(question).lower():
                case "":
                    return True
                case "skip":
                    return False
                case _:
                    self._print(f'         Press Enter or type "{SKIP}".')

    def wait_for_enter(self, text: str) -> None:
        self._ask(text)

    def perform(self, action: Action) -> int | None:
        self._ask(f"{INSTRUCTIONS[action]} Then press Enter:")
        return None

    def ask_turned_positive(self, start_ns: int) -> str:
        del start_ns
        return self.read_yes_or_no("Did the shaft turn the positive way, by about 3 degrees?")

    def ask_without_torque(self) -> str:
        return self.read_yes_or_no("Turn the shaft by hand: is the motor without torque?")

    def read_yes_or_no(self, question: str) -> str:
        """Return "yes", "no", or an empty text if the operator does not know."""
        while True:
            match self._ask(f"{question} y, n, or Enter if you do not know:").lower():
                case "y" | "yes":
                    return "yes"
                case "n" | "no":
                    return "no"
                case "":
                    return ""
                case _:
                    self._print("         Type y or n.")

    def _ask(self, question: str) -> str:
        """Print a question, and return the line that the operator types after it.

        What was typed before the question is discarded: it answers another one.
        """
        _discard_typed_input()
        self._print(f"       > {question}")
        return _read_answer()


class EmulatedBench(Assistant):
    """The program that stands for the operator of an emulated drive."""

    actor = "program"
    source = "drive log"

    def __init__(self, drive: EmulatedDrive, print_text: PrintLine, *, should_pause: bool) -> None:
        """Prepare to control an emulated drive.

        Args:
            drive: The drive.
            print_text: Prints a line for the user.
            should_pause: Whether to wait for Enter before each step.
        """
        self._drive = drive
        self._print = print_text
        self._should_pause = should_pause

    def confirm_step(self, text: str) -> bool:
        if self._should_pause:
            _discard_typed_input()
            self._print(
                "       > Press Enter for this step. The drive is emulated: a program acts for you."
            )
            _read_answer()
        return True

    def wait_for_enter(self, text: str) -> None:
        pass  # the program presses it at once

    def perform(self, action: Action) -> int | None:
        text = TYPED_FAULTS.get(action)
        # "block" is friction of the emulated joint, and "close_relay" is part of the restart.
        if text is None:
            return time.monotonic_ns()
        acted_ns = self._drive.type_fault(text)
        if text.startswith("reboot"):
            time.sleep(BOOT_S)
        return acted_ns

    def ask_turned_positive(self, start_ns: int) -> str:
        angles = [
            state.angle_rad for state in self._drive.read_log() if state.monotonic_ns >= start_ns
        ]
        if not angles:
            return ""
        return "yes" if angles[-1] > angles[0] else "no"

    def ask_without_torque(self) -> str:
        states = self._drive.read_log()
        if not states:
            return ""
        return "no" if states[-1].is_enabled else "yes"


def _discard_typed_input() -> None:
    """Discard what was typed at the terminal and was not read yet."""
    with contextlib.suppress(termios.error):  # a terminal that is gone has no input
        termios.tcflush(sys.stdin, termios.TCIFLUSH)


def _read_answer() -> str:
    """Return a line from the terminal; it can be interrupted by Ctrl-C.

    Raises:
        KeyboardInterrupt: The terminal is gone, or the operator has pressed Ctrl-D: end as with Ctrl-C.
    """
    while not select.select([sys.stdin], [], [], 0.2)[0]:
        pass
    try:
        line = sys.stdin.readline()
    except OSError as error:
        raise KeyboardInterrupt from error
    if not line:
        raise KeyboardInterrupt
    return line.strip()
