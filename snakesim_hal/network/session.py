"""The Zenoh session: explicit endpoints, no scouting, one namespace a robot, and the quality of service per kind.

Without a router of its own, all loopback sessions of a robot connect to its HAL host: the host listens (mode
`router`), and everything else connects to it (mode `client`). Zenoh peers do not forward for one another unless gossip
introduces them, and gossip is off here. With `--router` the host too is a client of the lab's router.
"""

import ctypes
import json
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic

import msgspec
import zenoh
from zenoh import ext, handlers  # pyright: ignore[reportMissingModuleSource]

from snakesim_hal.base.errors import ConfigError, NotConnectedError, WireError
from snakesim_hal.base.process import raise_open_files
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT, check_guarded, check_loopback
from snakesim_hal.network.image_connection import configure_for_images, set_unless_given
from snakesim_hal.network.session_file import SessionFile
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import IMAGES, MAX_PAYLOAD_BYTES, Decoder, MessageT, encode, encoding_of
from snakesim_hal.wire.messages import Answer, Message, Preview

ENVELOPE_BYTES = 4096  # around a payload: key, encoding, and the numbers of an image
# Of every session, whatever its session file says.
OURS: dict[str, Any] = {
    "scouting/delay": 0,
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "timestamping/enabled": {"router": True, "peer": True, "client": True},
    "transport/shared_memory/enabled": False,
    "listen/exit_on_failure": True,
    "connect/exit_on_failure": True,
    "connect/retry": {"period_init_ms": 50, "period_max_ms": 250, "period_increase_factor": 1.5},
}
# A session file may have others for its own network, such as a longer lease on a bad link.
UNLESS_GIVEN: dict[str, Any] = {
    # Connections that stay silent are closed after a second, and many of them are allowed.
    "transport/unicast/accept_timeout": 1000,
    "transport/unicast/accept_pending": 1000,
    "transport/unicast/max_sessions": 4000,
    "transport/link/tx/lease": 2000,
    # A subscriber that does not read loses samples after 0.1 ms (Zenoh's default is 1 ms), so that ten of them hardly
    # delay a writer. With less, bursts to good subscribers are lost: at 0 ms, two thirds of six express messages in a
    # row.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 100,
}
# Closing a frozen subscriber blocks a receiving thread of Zenoh, and by default it has two: three subscribers that
# froze together blocked the controller's commands for long enough to end its lease.
# A client has one connection to read; with two threads each message would wake both. With Zenoh's `handover: app` none
# is woken, but an image link that is full then ends the lease of control.
RECEIVERS_LISTENING, RECEIVERS_CONNECTED = 16, 1
RUNTIME = "ZENOH_RUNTIME"
_environment = threading.Lock()
_opening: list[int] = []  # sessions that are being opened
MAX_OPEN_FILES = 16384  # each connection takes one, and the default limit of a process is 1024
READER_DEPTH = 256  # so that a burst of noise on a key does not displace the valid sample
IMAGES_DEPTH = 32  # of images, which take much memory; in lockstep a reader may lag by that many


@dataclass(frozen=True)
class Link:
    """How a process connects to the robot's network."""

    endpoint: str = DEFAULT_ENDPOINT
    namespace: str | None = None  # None: the whole network, for tools that search for robots
    listen: bool = False  # True: listen on the endpoint; False: connect to it
    insecure: bool = False  # True: listen even where other machines can connect
    max_bytes: int = MAX_PAYLOAD_BYTES  # of a payload; longer ones cost neither memory nor time
    session: SessionFile | None = None  # how to connect; `endpoint` is then the first one in it

    @staticmethod
    def of_file(session: SessionFile, namespace: str | None = None) -> "Link":
        """As a session file says. Raises ConfigError when it is for another namespace."""
        return Link(session.endpoints[0], session.namespace_for(namespace), session=session)


class Arrival(msgspec.Struct, frozen=True):
    """A received sample, not decoded yet."""

    key: str
    payload: bytes
    encoding: str
    monotonic_ns: int


