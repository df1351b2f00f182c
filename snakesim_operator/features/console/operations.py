"""The commands that viewers can give to the robot: those of the command line, from a page.

Each call takes as long as its command does. It returns the text that the command would print, or raises its
SnakesimError. So the checks of each command hold here too: two answers are an attack, and a state counts only once the
host itself publishes it.
"""

import threading
from collections import deque
from collections.abc import Callable
from datetime import datetime

from snakesim_hal.base.errors import NotConnectedError, RefusedError, SnakesimError
from snakesim_hal.network.session import ConnectionSettings, Session
from snakesim_hal.network.streams import Publisher
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    LocomotionIntent,
    Message,
    ParametersRequest,
    RobotDescription,
)
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.robot_commands.command import (
    ANSWER_TIMEOUT_S,
    arm_robot,
    control_simulator,
    disarm_robot,
    reset_robot,
)
from snakesim_operator.robot_commands.fault import FaultOrder, inject_fault
from snakesim_operator.robot_commands.prepared_stop import PreparedStop
from snakesim_operator.robot_commands.simulator_order import SimulatorOrder

MAX_LOG_LINES = 200

# How long an intent from the page is valid, from the last moment at which its button or key is known to have been held.
# After that, a viewer whose page is gone moves nothing. Both times include about 0.2 s for the page's answer to a
# question, by which that moment is known.
BUTTON_VALIDITY_NS = 700_000_000  # a page repeats ten times a second that a button is held
KEY_VALIDITY_NS = 1_000_000_000  # a keyboard first repeats a held key after 0.25 to 0.66 s

PrintText = Callable[[str], None]


class PageLog:
    """The newest lines about what viewers did and how the robot's state changed. Thread-safe."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=MAX_LOG_LINES)
        self._lock = threading.Lock()

    def write(self, line: str) -> None:
        """Add a line, with the time of day."""
        with self._lock:
            self._lines.appendleft(f"{datetime.now():%H:%M:%S}  {line}")

    def list_lines(self) -> list[str]:
        """Return all lines, newest first."""
        with self._lock:
            return list(self._lines)


class RobotOperations:
    """Sends the commands of viewers to the robot at a link, and logs each of them with its outcome.

    `requester` is the name of the viewer. Each method that returns a text waits for the robot's answer, and raises a
    SnakesimError when the robot refuses, or does not answer.
    """

    def __init__(self, connection: ConnectionSettings, log: PageLog) -> None:
        self.link = connection
        self._selection = RobotSelection(
            connection.endpoint, connection.namespace, connection.session
        )
        self._log = log
        self.stop = PreparedStop(self._selection, connection, self._log_stop)
        # Known once the console is connected.
        self._session: Session | None = None
        self._intent_publisher: Publisher[LocomotionIntent] | None = None

    def _log_stop(self, requester: str, outcome: str) -> None:
        self._log.write(f"{requester}: EMERGENCY STOP: {outcome}")

    def connect(self, session: Session) -> None:
        """Use this session for intents, parameters and the stop."""
        self._session = session
        self._intent_publisher = session.declare_publisher(keys.INTENT, LocomotionIntent)
        self.stop.use_session(session)

    def arm(self, requester: str, robot: RobotDescription, *, unchecked: bool = False) -> str:
        """Arm the robot that the page shows; with `unchecked` also if its joints were not checked."""
        title = f"{requester}: arm"
        if unchecked:
            title += ", unchecked"
        return self._run_command(
            title,
            lambda print_: arm_robot(
                robot.robot, robot.backend, self._selection, print_, unchecked=unchecked
            ),
        )

    def disarm(self, requester: str) -> str:
        """Make the joints passive."""
        return self._run_command(
            f"{requester}: disarm", lambda print_: disarm_robot(self._selection, print_)
        )

    def reset_fault(self, requester: str) -> str:
        """Reset a fault or an emergency stop."""
        return self._run_command(
            f"{requester}: reset", lambda print_: reset_robot(self._selection, print_)
        )

    def control_simulator(self, requester: str, order: SimulatorOrder) -> str:
        """Pause, resume, step, speed up or reset a simulator."""
        return self._run_command(
            f"{requester}: simulator: {order}",
            lambda print_: control_simulator(order, self._selection, print_),
        )

    def inject_fault(self, requester: str, order: FaultOrder) -> str:
        """Inject a fault, or end it, if the run allows fault injection."""
        title = f"{requester}: fault {order.kind}:{order.target}"
        return self._run_command(title, lambda print_: inject_fault(order, self._selection, print_))

    def change_parameters(self, requester: str, controller: str, parameters: str) -> str:
        """Change the parameters of the running controller. `parameters` are all of them as JSON."""
        request = ParametersRequest(
            requester=requester, controller=controller, parameters=parameters
        )
        return self._run_command(
            f"{requester}: parameters",
            lambda print_: self._send_request(keys.PARAMETERS, request, print_),
        )

    def drive(
        self, requester: str, heading_w_rad: float, speed_m_s: float, acted_ns: int, valid_ns: int
    ) -> None:
        """Publish an intent to go in a direction at a speed. Does not wait; does nothing before `connect`.

        Args:
            requester: Name of the viewer.
            heading_w_rad: Direction in the world frame.
            speed_m_s: Speed; negative is backwards.
            acted_ns: Robot time in ns at which the viewer is known to have acted.
            valid_ns: Duration in ns for which the intent is valid from then on.
        """
        if self._intent_publisher is None:
            return
        intent = LocomotionIntent(
            timestamp_ns=acted_ns,
            requester=requester,
            speed_m_s=speed_m_s,
            heading_w_rad=heading_w_rad,
            valid_for_ns=valid_ns,
        )
        self._intent_publisher.put(intent)

    def _send_request(self, key: str, request: Message, print_: PrintText) -> int:
        """Send a request that has no command of the command line, and print the answer.

        Returns:
            0, the exit code of a command that succeeded.

        Raises:
            RefusedError: The receiver refused the request.
            NotConnectedError: There is no connection or no answer.
        """
        if self._session is None:
            raise NotConnectedError("not connected to the robot yet", code="network/no-robot")
        response = self._session.send_request(key, request, ANSWER_TIMEOUT_S)
        if not response.ok:
            raise RefusedError(response.reason)
        print_(response.reason)
        return 0

    def _run_command(self, title: str, command: Callable[[PrintText], int]) -> str:
        """Run a command, log its outcome, and return what it printed.

        Args:
            title: Viewer and command, for the log.
            command: Runs the command; it prints with the function that it is given, and returns an exit code.

        Raises:
            SnakesimError: The command failed.
        """
        lines: list[str] = []
        try:
            exit_code = command(lines.append)
            text = "; ".join(lines)
            if exit_code != 0:
                raise RefusedError(text)
        except SnakesimError as error:
            self._log.write(f"{title}: {error}")
            raise
        self._log.write(f"{title}: {text}")
        return text
