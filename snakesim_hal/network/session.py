"""The Zenoh session of a process: publishers, readers, queries and liveliness tokens, with a quality of service each.

A session connects to explicit endpoints, without scouting, and sees one namespace, which is one robot. `connection`
opens Zenoh and has its settings; `local_network` has the same sessions within one process, without Zenoh.

Threads: every method may be called from any thread of the process. Zenoh calls the callbacks that `on_arrival`,
`on_query` and `on_token_change` register in its own threads, so they must return at once: they store what arrived, and
the process handles it in a thread of its own.
"""

import ctypes
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from typing import Any

import zenoh
from zenoh import ext, handlers  # pyright: ignore[reportMissingModuleSource]

from snakesim_hal.base.errors import ConfigError, NotConnectedError, WireError
from snakesim_hal.base.process import raise_open_file_limit
from snakesim_hal.network.connection import (
    CLIENT_RECEIVING_THREADS,
    ROUTER_RECEIVING_THREADS,
    ConnectionSettings,
    limit_receiving_threads,
    open_zenoh,
)
from snakesim_hal.network.endpoint import require_safe_listening_endpoint
from snakesim_hal.network.image_connection import configure_for_images
from snakesim_hal.network.streams import (
    READER_DEPTH,
    IncomingQuery,
    Publisher,
    ReceivedSample,
    SampleReader,
    get_reader_depth,
)
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import (
    IMAGE_MESSAGE_TYPES,
    MessageDecoder,
    MessageT,
    encode,
    format_encoding,
)
from snakesim_hal.wire.messages import Answer, ImagePreview, Message

MAX_OPEN_FILES = 16384  # each connection takes one, and the default limit of a process is 1024
DONE_KEY_PREFIX = keys.done_key("")  # of the keys on which services report that their tick is done
POLL_S = 0.01  # between two looks for a latched value