class Publisher(Generic[MessageT]):
    """Puts one message type on one key."""

    def __init__(self, message: type[MessageT], send: Callable[[bytes], None], heard: Callable[[], bool]) -> None:
        """send: sends bytes as they are, bypassing any reroute; heard: whether anybody subscribes to it now."""
        self.message = message
        self.send, self.heard = send, heard
        self._put = send

    def put(self, message: MessageT, encoded: bytes | None = None) -> None:
        """Send it; waits for a slow subscriber only when the publisher was declared lossless. encoded: its bytes."""
        self._put(encode(message) if encoded is None else encoded)

    def reroute(self, put: Callable[[bytes], None] | None) -> None:
        """Pass payloads to `put` instead of sending them; None: send directly again."""
        self._put = self.send if put is None else put


class Reader(Generic[MessageT]):
    """The newest samples of one key, decoded on request, in the caller's thread."""

    def __init__(self, subscriber: Any, message: type[MessageT], rejected: Counter[str]) -> None:
        self.subscriber = subscriber
        self._decoder = Decoder(message)
        self._rejected = rejected

    def drain(self) -> list[MessageT]:
        """All samples since the last call, oldest first. Those that cannot be decoded are counted and dropped."""
        return [message for sample in self._arrived() if (message := self._decoded(sample)) is not None]

    def newest(self, wanted: Callable[[MessageT], bool]) -> MessageT | None:
        """The newest sample since the last call for which `wanted` is true.

        Earlier ones are dropped without decoding, so that a flood costs little.
        """
        for sample in reversed(self._arrived()):
            message = self._decoded(sample)
            if message is not None and wanted(message):
                return message
        return None

    def _arrived(self) -> list[Any]:
        arrived: list[Any] = []
        while (sample := self.subscriber.try_recv()) is not None:
            arrived.append(sample)
        return arrived

    def _decoded(self, sample: Any) -> MessageT | None:
        try:
            return self._decoder.decode(*self._content(sample))
        except WireError as error:
            self._rejected[error.reason] += 1
            return None

    def _content(self, sample: Any) -> tuple[bytes, str]:
        """Payload and encoding."""
        return sample.payload.to_bytes(), str(sample.encoding)


@dataclass(frozen=True)
class Question:
    """A query that waits for its answer."""

    key: str
    payload: bytes
    encoding: str
    _query: Any

    def reply(self, answer: Answer) -> None:
        """Answer and close it."""
        self._query.reply(self.key, encode(answer), encoding=encoding_of(Answer))
        self._query.drop()


