"""What viewers can do to the robot: the commands of the command line, from a page.

Each call takes as long as its command does, and returns what that would print, or raises its SnakesimError. So each
command's checks hold here too: two answers are an attack, and a state counts once the host itself publishes it.
"""

import threading
from collections import deque
from collections.abc import Callable
from datetime import datetime

from snakesim_hal.base.errors import NotConnectedError, RefusedError, SnakesimError
from snakesim_hal.network.session import Link, Publisher, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, Intent, Message, SettingsRequest
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.robot_commands.command import ANSWER_S, arm, clear, disarm, simulator
from snakesim_operator.robot_commands.fault import FaultOrder, fault
from snakesim_operator.robot_commands.prepared_stop import PreparedStop
from snakesim_operator.robot_commands.simulator_order import SimulatorOrder

LOG_LINES = 200
# How long an intent from the page is valid, from the last moment at which its button or key is known to have been held.
# Then a viewer who is gone moves nothing. A button sends ten times a second that it is held; a held key at first after
# as long as its keyboard takes to repeat it, mostly 0.25 to 0.66 s. Both include the page's answer to a question, by
# which that moment is known: about 0.2 s.
BUTTON_NS, KEY_NS = 700_000_000, 1_000_000_000


class PageLog:
    """The newest lines of what viewers did and what became of the robot; newest first."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=LOG_LINES)
        self._lock = threading.Lock()
        self.written = 0

    def write(self, line: str) -> None:
        """Add a line, with the time of day; from any thread."""
        with self._lock:
            self._lines.appendleft(f"{datetime.now():%H:%M:%S}  {line}")
            self.written += 1

    def lines(self) -> list[str]:
        """All of them."""
        with self._lock:
            return list(self._lines)


class Operations:
    """The robot at a link, as far as one can act on it."""

    def __init__(self, link: Link, log: PageLog) -> None:
        self.link = link
        self._where = RobotSelection(link.endpoint, link.namespace, link.session)
        self._log = log
        self.stop = PreparedStop(self._where, link, lambda who, text: log.write(f"{who}: EMERGENCY STOP: {text}"))
        self._session: Session | None = None
        self._intents: Publisher[Intent] | None = None

    def connect(self, session: Session) -> None:
        """Use this session for what the command line has no command for."""
        self._session, self._intents = session, session.publisher(keys.INTENT, Intent)
        self.stop.connect(session)

    def arm(self, who: str, robot: Description, *, unchecked: bool = False) -> str:
        """Arm the robot that the page shows. unchecked: also without a check of its joints."""
        what = f"{who}: arm{', unchecked' if unchecked else ''}"
        return self._do(what, lambda say: arm(robot.robot, robot.backend, self._where, say, unchecked=unchecked))

    def disarm(self, who: str) -> str:
        """Make the joints passive."""
        return self._do(f"{who}: disarm", lambda say: disarm(self._where, say))

    def clear(self, who: str) -> str:
        """Clear a fault or an emergency stop."""
        return self._do(f"{who}: clear", lambda say: clear(self._where, say))

    def change_time(self, who: str, order: SimulatorOrder) -> str:
        """Pause, step, speed or reset, where the robot is a simulator."""
        return self._do(f"{who}: simulator: {order}", lambda say: simulator(order, self._where, say))

    def inject(self, who: str, order: FaultOrder) -> str:
        """Inject a fault, where the run allows it."""
        return self._do(f"{who}: fault {order.kind}:{order.target}", lambda say: fault(order, self._where, say))

    def configure(self, who: str, controller: str, settings: str) -> str:
        """Have the running controller go on with other settings."""
        request = SettingsRequest(who=who, controller=controller, settings=settings)
        return self._do(f"{who}: settings", lambda say: self._ask(keys.SETTINGS, request, say))

    def drive(self, who: str, heading_w_rad: float, speed_m_s: float, acted_ns: int, valid_ns: int) -> None:
        """Ask for a direction and a speed. acted_ns: robot time at which the viewer did; valid_ns: from then on."""
        if self._intents is not None:
            intent = Intent(
                timestamp_ns=acted_ns, who=who, speed_m_s=speed_m_s, heading_w_rad=heading_w_rad, valid_for_ns=valid_ns
            )
            self._intents.put(intent)

    def _ask(self, key: str, request: Message, say: Callable[[str], None]) -> int:
        """One question, and its answer. Raises RefusedError, NotConnectedError."""
        if self._session is None:
            raise NotConnectedError("not connected to the robot yet")
        answer = self._session.ask(key, request, ANSWER_S)
        if not answer.ok:
            raise RefusedError(answer.reason)
        say(answer.reason)
        return 0

    def _do(self, what: str, call: Callable[[Callable[[str], None]], int]) -> str:
        lines: list[str] = []
        try:
            failed = call(lines.append) != 0
            said = "; ".join(lines)
            if failed:
                raise RefusedError(said)
        except SnakesimError as error:
            self._log.write(f"{what}: {error}")
            raise
        self._log.write(f"{what}: {said}")
        return said
