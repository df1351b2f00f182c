"""Lines of the log about changes of a robot's state, live or from a recording."""

from collections.abc import Callable

from snakesim_hal.wire.messages import ControlSettings, ControlState, Status


class StateChangeLog:
    """Writes a line for each change between a message and the one before it."""

    def __init__(self, write: Callable[[str], None]) -> None:
        """Know no message yet. write: called with each line."""
        self._write = write
        self._status: Status | None = None
        self._control: ControlState | None = None
        self._settings: ControlSettings | None = None

    def note(self, message: Status | ControlState | ControlSettings | None) -> None:
        """Compare a message with the one before it of its type. The same message may be given again."""
        match message:
            case Status() if message is not self._status:
                self._note_status(message)
            case ControlState() if message is not self._control:
                self._note_control(message)
            case ControlSettings() if message != self._settings:
                self._note_settings(message)
            case _:
                pass

    def _note_status(self, status: Status) -> None:
        previous = self._status
        self._status = status
        if previous is None or (status.lifecycle, status.why) != (previous.lifecycle, previous.why):
            self._write(f"robot {status.lifecycle}: {status.why}")
        known_faults = () if previous is None else previous.faults
        for fault in status.faults:
            if fault not in known_faults:
                place = f" at {fault.joint}" if fault.joint else ""
                self._write(f"fault {fault.what}{place}: {fault.cause}")

    def _note_control(self, control: ControlState) -> None:
        previous = self._control
        self._control = control
        if previous is None or control.state != previous.state:
            self._write(f"control {control.state}: {control.reason}")

    def _note_settings(self, settings: ControlSettings) -> None:
        self._settings = settings
        if settings.who is not None:  # None: the controller started with them
            self._write(f"settings of {settings.controller} in force, as {settings.who} asked")