class Session:
    """A Zenoh session, as SnakeSIM uses it. Open one with `open_session`."""

    def __init__(self, zenoh_session: Any, open_for_images: Callable[[], Any] | None = None) -> None:
        """open_for_images: opens a connection for images alone; None: they take the one of everything else."""
        self._zenoh, self._is_part = zenoh_session, False
        self._open_for_images, self._for_images = open_for_images, None
        self._declared: list[Any] = []
        self._publishers: dict[str, Publisher[Any]] = {}
        self._reroutes: dict[str, Callable[[bytes], None]] = {}
        self.rejected: Counter[str] = Counter()  # samples that could not be decoded, by reason

    def publisher(self, key: str, message: type[MessageT], *, lossless: bool = False) -> Publisher[MessageT]:
        """A publisher for a stream. Lossless waits for slow subscribers (lockstep); otherwise samples are dropped."""
        command = key == keys.JOINT_COMMAND
        # The last message of a tick is sent at once, batched with those put just before it: one packet instead of five.
        ends_a_tick = command or key == keys.CLOCK or key.startswith(keys.done(""))
        priority = zenoh.Priority.REAL_TIME if command else zenoh.Priority.DATA_HIGH
        if message in IMAGES:
            priority = zenoh.Priority.DATA_LOW
        elif message is Preview:
            priority = zenoh.Priority.BACKGROUND
        # In lockstep a clock must not overtake the images that it names.
        session = self._images_session() if message in IMAGES and not lossless else self._zenoh
        publisher = session.declare_publisher(
            key,
            encoding=encoding_of(message),
            congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
            priority=priority,
            express=ends_a_tick,
        )
        return self._published(key, publisher, message)

    def _images_session(self) -> Any:
        if self._open_for_images is None:
            return self._zenoh
        if self._for_images is None:
            self._for_images = self._open_for_images()
        return self._for_images

    def latched_publisher(self, key: str, message: type[MessageT]) -> Publisher[MessageT]:
        """A publisher whose last value is sent to later subscribers."""
        publisher = ext.declare_advanced_publisher(
            self._zenoh,
            key,
            encoding=encoding_of(message),
            cache=ext.CacheConfig(1),
            publisher_detection=True,
        )
        return self._published(key, publisher, message)

    def _published(self, key: str, publisher: Any, message: type[MessageT]) -> Publisher[MessageT]:
        self._declared.append(publisher)
        made = Publisher(message, publisher.put, lambda: bool(publisher.matching_status.matching))
        return self._routed(key, made)

    def _routed(self, key: str, made: Publisher[MessageT]) -> Publisher[MessageT]:
        self._publishers[key] = made
        made.reroute(self._reroutes.get(key))
        return made

    def reroute(self, key: str, put: Callable[[bytes], None] | None) -> None:
        """Pass payloads of a key's present and future publishers to `put`; None: send them directly again."""
        if put is None:
            self._reroutes.pop(key, None)
        else:
            self._reroutes[key] = put
        if key in self._publishers:
            self._publishers[key].reroute(put)

    def send(self, key: str, payload: bytes) -> None:
        """Send raw bytes on a key that this session publishes on, bypassing any reroute."""
        self._publishers[key].send(payload)

    def reader(self, key: str, message: type[MessageT], *, depth: int | None = None) -> Reader[MessageT]:
        """The newest `depth` samples of a stream; older ones are dropped, nothing ever blocks."""
        subscriber = self._zenoh.declare_subscriber(key, handlers.RingChannel(depth or depth_of(message)))
        self._declared.append(subscriber)
        return Reader(subscriber, message, self.rejected)

    def latched_reader(self, key: str, message: type[MessageT]) -> Reader[MessageT]:
        """Like `reader`, and it also gets the value that was latched before."""
        subscriber = ext.declare_advanced_subscriber(
            self._zenoh,
            key,
            handlers.RingChannel(READER_DEPTH),
            history=_last_value(),
        )
        self._declared.append(subscriber)
        return Reader(subscriber, message, self.rejected)

    def stop_reading(self, reader: Reader[Any]) -> None:
        """Close a reader that is no longer used."""
        self._declared.remove(reader.subscriber)
        reader.subscriber.undeclare()

    def latest(
        self,
        key: str,
        message: type[MessageT],
        timeout_s: float,
        wanted: Callable[[MessageT], bool] = lambda _message: True,
    ) -> MessageT | None:
        """The value latched on a key (for which `wanted` is true); None when there is none in time."""
        reader, deadline = self.latched_reader(key, message), time.monotonic() + timeout_s
        while (found := reader.newest(wanted)) is None and time.monotonic() < deadline:
            time.sleep(0.01)
        self.stop_reading(reader)
        return found

    def on_arrival(self, key: str, take: Callable[[Arrival], None]) -> None:
        """Call `take` for every sample, in a thread of this subscriber: it must only store the sample."""
        self._declared.append(self._zenoh.declare_subscriber(key, _storing(take)))

    def on_urgent_arrival(self, key: str, take: Callable[[Arrival], None]) -> None:
        """The same in the thread that receives for the whole session: one thread less to wake, in the loop's way."""
        direct = handlers.Callback(_in_zenohs_thread(_storing(take)), indirect=False)
        self._declared.append(self._zenoh.declare_subscriber(key, direct))

    def on_latched_arrival(self, key: str, take: Callable[[Arrival], None]) -> None:
        """Like `on_arrival`, and it also gets the values that were latched before."""
        self._declared.append(ext.declare_advanced_subscriber(self._zenoh, key, _storing(take), history=_last_value()))

    def on_question(self, key: str, take: Callable[[Question], None]) -> None:
        """Call `take` for every query, in Zenoh's thread; answer it from your own."""

        def handle(query: zenoh.Query) -> None:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            # The query's own key may be a pattern, such as `hal/*`; the question is always for our key.
            take(Question(key, payload, str(query.encoding or ""), query))

        self._declared.append(self._zenoh.declare_queryable(key, handle))

    def ask(self, key: str, request: Message, timeout_s: float = 2.0, *, host: str | None = None) -> Answer:
        """Send a request to the HAL, and wait for the answer. Raises NotConnectedError when there is none.

        host: id of the addressed host process; answers of others are ignored. None: the first answer is taken.
        """
        unreadable: WireError | None = None
        for _, answer in self._answers(key, request, timeout_s):
            if isinstance(answer, WireError):
                unreadable = answer
            elif host is None or answer.host == host:
                return answer
        if unreadable is not None:
            raise NotConnectedError(f"the answer on {key} cannot be decoded: {unreadable}")
        raise NotConnectedError(f"no answer on {key} within {timeout_s} s; is the robot's HAL host running?")

    def ask_all(self, pattern: str, request: Message, timeout_s: float = 2.0) -> Iterator[tuple[str, Answer]]:
        """Query all matching keys at once: (key, answer) as they come, until all answered or time is up."""
        answers = self._answers(pattern, request, timeout_s)
        return ((at, answer) for at, answer in answers if isinstance(answer, Answer))

    def _answers(self, pattern: str, request: Message, timeout_s: float) -> Iterator[tuple[str, Answer | WireError]]:
        """All answers with their keys; undecodable ones are counted. No answer replaces another."""
        replies = self._zenoh.get(
            pattern,
            payload=encode(request),
            encoding=encoding_of(type(request)),
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        decoder = Decoder(Answer)
        for reply in replies:
            if reply.ok is None:
                continue
            try:
                yield str(reply.ok.key_expr), decoder.decode(reply.ok.payload.to_bytes(), str(reply.ok.encoding))
            except WireError as error:
                self.rejected[error.reason] += 1
                yield str(reply.ok.key_expr), error

    def present(self, pattern: str, timeout_s: float = 1.0) -> list[str]:
        """The liveliness keys that match now."""
        replies = self._zenoh.liveliness().get(pattern, timeout=timeout_s)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def declare_alive(self, service: str) -> None:
        """Declare the liveliness token of a service for as long as the session lives."""
        self.declare_token(keys.alive(service))

    def declare_token(self, key: str) -> None:
        """Declare a liveliness token for as long as the session lives."""
        self._declared.append(self._zenoh.liveliness().declare_token(key))

    def on_alive(self, take: Callable[[str, bool], None], key: str = keys.ALIVE_ALL) -> None:
        """Call `take(key, present)` when a service appears or vanishes, in Zenoh's thread."""

        def handle(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self._zenoh.liveliness().declare_subscriber(key, handle, history=True))

    def part(self) -> "Session":
        """Another session over the same connection; closing it ends only what it has declared."""
        part = Session(self._zenoh)
        part._is_part = True
        return part

    def close(self) -> None:
        """Undeclare everything, then close."""
        for declared in reversed(self._declared):
            with suppress(RuntimeError):  # another thread is publishing with it: the session undeclares it
                declared.undeclare()
        self._declared.clear()
        if self._for_images is not None:
            self._for_images.close()
        if not self._is_part:
            self._zenoh.close()


def depth_of(message: type[Message]) -> int:
    """How many samples of a stream a reader keeps."""
    return IMAGES_DEPTH if message in IMAGES else READER_DEPTH


def _last_value() -> ext.HistoryConfig:
    """History of a latched key: the last value, also of a publisher that appears later."""
    return ext.HistoryConfig(detect_late_publishers=True, max_samples=1)


def _storing(take: Callable[[Arrival], None]) -> Callable[[zenoh.Sample], None]:
    def handle(sample: zenoh.Sample) -> None:
        payload, encoding = sample.payload.to_bytes(), str(sample.encoding)
        take(Arrival(str(sample.key_expr), payload, encoding, time.monotonic_ns()))

    return handle


def _in_zenohs_thread(handle: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Sample], None]:
    known = threading.local()

    def direct(sample: zenoh.Sample) -> None:
        if not hasattr(known, "state"):
            # Keep what Python has of this thread; else it makes that, and a stack, again for each sample, which in the
            # kernel costs twice what a sample costs otherwise.
            known.state = ctypes.pythonapi.PyGILState_Ensure()
        handle(sample)

    return direct


