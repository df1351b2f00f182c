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
from snakesim_hal.network.streams import IncomingQuery, Publisher
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import IMAGE_MESSAGE_TYPES, EncodedMessage
from snakesim_hal.wire.messages import (
    MAX_CONFIG,
    Answer,
    Message,
    RobotDescription,
    RobotStatus,
    RunConfiguration,
    TickDone,
)

# Queued actions; each sends one message, or all messages of a tick; the oldest are dropped.
MAX_QUEUED_ACTIONS = 64
MAX_QUEUED_IMAGES = 8
FLUSH_S = 1.0  # how long queued actions still run at the end: a network or a disk may hang
RECEIPT_TIMEOUT_S = 10.0  # for recorders on a busy computer, at the end of a run in lockstep

# Key and message; None: it has not been encoded yet.
Outgoing = tuple[str, Message, EncodedMessage | None]


class SerialWorker:
    """A thread that runs actions one after another."""

    def __init__(self, name: str, max_queued_actions: int = MAX_QUEUED_ACTIONS) -> None:
        """Start the thread.

        Args:
            name: Name of the thread.
            max_queued_actions: Number of actions that may wait. If there are more, the oldest are dropped.
        """
        # None ends the thread.
        self._queued_actions: Mailbox[Callable[[], None] | None] = Mailbox((max_queued_actions,))
        self._is_closing = False
        # Monotonic time at which the current action started; 0 while idle.
        self._action_start_ns = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, action: Callable[[], None]) -> None:
        """Queue an action; never waits."""
        self._queued_actions.put(action)

    def busy_duration_s(self) -> float:
        """Return for how long the current action has been running, in s; 0 if there is none."""
        start_ns = self._action_start_ns  # read once, because the sender's thread changes it
        if not start_ns:
            return 0.0
        return (time.monotonic_ns() - start_ns) * 1e-9

    def close(self) -> None:
        """Run queued actions for at most FLUSH_S, and end."""
        self._is_closing = True
        self._queued_actions.put(None)
        self._thread.join(FLUSH_S)

    def _run(self) -> None:
        while (action := self._queued_actions.get()) is not None:
            self._action_start_ns = time.monotonic_ns()
            try:
                action()
            except Exception as error:  # noqa: BLE001 - this thread's outermost loop; usually the network is closed
                if not self._is_closing:
                    print_stderr(f"not sent: {type(error).__name__}: {error}")
            self._action_start_ns = 0


class HostOutbox:
    """The output of one host. The host's threads put messages and answers into it."""

    def __init__(
        self, session: Session, description: RobotDescription, config: bytes, *, lockstep: bool
    ) -> None:
        """Publish the description and the effective configuration, and declare the host's liveliness tokens.

        Args:
            session: Session in the robot's namespace.
            description: Description of the robot.
            config: Effective configuration as JSON. It is not published if it is longer than MAX_CONFIG.
            lockstep: Whether streams are sent in the caller's thread, and wait for slow subscribers.
        """
        self._session = session
        self._lockstep = lockstep
        self._publishers: dict[str, Publisher[Any]] = {
            keys.STATUS: session.declare_latched_publisher(keys.STATUS, RobotStatus)
        }
        # Threads. Without a camera, images need no thread of their own.
        self._streams = SerialWorker("streams")
        self._answers = SerialWorker("answers")
        has_camera = any(
            keys.find_message(sensor.key) in IMAGE_MESSAGE_TYPES for sensor in description.sensors
        )
        self._images = SerialWorker("images", MAX_QUEUED_IMAGES) if has_camera else self._streams
        # Latched messages and liveliness tokens.
        session.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(description)
        if len(config) <= MAX_CONFIG:
            configuration = RunConfiguration(
                config_hash=description.config_hash, content=config.decode()
            )
            session.declare_latched_publisher(keys.CONFIG, RunConfiguration).put(configuration)
        session.declare_alive(HAL)
        if description.host is not None:
            session.declare_token(keys.host_key(description.host))

    def publish(self, *messages: Outgoing) -> None:
        """Publish messages in this order. In real time images have a thread of their own, because they take long."""
        if self._lockstep:
            self._publish(messages)
            return
        if self._images is not self._streams:
            images = [
                outgoing for outgoing in messages if isinstance(outgoing[1], IMAGE_MESSAGE_TYPES)
            ]
            if images:
                self._images.submit(lambda: self._publish(images))
                messages = tuple(outgoing for outgoing in messages if outgoing not in images)
        self._streams.submit(lambda: self._publish(messages))

    def _publish(self, messages: Sequence[Outgoing]) -> None:
        for key, message, encoded in messages:
            self._get_publisher(key, type(message)).put(message, encoded)

    def send_answer(self, query: IncomingQuery, answer: Answer) -> None:
        """Send the answer to a query in another thread, because the requester may be slow."""
        self._answers.submit(lambda: query.reply(answer))

    def log(self, text: str) -> None:
        """Write a line to the log of the process in another thread, because a disk may be slow."""
        self._answers.submit(lambda: print_stderr(text))

    def blocked_duration_s(self) -> float:
        """Return for how long the network has been blocked, in s."""
        return self._streams.busy_duration_s()

    def close(self, last_tick: int) -> None:
        """Send queued messages for at most FLUSH_S. In lockstep, wait until the recorders have received everything.

        Args:
            last_tick: The last tick of the run.
        """
        # Two of them may be the same.
        senders = dict.fromkeys((self._answers, self._images, self._streams))
        for sender in senders:
            sender.close()
        if self._lockstep:
            self._wait_for_recorders(last_tick)

    def _wait_for_recorders(self, last_tick: int) -> None:
        """Wait until every recorder has received all messages, for at most RECEIPT_TIMEOUT_S.

        Messages that a recorder has not read yet may be lost when the session of this host is closed. The request
        follows all messages, so an answer means that they have arrived.
        """
        answers = self._session.send_request_to_all(
            keys.RECEIVED,
            TickDone(tick=last_tick),
            RECEIPT_TIMEOUT_S,
            follows_all_messages=True,
        )
        for _ in answers:
            pass

    def _get_publisher(self, key: str, message: type[Message]) -> Publisher[Any]:
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._session.declare_publisher(key, message, lossless=self._lockstep)
            self._publishers[key] = publisher
        return publisher
