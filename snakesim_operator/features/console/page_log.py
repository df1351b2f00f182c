"""Lines of the log about changes of a robot's state, live or from a recording."""

from collections.abc import Callable

from snakesim_hal.wire.messages import ControlParameters, ControlState, RobotStatus


class StateChangeLog:
    """Writes a line for each change between a message and the one before it."""

    def __init__(self, write: Callable[[str], None]) -> None:
        """Start without messages. `write` is called with each line."""
        self._write = write
        self._status: RobotStatus | None = None
        self._control: ControlState | None = None
        self._parameters: ControlParameters | None = None

    def log_change(self, message: RobotStatus | ControlState | ControlParameters | None) -> None:
        """Compare a message with the one before it of its type. The same message may be given again."""
        match message:
            case RobotStatus() if message is not self._status:
                self._note_status(message)
            case ControlState() if message is not self._control:
                self._note_control(message)
            case ControlParameters() if message != self._parameters:
                self._note_parameters(message)
            case _:
                pass

    def _note_status(self, status: RobotStatus) -> None:
        previous = self._status
        self._status = status
        if previous is None or (status.lifecycle, status.reason) != (
            previous.lifecycle,
            previous.reason,
        ):
            self._write(f"robot {status.lifecycle}: {status.reason}")
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

    def _note_parameters(self, parameters: ControlParameters) -> None:
        self._parameters = parameters
        if parameters.requester is not None:  # None: the controller started with them
            self._write(
                f"parameters of {parameters.controller} in force, as {parameters.requester} asked"
            )
