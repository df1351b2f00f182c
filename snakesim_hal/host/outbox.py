"""Output of the HAL host: streams, the status and answers, sent by separate threads.

The host's loop never calls Zenoh while a robot moves in real time: a blocked network (a thousand subscribers that
leave at once, a subscriber that does not read) delays messages, but never a tick. In lockstep, where only
simulated time passes, the loop sends streams itself, and waits for slow subscribers.

Threads: any thread may queue output; a `Sender` runs it in its own thread.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Publisher, Query
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import IMAGES
from snakesim_hal.wire.messages import MAX_CONFIG, Answer, Configuration, Description, Message, Status

WAITING_LIMIT = 64  # queued actions; each sends one message, or all messages of a tick; the oldest are dropped
IMAGES_WAITING_LIMIT = 8
FLUSH_S = 1.0  # how long queued actions still run at the end: a network or a disk may hang

Outgoing = tuple[str, Message, bytes | None]  # key, message, and its bytes if it has been encoded already


class Sender:
    """A thread that runs actions one after another."""

    def __init__(self, name: str, waiting_limit: int = WAITING_LIMIT) -> None:
        """Start the thread. If more than `waiting_limit` actions wait, the oldest are dropped."""
        self._waiting: Mailbox[Callable[[], None] | None] = Mailbox((waiting_limit,))  # None: end
        self._closing = False
        self._began_ns = 0  # monotonic time at which the present action began; 0: idle
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def queue(self, action: Callable[[], None]) -> None:
        """Queue an action; never waits."""
        self._waiting.put(action)

    def busy_s(self) -> float:
        """Return for how long the present action has been running; 0 if there is none."""
        began_ns = self._began_ns  # read once: the sender's thread changes it
        if not began_ns:
            return 0.0
        return (time.monotonic_ns() - began_ns) * 1e-9

    def close(self) -> None:
        """Run queued actions for at most FLUSH_S, and end."""
        self._closing = True
        self._waiting.put(None)
        self._thread.join(FLUSH_S)

    def _run(self) -> None:
        while (action := self._waiting.get()) is not None:
            self._began_ns = time.monotonic_ns()
            try:
                action()
            except Exception as error:  # noqa: BLE001 - this thread's outermost loop; usually the network is closed
                if not self._closing:
                    print_stderr(f"not sent: {type(error).__name__}: {error}")
            self._began_ns = 0


class Outbox:
    """The output of one host. The host's threads put messages and answers into it."""

    def __init__(self, session: Session, description: Description, config: bytes, *, lockstep: bool) -> None:
        """Publish the description and the effective configuration, and declare the host's liveliness tokens.

        Args:
            session: a session in the robot's namespace.
            description: of the robot.
            config: the effective configuration as text; a very long one is not published.
            lockstep: True: streams are sent in the caller's thread, and wait for slow subscribers.
        """
        self._session = session
        self._lockstep = lockstep
        self._publishers: dict[str, Publisher[Any]] = {keys.STATUS: session.latched_publisher(keys.STATUS, Status)}
        # Threads. Without a camera, no thread for images is needed.
        self._streams = Sender("streams")
        self._answers = Sender("answers")
        has_camera = any(keys.find_message(sensor.key) in IMAGES for sensor in description.sensors)
        self._images = Sender("images", IMAGES_WAITING_LIMIT) if has_camera else self._streams
        # Latched messages and liveliness tokens.
        session.latched_publisher(keys.DESCRIPTION, Description).put(description)
        if len(config) <= MAX_CONFIG:
            effective = Configuration(config_hash=description.config_hash, content=config.decode())
            session.latched_publisher(keys.CONFIG, Configuration).put(effective)
        session.declare_alive(HAL)
        if description.host is not None:
            session.declare_token(keys.host_key(description.host))

    def publish(self, *messages: Outgoing) -> None:
        """Publish messages in this order. In real time images have a thread of their own, because they take long."""
        if self._lockstep:
            self._publish(messages)
            return
        if self._images is not self._streams:
            images = [outgoing for outgoing in messages if isinstance(outgoing[1], IMAGES)]
            if images:
                self._images.queue(lambda: self._publish(images))
                messages = tuple(outgoing for outgoing in messages if outgoing not in images)
        self._streams.queue(lambda: self._publish(messages))

    def _publish(self, messages: Sequence[Outgoing]) -> None:
        for key, message, encoded in messages:
            self._publisher(key, type(message)).put(message, encoded)

    def answer(self, question: Query, answer: Answer) -> None:
        """Answer a query. The requester may be slow."""
        self._answers.queue(lambda: question.reply(answer))

    def log(self, text: str) -> None:
        """Write a line to the process's log. A disk may be slow."""
        self._answers.queue(lambda: print_stderr(text))

    def blocked_s(self) -> float:
        """Return for how long the network has been blocked, in s."""
        return self._streams.busy_s()

    def close(self) -> None:
        """Send queued messages for at most FLUSH_S."""
        senders = dict.fromkeys((self._answers, self._images, self._streams))  # two of them may be the same
        for sender in senders:
            sender.close()

    def _publisher(self, key: str, message: type[Message]) -> Publisher[Any]:
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._session.publisher(key, message, lossless=self._lockstep)
            self._publishers[key] = publisher
        return publisher
