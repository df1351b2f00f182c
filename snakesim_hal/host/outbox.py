"""What goes out of the HAL host: streams, the status and answers, sent by threads of their own.

The host's loop never calls Zenoh while a robot moves in real time: a network that is held up (a thousand readers that
leave at once, a reader that does not read) costs freshness there, and never a tick here. In lockstep, where only
simulated time passes, the loop sends streams itself, and waits for slow readers.
"""

import threading
import time
from collections.abc import Callable
from typing import Any

from snakesim_hal.model.injection import HAL
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Publisher, Question, Session
from snakesim_hal.terminal import complain
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, AppliedCommand, Description, Message, Status

WAITING_LIMIT = 256  # messages that wait to be sent; the oldest of more are forgotten
FLUSH_S = 1.0  # how long what waits is still sent at the end


class Sender:
    """A thread that does one thing after another."""

    def __init__(self, name: str) -> None:
        self._waiting: Mailbox[Callable[[], None] | None] = Mailbox((WAITING_LIMIT,))
        self._closing = False
        self._since_ns = 0  # when the thing under way began; 0: none is
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def do(self, action: Callable[[], None]) -> None:
        """Have it done soon; never waits."""
        self._waiting.put(action)

    def held_up_s(self) -> float:
        """For how long the thing under way has taken."""
        began_ns = self._since_ns
        return (time.monotonic_ns() - began_ns) * 1e-9 if began_ns else 0.0

    def close(self) -> None:
        """Do what waits, for a moment, and end."""
        self._closing = True
        self._waiting.put(None)
        self._thread.join(FLUSH_S)

    def _run(self) -> None:
        while (action := self._waiting.get()) is not None:
            self._since_ns = time.monotonic_ns()
            try:
                action()
            except Exception as error:  # noqa: BLE001 - this thread's outermost loop; the network is closed, as a rule
                if not self._closing:
                    complain(f"not sent: {type(error).__name__}: {error}")
            self._since_ns = 0


class Outbox:
    """Of one host."""

    def __init__(self, session: Session, description: Description, *, lockstep: bool) -> None:
        """Shows the robot, and that its host is there."""
        self._session, self._lockstep = session, lockstep
        self._publishers: dict[str, Publisher[Any]] = {keys.STATUS: session.latched_publisher(keys.STATUS, Status)}
        self._streams = Sender("streams")
        self._answers = Sender("answers")
        self.applied_heard = False  # whether anybody listens to hal/applied
        session.latched_publisher(keys.DESCRIPTION, Description).put(description)
        session.declare_alive(HAL)
        if description.host is not None:
            session.declare_token(keys.host(description.host))

    def put(self, key: str, message: Message) -> None:
        """Publish it."""
        if self._lockstep:
            self._publisher(key, type(message)).put(message)
        else:
            self._streams.do(lambda: self._publisher(key, type(message)).put(message))

    def put_status(self, status: Status) -> None:
        """Publish the status, and look who listens."""

        def send() -> None:
            self._publishers[keys.STATUS].put(status)
            self.applied_heard = self._publisher(keys.APPLIED, AppliedCommand).heard()

        self._streams.do(send)

    def answer(self, question: Question, answer: Answer) -> None:
        """Answer a query. Whoever asked may be slow to hear it."""
        self._answers.do(lambda: question.reply(answer))

    def log(self, text: str) -> None:
        """Write a line to the process's log. A disk may be slow."""
        self._answers.do(lambda: complain(text))

    def held_up_s(self) -> float:
        """For how long the network has not taken a stream."""
        return self._streams.held_up_s()

    def close(self) -> None:
        """Send what waits, for a moment."""
        self._answers.close()
        self._streams.close()

    def _publisher(self, key: str, message: type[Message]) -> Publisher[Any]:
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.publisher(key, message, lossless=self._lockstep)
        return publisher