class Session:
    """A Zenoh session, as SnakeSIM uses it. Open one with `open_session`.

    Example:
        with open_session(Link(endpoint, "planar13")) as session:
            reader = session.declare_reader(keys.JOINTS, JointState)
            for joints in reader.drain():
                print(joints.angle_rad)
    """

    def __init__(
        self, zenoh_session: Any, open_for_images: Callable[[], Any] | None = None
    ) -> None:
        """Wrap an open Zenoh session.

        Args:
            zenoh_session: Open session of Zenoh, which is closed with this session.
            open_for_images: Function that opens a connection for images alone, called when the first publisher of
                images is declared. None if images share the connection of all other messages.
        """
        # Connections.
        self._zenoh = zenoh_session
        self._shares_connection = False  # whether another session closes the connection
        self._open_for_images = open_for_images
        self._image_session: Any = None
        # What this session declares.
        self._declared: list[Any] = []
        self._publishers: dict[str, Publisher[Any]] = {}
        self._reroute_by_key: dict[str, Callable[[bytes], None]] = {}
        self.rejected: Counter[str] = Counter()  # samples that could not be decoded, by reason

    # --- publishing ------------------------------------------------------------------------------------------

    def declare_publisher(
        self, key: str, message: type[MessageT], *, lossless: bool = False
    ) -> Publisher[MessageT]:
        """Declare a publisher for a stream.

        Args:
            key: Key to publish on.
            message: Type of the messages, which decides the priority.
            lossless: Whether `put` waits for slow subscribers, as in lockstep. Otherwise samples are dropped for them.

        Returns:
            The publisher, which is undeclared when this session is closed.
        """
        # The last message of a tick is sent at once, batched with those put just before it: one packet instead of five.
        is_last_of_tick = key in (keys.JOINT_COMMAND, keys.CLOCK) or key.startswith(DONE_KEY_PREFIX)
        congestion_control = zenoh.CongestionControl.DROP
        if lossless:
            congestion_control = zenoh.CongestionControl.BLOCK
        session = self._zenoh
        # In lockstep, images must arrive before the clock of their tick.
        if message in IMAGE_MESSAGE_TYPES and not lossless:
            session = self._open_image_session()
        publisher = session.declare_publisher(
            key,
            encoding=format_encoding(message),
            congestion_control=congestion_control,
            priority=_choose_priority(key, message),
            express=is_last_of_tick,
        )
        return self._wrap_publisher(key, publisher, message)

    def _open_image_session(self) -> Any:
        """Return the connection for images, which is opened when it is first needed."""
        if self._open_for_images is None:
            return self._zenoh
        if self._image_session is None:
            self._image_session = self._open_for_images()
        return self._image_session

    def declare_latched_publisher(self, key: str, message: type[MessageT]) -> Publisher[MessageT]:
        """Declare a publisher whose last value is sent to later subscribers."""
        publisher = ext.declare_advanced_publisher(
            self._zenoh,
            key,
            encoding=format_encoding(message),
            cache=ext.CacheConfig(1),
            publisher_detection=True,
        )
        return self._wrap_publisher(key, publisher, message)

    def _wrap_publisher(
        self, key: str, publisher: Any, message: type[MessageT]
    ) -> Publisher[MessageT]:
        self._declared.append(publisher)
        wrapped = Publisher(
            message, publisher.put, lambda: bool(publisher.matching_status.matching)
        )
        return self._register_publisher(key, wrapped)

    def _register_publisher(self, key: str, publisher: Publisher[MessageT]) -> Publisher[MessageT]:
        """Apply the key's reroute, now and later, and return the publisher."""
        self._publishers[key] = publisher
        publisher.reroute(self._reroute_by_key.get(key))
        return publisher

    def reroute(self, key: str, put: Callable[[bytes], None] | None) -> None:
        """Pass payloads of a key's present and future publishers to `put`; None: send them directly again."""
        if put is None:
            self._reroute_by_key.pop(key, None)
        else:
            self._reroute_by_key[key] = put
        if key in self._publishers:
            self._publishers[key].reroute(put)

    def send(self, key: str, payload: bytes) -> None:
        """Send raw bytes on a key that this session publishes on, bypassing any reroute."""
        self._publishers[key].send(payload)

    # --- reading ---------------------------------------------------------------------------------------------

    def declare_reader(
        self, key: str, message: type[MessageT], *, depth: int | None = None
    ) -> SampleReader[MessageT]:
        """Subscribe to a stream. A slow reader loses old samples, and never blocks the publisher.

        Args:
            key: Key to subscribe to. It may have wildcards.
            message: Type of the messages.
            depth: Number of the newest samples that the reader keeps. None means the default for this type.
        """
        subscriber = self._zenoh.declare_subscriber(
            key, handlers.RingChannel(depth or get_reader_depth(message))
        )
        self._declared.append(subscriber)
        return SampleReader(subscriber, message, self.rejected)

    def declare_latched_reader(self, key: str, message: type[MessageT]) -> SampleReader[MessageT]:
        """Subscribe as `reader` does, and also get the value that was latched before."""
        subscriber = ext.declare_advanced_subscriber(
            self._zenoh,
            key,
            handlers.RingChannel(READER_DEPTH),
            history=_make_last_value_history(),
        )
        self._declared.append(subscriber)
        return SampleReader(subscriber, message, self.rejected)

    def close_reader(self, reader: SampleReader[Any]) -> None:
        """Close a reader that is no longer used."""
        self._declared.remove(reader.subscriber)
        reader.subscriber.undeclare()

    def wait_for_latched(
        self,
        key: str,
        message: type[MessageT],
        timeout_s: float,
        is_acceptable: Callable[[MessageT], bool] = lambda _message: True,
    ) -> MessageT | None:
        """Wait for the value that is latched on a key, and return it.

        Args:
            key: Key on which the value is published.
            message: Type of the value.
            timeout_s: Maximum time to wait, in s.
            is_acceptable: Function that returns whether a value is acceptable. Other values are skipped.

        Returns:
            The value, or None if no acceptable one arrives in time.
        """
        reader = self.declare_latched_reader(key, message)
        deadline_s = time.monotonic() + timeout_s
        value = reader.pop_newest(is_acceptable)
        while value is None and time.monotonic() < deadline_s:
            time.sleep(POLL_S)
            value = reader.pop_newest(is_acceptable)
        self.close_reader(reader)
        return value

    # --- callbacks -------------------------------------------------------------------------------------------

    def on_arrival(self, key: str, handler: Callable[[ReceivedSample], None]) -> None:
        """Call `handler` for every sample, in a thread of this subscriber. It must only store the sample."""
        self._declared.append(self._zenoh.declare_subscriber(key, _make_arrival_handler(handler)))

    def on_urgent_arrival(self, key: str, handler: Callable[[ReceivedSample], None]) -> None:
        """Call `handler` for every sample, in the thread that receives for the whole session.

        The control loop waits for one thread less than with `on_arrival`. While `handler` runs, the session receives
        nothing else, so it must only store the sample.
        """
        callback = handlers.Callback(
            _make_handler_with_thread_state(_make_arrival_handler(handler)), indirect=False
        )
        self._declared.append(self._zenoh.declare_subscriber(key, callback))

    def on_latched_arrival(self, key: str, handler: Callable[[ReceivedSample], None]) -> None:
        """Call `handler` as `on_arrival` does, and also for the values that were latched before."""
        subscriber = ext.declare_advanced_subscriber(
            self._zenoh, key, _make_arrival_handler(handler), history=_make_last_value_history()
        )
        self._declared.append(subscriber)

    def on_query(self, key: str, handler: Callable[[IncomingQuery], None]) -> None:
        """Call `handler` for every query, in Zenoh's thread. Reply from a thread of your own."""

        def handle(query: zenoh.Query) -> None:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            encoding = str(query.encoding or "")
            # The query's own key may be a pattern, such as `hal/*`; the question is always for our key.
            handler(IncomingQuery(key, payload, encoding, query))

        self._declared.append(self._zenoh.declare_queryable(key, handle))

    # --- queries ---------------------------------------------------------------------------------------------

    def send_request(
        self, key: str, request: Message, timeout_s: float = 2.0, *, host: str | None = None
    ) -> Answer:
        """Send a request to the HAL host, and wait for the answer.

        Args:
            key: Key of the request, such as `keys.LEASE`.
            request: Message with the request.
            timeout_s: Maximum time to wait, in s.
            host: Id of the addressed host process. Answers of other hosts are ignored. None accepts the first answer.

        Raises:
            NotConnectedError: No answer arrives in time, or it cannot be decoded.
        """
        decoding_error: WireError | None = None
        for _, answer in self._iterate_answers(key, request, timeout_s):
            if isinstance(answer, WireError):
                decoding_error = answer
            elif host is None or answer.host == host:
                return answer
        if decoding_error is not None:
            raise NotConnectedError(f"the answer on {key} cannot be decoded: {decoding_error}")
        raise NotConnectedError(
            f"no answer on {key} within {timeout_s} s; is the robot's HAL host running?"
        )

    def send_request_to_all(
        self,
        pattern: str,
        request: Message,
        timeout_s: float = 2.0,
        *,
        follows_all_messages: bool = False,
    ) -> Iterator[tuple[str, Answer]]:
        """Send a request to all matching keys at once.

        Args:
            pattern: Key of the request. It may have wildcards.
            request: Message with the request.
            timeout_s: Time in s in which answers are accepted.
            follows_all_messages: Whether the request must not overtake any message that was published before.

        Yields:
            The key and the answer of each host as it arrives, until all have answered or the time is up.
        """
        # Zenoh sends waiting messages by priority, and messages of the same priority in order.
        priority = zenoh.Priority.BACKGROUND if follows_all_messages else zenoh.Priority.DATA
        answers = self._iterate_answers(pattern, request, timeout_s, priority)
        return ((key, answer) for key, answer in answers if isinstance(answer, Answer))

    def _iterate_answers(
        self,
        pattern: str,
        request: Message,
        timeout_s: float,
        priority: zenoh.Priority = zenoh.Priority.DATA,
    ) -> Iterator[tuple[str, Answer | WireError]]:
        """Send a request to all hosts whose keys match a pattern, and yield their answers as they arrive.

        Args:
            pattern: Key of the request. It may have wildcards.
            request: Message with the request.
            timeout_s: Time in s in which answers are accepted.
            priority: Zenoh's priority of the request.

        Yields:
            The key and the answer of each host. If the answer cannot be decoded, it is counted in `rejected`, and the
            error is yielded instead.
        """
        replies = self._zenoh.get(
            pattern,
            payload=encode(request),
            encoding=format_encoding(type(request)),
            timeout=timeout_s,
            priority=priority,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,  # no answer replaces another
        )
        decoder = MessageDecoder(Answer)
        for reply in replies:
            sample = reply.ok
            if sample is None:
                continue
            key = str(sample.key_expr)
            try:
                answer = decoder.decode(sample.payload.to_bytes(), str(sample.encoding))
            except WireError as error:
                self.rejected[error.reason] += 1
                yield key, error
            else:
                yield key, answer

    # --- liveliness ------------------------------------------------------------------------------------------

    def list_tokens(self, pattern: str, timeout_s: float = 1.0) -> list[str]:
        """Return the keys of all liveliness tokens that match now."""
        replies = self._zenoh.liveliness().get(pattern, timeout=timeout_s)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def declare_alive(self, service: str) -> None:
        """Declare the liveliness token of a service for as long as the session lives."""
        self.declare_token(keys.alive_key(service))

    def declare_token(self, key: str) -> None:
        """Declare a liveliness token for as long as the session lives."""
        self._declared.append(self._zenoh.liveliness().declare_token(key))

    def on_token_change(
        self, handler: Callable[[str, bool], None], key: str = keys.ALIVE_ALL
    ) -> None:
        """Call `handler(key, present)` when a token appears or vanishes, in Zenoh's thread."""

        def handle(sample: zenoh.Sample) -> None:
            handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(
            self._zenoh.liveliness().declare_subscriber(key, handle, history=True)
        )

    # --- the session itself ----------------------------------------------------------------------------------

    def create_subsession(self) -> "Session":
        """Return another session over the same connection. Closing it undeclares only its own declarations."""
        subsession = Session(self._zenoh)
        subsession._shares_connection = True
        return subsession

    def close(self) -> None:
        """Undeclare everything, then close the connections."""
        for declared in reversed(self._declared):
            with suppress(
                RuntimeError
            ):  # another thread is publishing with it: the session undeclares it
                declared.undeclare()
        self._declared.clear()
        if self._image_session is not None:
            self._image_session.close()
        if not self._shares_connection:
            self._zenoh.close()


