"""Writes one MCAP file: every message as it was on the wire, with its schema, in the order of arrival.

A channel is a key. Its messages are the payloads without change (encoding `msgpack`), its schema is the published JSON
Schema, its metadata has the encoding on the wire. `log_time` is robot time, `publish_time` is the wall clock at the
recorder, `sequence` counts the arrivals at a key. A chunk is written at least every FLUSH_S, so that a recorder that
is killed loses no more than that.
"""

import json
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import msgspec

from snakesim_hal.model.files import SCHEMAS_DIR
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.recording.buffered_file import GrowingFile
from snakesim_operator.recording.foxglove_messages.file_writer import (
    OnViewerMessage,
    ViewerMessageWriter,
)
from snakesim_operator.recording.log_clock import LogTimeClock, order_times, with_log_time_clock
from snakesim_operator.recording.mcap_format.file_writer import METADATA_NAME, McapFileWriter
from snakesim_operator.recording.robot_time import MessageClock

FLUSH_S = 0.5
# Of custom sensors before the description; further ones get no schema of their own.
MAX_EARLY_CUSTOM_SAMPLES = 1000
MAX_ENCODING_NAME_CHARACTERS = 200  # characters; it comes from the network


class RecordingWriter:
    """Writes one recording. A full disk ends the writing: `failure` then has the reason, and no error is raised."""

    def __init__(
        self,
        path: Path,
        viewer_robot_name: str | None = None,
        on_viewer_message: OnViewerMessage | None = None,
        log_time_clock: LogTimeClock = "robot",
    ) -> None:
        """Create an MCAP file for a robot's messages, and write its beginning.

        Args:
            path: The new file.
            viewer_robot_name: The robot's name in topics for viewers; None: record only the messages as on the wire.
            on_viewer_message: Gets each message that is made for viewers.
            log_time_clock: The clock of the log times.

        Raises:
            OSError: The file cannot be created; FileExistsError if it exists.
        """
        self.path = path
        self._log_time_clock: LogTimeClock = log_time_clock
        self.failure = ""  # why nothing is written any more
        self.message_clock = MessageClock()
        # Wall clock minus monotonic clock.
        self._wall_offset_ns = time.time_ns() - time.monotonic_ns()

        # The file.
        self._file = GrowingFile(path)
        self._mcap = McapFileWriter(self._file)
        self._channel_id_by_key: dict[str, int] = {}  # channel numbers, by key
        # Ids of the schemas in the file, by name; by text if custom.
        self._schema_id_by_name: dict[str, int] = {}
        self._next_flush_s = 0.0

        # The robot's messages.
        self.counts: Counter[str] = Counter()  # messages written, by key
        self._custom_message_by_key: dict[str, CustomMessage] = {}
        # Of custom sensors; None once the description is known.
        self._early_custom_samples: list[ReceivedSample] | None = []

        # Messages made for viewers.
        self._viewer_messages: ViewerMessageWriter | None = None
        if viewer_robot_name is not None:
            self._viewer_messages = ViewerMessageWriter(
                self._mcap, viewer_robot_name, log_time_clock, on_viewer_message
            )

        self.flush()

    def write_arrival(self, arrival: ReceivedSample) -> None:
        """Write one message of the robot, unless its key is not in the key space.

        A custom sensor's sample that comes before the robot's description is kept until the description arrives,
        because only the description has the schema of the sample.
        """
        if self.failure:
            return
        early_samples = self._early_custom_samples
        if (
            early_samples is not None
            and keys.find_row_key(arrival.key) == keys.CUSTOM_ALL
            and len(early_samples) < MAX_EARLY_CUSTOM_SAMPLES
        ):
            early_samples.append(arrival)
            return
        self._write_message(arrival)
        if arrival.key == keys.DESCRIPTION:
            self._write_early_custom_samples()

    def flush_when_due(self) -> None:
        """Write the buffered messages to the disk, if the last flush was at least FLUSH_S ago."""
        if not self.failure and time.monotonic() >= self._next_flush_s:
            self.flush()

    def flush(self) -> None:
        """Write the buffered messages to the disk. An error of the disk ends the writing; see `failure`."""
        self._next_flush_s = time.monotonic() + FLUSH_S
        try:
            self._mcap.flush()
        except OSError as error:
            self._set_failure(error)

    def close(self, metadata: dict[str, object]) -> None:
        """Write metadata and index, and close the file.

        Args:
            about: Metadata of the recording itself by name, which is stored as JSON.
        """
        self._write_early_custom_samples()
        if not self.failure:
            self._mcap.add_metadata(
                METADATA_NAME, {name: json.dumps(value) for name, value in metadata.items()}
            )
            try:
                self._mcap.finish_file()
            except OSError as error:
                self._set_failure(error)
        self._file.close()

    def _set_failure(self, error: OSError) -> None:
        self.failure = f"{self.path}: {error.strerror or error}"

    def _write_early_custom_samples(self) -> None:
        early = self._early_custom_samples or []
        self._early_custom_samples = None
        for arrival in early:
            self._write_message(arrival)

    def _write_message(self, arrival: ReceivedSample) -> None:
        """Write one message, and the messages for viewers that are made from it."""
        if arrival.key == keys.DESCRIPTION:
            with suppress(*UNDECODABLE):
                self._custom_message_by_key = find_custom_messages(
                    msgspec.msgpack.decode(arrival.payload, type=RobotDescription)
                )
        channel_id = self._channel_id_by_key.get(arrival.key)
        if channel_id is None:
            channel_id = self._open_channel(arrival)
        if channel_id is None:
            return
        robot_time_ns = self.message_clock.find_robot_time_ns(arrival.key, arrival.payload)
        wall_time_ns = arrival.monotonic_ns + self._wall_offset_ns
        log_time_ns, publish_time_ns = order_times(
            robot_time_ns, wall_time_ns, self._log_time_clock
        )
        self.counts[arrival.key] += 1
        self._mcap.add_message(
            channel_id, log_time_ns, publish_time_ns, self.counts[arrival.key], arrival.payload
        )
        if self._viewer_messages is not None:
            self._viewer_messages.write(arrival.key, arrival.payload, log_time_ns, publish_time_ns)

    def _open_channel(self, arrival: ReceivedSample) -> int | None:
        """Add a channel for the key of a message, with its schema, to the file.

        Returns:
            The id of the channel, or None if the key is not in the key space.
        """
        message_type = keys.find_message(arrival.key)
        if message_type is None:
            return None
        custom_type = self._custom_message_by_key.get(arrival.key)
        if custom_type is None:
            schema_id = self._add_published_schema(message_type.__name__)
        else:
            schema_id = self._add_custom_schema(custom_type)
        metadata = with_log_time_clock(
            {"encoding": arrival.encoding[:MAX_ENCODING_NAME_CHARACTERS]}, self._log_time_clock
        )
        channel_id = self._mcap.add_channel(arrival.key, "msgpack", schema_id, metadata)
        self._channel_id_by_key[arrival.key] = channel_id
        return channel_id

    def _add_published_schema(self, name: str) -> int:
        """Return the id of a message's published schema, which is added to the file when it is first needed."""
        if name not in self._schema_id_by_name:
            content = (SCHEMAS_DIR / "messages" / f"{name}.json").read_bytes()
            self._schema_id_by_name[name] = self._mcap.add_schema(
                f"snakesim.{name}", "jsonschema", content
            )
        return self._schema_id_by_name[name]

    def _add_custom_schema(self, custom_type: CustomMessage) -> int:
        """Return the id of a custom message's schema, which is added to the file when it is first needed.

        Schemas are distinguished by their text, because two authors may choose the same name.
        """
        text = custom_type.schema
        if text not in self._schema_id_by_name:
            name = f"snakesim.custom.{custom_type.message.__name__}"
            self._schema_id_by_name[text] = self._mcap.add_schema(name, "jsonschema", text.encode())
        return self._schema_id_by_name[text]