def key_expression(text: str) -> str:
    """A key that may have wildcards, in Zenoh's canonical form. Raises ConfigError."""
    try:
        return str(zenoh.KeyExpr.autocanonize(text))
    except zenoh.ZError as error:
        raise ConfigError(
            f"{text!r} is not a key: {str(error).split(' at /')[0]}; valid are such as sensor/joints, sensor/* and **"
        ) from None


def intersects(pattern: str, key: str) -> bool:
    """Whether two key expressions have a key in common."""
    return zenoh.KeyExpr(pattern).intersects(zenoh.KeyExpr(key))


@contextmanager
def open_session(link: Link, connect_timeout_s: float = 5.0) -> Iterator[Session]:
    """Connect to the network.

    Raises:
        NotConnectedError: the endpoint does not answer, or cannot be listened on.
        RefusedError: the endpoint is on loopback, and that interface is down.
    """
    if link.listen:
        check_guarded(link.endpoint, "endpoint", insecure=link.insecure)
        raise_open_files(MAX_OPEN_FILES)
    for_images = None if link.listen else partial(open_zenoh, link, connect_timeout_s, configure_for_images)
    with _receiving_threads(RECEIVERS_LISTENING if link.listen else RECEIVERS_CONNECTED):
        session = Session(open_zenoh(link, connect_timeout_s), for_images)
    with closing(session):
        yield session