@contextmanager
def open_session(
    connection: ConnectionSettings, connect_timeout_s: float = 5.0
) -> Iterator[Session]:
    """Connect to the network of a robot, or listen for its clients, and close the session when the context ends.

    Args:
        connection: Endpoint, and whether to connect to it or listen on it.
        connect_timeout_s: Time in s within which a client must be connected.

    Raises:
        NotConnectedError: The endpoint does not answer, or cannot be listened on.
        RefusedError: The endpoint is on loopback, and that interface is down.
        ConfigError: Listening there would let other machines command the robot.
    """
    if connection.listen:
        require_safe_listening_endpoint(
            connection.endpoint, "endpoint", insecure=connection.insecure
        )
        raise_open_file_limit(MAX_OPEN_FILES)
        receiving_threads = ROUTER_RECEIVING_THREADS
        open_for_images = None
    else:
        receiving_threads = CLIENT_RECEIVING_THREADS
        open_for_images = partial(open_zenoh, connection, connect_timeout_s, configure_for_images)
    with limit_receiving_threads(receiving_threads):
        session = Session(open_zenoh(connection, connect_timeout_s), open_for_images)
    with closing(session):
        yield session


def normalize_key_expression(text: str) -> str:
    """Return a key that may have wildcards in Zenoh's canonical form.

    Raises:
        ConfigError: The text is not a key.
    """
    try:
        return str(zenoh.KeyExpr.autocanonize(text))
    except zenoh.ZError as error:
        raise ConfigError(
            f"{text!r} is not a key: {str(error).split(' at /')[0]}; valid are such as sensor/joints, sensor/* and **",
            code="network/unknown-key",
        ) from None


