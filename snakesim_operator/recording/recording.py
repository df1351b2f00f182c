"""One MCAP file: the wire bytes of every message with their schema, as they arrive.

A channel is a key, its messages the payloads verbatim (encoding `msgpack`), its schema the published JSON Schema, its
metadata the encoding on the wire. `log_time` is robot time, `publish_time` the wall clock at the recorder, `sequence`
counts the arrivals at a key. A chunk is written at least every FLUSH_S, so that a killed recorder lacks no more.
"""

import json
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec

from snakesim_hal.model.files import SCHEMAS
from snakesim_hal.network.session import Arrival
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.own_sample import OwnKind, own_kinds
from snakesim_operator.recording.disk import GrowingFile
from snakesim_operator.recording.foxglove import FoxgloveChannels, FoxgloveMessage, schema_of
from snakesim_operator.recording.mcap_file import McapFile
from snakesim_operator.recording.robot_time import RobotTime

FLUSH_S = 0.5
MAX_EARLY = 1000  # samples of own sensors before the description; what is more is written without its own schema
ABOUT = "snakesim"  # the name of the metadata record
COPIED = "lacked_before_copy"  # in it: what the recording lacked that this one was copied from

Show = Callable[[FoxgloveMessage, int], None]  # and the robot time in ns


class Recording:
    """A file that is written. A disk that takes no more ends it, and nothing else."""

    def __init__(self, path: Path, shown_as: str | None = None, show: Show | None = None) -> None:
        """Raises OSError, FileExistsError when there is such a file.

        shown_as: the robot's name in topics for viewers; None: only the messages as on the wire, and no such topics.
        show: gets what is made for viewers, too.
        """
        self.path = path
        self._show = show
        self.failure = ""  # why nothing is written any more
        self.counts: Counter[str] = Counter()  # messages written, by key
        self.time = RobotTime()
        self._foxglove = None if shown_as is None else FoxgloveChannels(shown_as)
        self._shown: Counter[str] = Counter()  # messages made for Foxglove, by topic
        self._file = GrowingFile(path)
        self._mcap = McapFile(self._file)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._own: dict[str, OwnKind] = {}
        self._early: list[Arrival] | None = []  # of own sensors, until the description says what they are; None: it has
        self._flush_at = 0.0
        self._wall_ns = time.time_ns() - time.monotonic_ns()
        self.flush()

    def take(self, arrival: Arrival) -> None:
        """Write one message. Those that are not at a key of the key space are left out."""
        if self.failure:
            return
        if self._early is not None and keys.row_key(arrival.key) == keys.OWN_ALL and len(self._early) < MAX_EARLY:
            self._early.append(arrival)
            return
        self._write(arrival)
        if arrival.key == keys.DESCRIPTION:
            self._write_early()

    def _write_early(self) -> None:
        early, self._early = self._early or (), None
        for arrival in early:
            self._write(arrival)

    def _write(self, arrival: Arrival) -> None:
        if arrival.key == keys.DESCRIPTION:
            with suppress(*UNDECODABLE):
                self._own = own_kinds(msgspec.msgpack.decode(arrival.payload, type=Description))
        channel = self._channels.get(arrival.key)
        if channel is None and (channel := self._open(arrival)) is None:
            return
        at_ns = self.time.of(arrival.key, arrival.payload)
        self.counts[arrival.key] += 1
        wall_ns = arrival.monotonic_ns + self._wall_ns
        self._mcap.add(channel, at_ns, wall_ns, self.counts[arrival.key], arrival.payload)
        if self._foxglove is None:
            return
        for shown in self._foxglove.take(arrival.key, arrival.payload, at_ns):
            self._shown[shown.topic] += 1
            channel = self._channels.get(shown.topic) or self._open_shown(shown)
            self._mcap.add(channel, at_ns, wall_ns, self._shown[shown.topic], shown.payload)
            if self._show is not None:
                self._show(shown, at_ns)

    def flush_when_due(self) -> None:
        """Write what waits, a few times a second."""
        if not self.failure and time.monotonic() >= self._flush_at:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        self._flush_at = time.monotonic() + FLUSH_S
        try:
            self._mcap.flush()
        except OSError as error:
            self.failure = f"{self.path}: {error.strerror or error}"

    def close(self, about: dict[str, object]) -> None:
        """Write index and metadata. about: of the recording itself, kept as JSON."""
        self._write_early()
        if not self.failure:
            self._mcap.add_metadata(ABOUT, {name: json.dumps(value) for name, value in about.items()})
            try:
                self._mcap.finish()
            except OSError as error:
                self.failure = f"{self.path}: {error.strerror or error}"
        self._file.close()

    def _open_shown(self, shown: FoxgloveMessage) -> int:
        name, message_encoding, encoding, data = schema_of(shown.kind)
        if name not in self._schemas:
            self._schemas[name] = self._mcap.add_schema(name, encoding, data)
        channel = self._mcap.add_channel(shown.topic, message_encoding, self._schemas[name])
        self._channels[shown.topic] = channel
        return channel

    def _open(self, arrival: Arrival) -> int | None:
        message = keys.message_at(arrival.key)
        if message is None:
            return None
        name = message.__name__
        if (own := self._own.get(arrival.key)) is not None:
            name, content = f"own.{own.message.__name__}", own.schema.encode()
        elif name in self._schemas:
            content = b""
        else:
            content = (SCHEMAS / "messages" / f"{name}.json").read_bytes()
        schema = name if own is None else own.schema  # two authors may have one name
        if schema not in self._schemas:
            self._schemas[schema] = self._mcap.add_schema(f"snakesim.{name}", "jsonschema", content)
        metadata = {"encoding": arrival.encoding[:200]}
        channel = self._channels[arrival.key] = self._mcap.add_channel(
            arrival.key, "msgpack", self._schemas[schema], metadata
        )
        return channel
