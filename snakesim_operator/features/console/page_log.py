"""What has become of a robot, as lines of a log: live as its messages come, and of a recording."""

from collections.abc import Callable

from snakesim_hal.wire.messages import ControlSettings, ControlState, Status


class StateChangeLog:
    """Tells what differs from the message before."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._status: Status | None = None
        self._control: ControlState | None = None
        self._settings: ControlSettings | None = None

    def note(self, message: Status | ControlState | ControlSettings | None) -> None:
        """The newest one; any other than before may be the same."""
        match message:
            case Status() if message is not self._status:
                self._of_status(message)
                self._status = message
            case ControlState() if message is not self._control:
                before, self._control = self._control, message
                if before is None or message.state != before.state:
                    self._write(f"control {message.state}: {message.reason}")
            case ControlSettings() if message != self._settings:
                self._settings = message
                if message.who is not None:
                    self._write(f"settings of {message.controller} in force, as {message.who} asked")
            case _:
                pass

    def _of_status(self, status: Status) -> None:
        before = self._status
        if before is None or (status.lifecycle, status.why) != (before.lifecycle, before.why):
            self._write(f"robot {status.lifecycle}: {status.why}")
        known = () if before is None else before.faults
        for fault in status.faults:
            if fault not in known:
                self._write(f"fault {fault.what}{' at ' + fault.joint if fault.joint else ''}: {fault.cause}")