def key_expressions_intersect(pattern: str, key: str) -> bool:
    """Return whether two key expressions match a common key."""
    return zenoh.KeyExpr(pattern).intersects(zenoh.KeyExpr(key))


def _choose_priority(key: str, message: type[Message]) -> zenoh.Priority:
    """Return the priority of a stream: commands first, then data, images, and previews of images."""
    if message in IMAGE_MESSAGE_TYPES:
        return zenoh.Priority.DATA_LOW
    if message is ImagePreview:
        return zenoh.Priority.BACKGROUND
    if key == keys.JOINT_COMMAND:
        return zenoh.Priority.REAL_TIME
    return zenoh.Priority.DATA_HIGH


def _make_last_value_history() -> ext.HistoryConfig:
    """Return the history of a latched key: the last value, also of a publisher that appears later."""
    return ext.HistoryConfig(detect_late_publishers=True, max_samples=1)


def _make_arrival_handler(
    handler: Callable[[ReceivedSample], None],
) -> Callable[[zenoh.Sample], None]:
    """Return a handler for Zenoh's thread that passes each sample to `handler` as an `ReceivedSample`."""

    def handle(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        payload = sample.payload.to_bytes()
        encoding = str(sample.encoding)
        handler(ReceivedSample(key, payload, encoding, time.monotonic_ns()))

    return handle


def _make_handler_with_thread_state(
    handle: Callable[[zenoh.Sample], None],
) -> Callable[[zenoh.Sample], None]:
    """Return a handler that keeps Python's state of Zenoh's thread from one sample to the next.

    Otherwise Python creates that state, and a stack, again for each sample, which in the kernel costs twice what a
    sample costs otherwise.
    """
    prepared = threading.local()

    def handle_with_state(sample: zenoh.Sample) -> None:
        if not hasattr(prepared, "state"):
            prepared.state = ctypes.pythonapi.PyGILState_Ensure()  # never released, on purpose
        handle(sample)

    return handle_with_state
