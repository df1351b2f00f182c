"""What comes in to the HAL host: queued by Zenoh's threads, decoded and handed over in the host's own, in order."""

import time
from collections.abc import Callable
from queue import Empty
from typing import Any, Protocol

from snakesim_hal import keys
from snakesim_hal.codec import Decoder
from snakesim_hal.errors import WireError
from snakesim_hal.mailbox import Mailbox
from snakesim_hal.messages import Answer, Done, EstopRequest, JointCommand, LeaseRequest, LifecycleRequest
from snakesim_hal.session import Arrival, Question, Session

INBOX_LIMIT = 4096

Request = LeaseRequest | LifecycleRequest | EstopRequest


class Receiver(Protocol):
    """Who acts on what comes in."""

    def take_command(self, command: JointCommand, monotonic_ns: int) -> None:
        """A command, and when it came."""
        ...

    def take_done(self, service: str, tick: int) -> None:
        """A service owes nothing more for a tick."""
        ...

    def came_or_went(self, service: str, present: bool) -> None:
        """A service's token is there, or is not any more."""
        ...

    def answer(self, request: Request, reply: Callable[[Answer], None]) -> None:
        """Somebody asks; reply once, from any thread."""
        ...

    def refuse(self, error: WireError) -> Answer:
        """Something cannot be decoded; what to answer if it was a question."""
        ...


class Inbox:
    """A queue that Zenoh fills and the host empties."""

    def __init__(self, session: Session, receiver: Receiver) -> None:
        """Declares everything that the host listens to."""
        self._receiver = receiver
        self._queue: Mailbox[Any] = Mailbox()
        self._command_decoder = Decoder(JointCommand)
        self._done_decoder = Decoder(Done)
        self._request_decoders: dict[str, Decoder[Any]] = {
            keys.LEASE: Decoder(LeaseRequest),
            keys.LIFECYCLE: Decoder(LifecycleRequest),
            keys.ESTOP: Decoder(EstopRequest),
        }
        self.dropped = 0
        session.on_arrival(keys.JOINT_COMMAND, self._put)
        session.on_arrival(keys.DONE_ALL, self._put)
        for key in self._request_decoders:
            session.on_question(key, self._put)
        session.on_alive(lambda key, present: self._put((keys.service_of(key), present)))

    def waiting(self) -> int:
        """How much has not been taken yet."""
        return self._queue.qsize()

    def take(self, timeout_s: float) -> bool:
        """Handle the next thing that comes in; False when nothing came in time."""
        try:
            item = self._queue.get(timeout=timeout_s)
        except Empty:
            return False
        self.handle(item)
        return True

    def take_until(self, monotonic_ns: int) -> None:
        """Handle everything that comes in until a moment has come."""
        while (left_ns := monotonic_ns - time.monotonic_ns()) > 0 and self.take(left_ns * 1e-9):
            pass

    def take_all(self) -> None:
        """Handle everything that is there."""
        for _ in range(self._queue.qsize()):
            self.handle(self._queue.get())

    def handle(self, item: Any) -> None:
        """Decode one thing, and hand it over."""
        receiver = self._receiver
        if isinstance(item, Question):
            self._ask(item)
        elif not isinstance(item, Arrival):
            receiver.came_or_went(*item)
        else:
            try:
                if item.key == keys.JOINT_COMMAND:
                    command = self._command_decoder.decode(item.payload, item.encoding)
                    receiver.take_command(command, item.monotonic_ns)
                else:
                    done = self._done_decoder.decode(item.payload, item.encoding)
                    receiver.take_done(keys.service_of(item.key), done.tick)
            except WireError as error:
                receiver.refuse(error)

    def _ask(self, question: Question) -> None:
        try:
            request = self._request_decoders[question.key].decode(question.payload, question.encoding)
        except WireError as error:
            question.reply(self._receiver.refuse(error))
        else:
            self._receiver.answer(request, question.reply)

    def _put(self, item: Any) -> None:
        """In Zenoh's thread. Only samples may be dropped: a flood of commands must not keep an emergency stop out."""
        if not isinstance(item, Arrival) or self._queue.qsize() < INBOX_LIMIT:
            self._queue.put(item)
        else:
            self.dropped += 1