@contextmanager
def _receiving_threads(count: int) -> Iterator[None]:
    """How many threads Zenoh gets to receive with, in this process but not in its children, unless the user says so.

    Any number of threads may open sessions at once; Zenoh reads the variable at the first one.
    """
    with _environment:
        ours = bool(_opening) or RUNTIME not in os.environ
        if ours:
            _opening.append(count)
            os.environ.setdefault(RUNTIME, f"(rx: (worker_threads: {count}))")
    try:
        yield
    finally:
        if ours:
            with _environment:
                _opening.remove(count)
                if not _opening:
                    del os.environ[RUNTIME]


def _config(link: Link, connect_timeout_s: float) -> zenoh.Config:
    """What Zenoh is opened with: a session file's settings if there is one, and ours on top."""
    if link.session is not None:
        config = zenoh.Config.from_json5(link.session.text)
    else:
        config = zenoh.Config()
        config.insert_json5("mode", json.dumps("router" if link.listen else "client"))
        for verb, does in (("listen", link.listen), ("connect", not link.listen)):
            config.insert_json5(f"{verb}/endpoints", json.dumps([link.endpoint] if does else []))
    settings = {**OURS, "connect/timeout_ms": round(connect_timeout_s * 1000)}
    if link.namespace is not None:
        settings["namespace"] = link.namespace
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    largest = {"transport/link/rx/max_message_size": link.max_bytes + ENVELOPE_BYTES}
    set_unless_given(config, UNLESS_GIVEN | largest)
    return config


def open_zenoh(
    link: Link, connect_timeout_s: float, change: Callable[[zenoh.Config], None] | None = None
) -> zenoh.Session:
    """The session under a `Session`. change: what is different for this one. Raises as `open_session`."""
    if link.session is None:  # a session file may name other endpoints, too
        check_loopback(link.endpoint)
    zenoh.init_log_from_env_or("off")
    config = _config(link, connect_timeout_s)
    if change is not None:
        change(config)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        if link.listen:
            raise NotConnectedError(
                f"cannot listen on {link.endpoint}: {str(error).split(' at /')[0]}. Another run may hold the port; "
                f"choose one with --endpoint tcp/127.0.0.1:PORT"
            ) from error
        if link.session is not None:
            raise NotConnectedError(
                f"nothing on {', '.join(link.session.endpoints)} lets {link.session.path} in: no router runs there, or "
                f"it does not accept the certificate; RUST_LOG=zenoh=warn says more"
            ) from error
        raise NotConnectedError(f"nothing listens on {link.endpoint}; start a run or a router there first") from error
