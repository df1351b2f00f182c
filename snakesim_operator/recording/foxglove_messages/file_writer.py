"""Writes the messages for viewers, which are made of the robot's messages, into an MCAP file."""

from collections import Counter
from collections.abc import Callable

from snakesim_operator.recording.foxglove_messages.converter import FoxgloveConverter
from snakesim_operator.recording.foxglove_messages.topics import FoxgloveMessage, make_schema
from snakesim_operator.recording.log_clock import LogTimeClock, with_log_time_clock
from snakesim_operator.recording.mcap_format.file_writer import McapFileWriter

# Called with a message for viewers, and its log time in ns.
OnViewerMessage = Callable[[FoxgloveMessage, int], None]


class ViewerMessageWriter:
    """Converts the robot's messages into messages for viewers, and writes them into one MCAP file."""

    def __init__(
        self,
        mcap: McapFileWriter,
        robot_name: str,
        log_time_clock: LogTimeClock,
        on_viewer_message: OnViewerMessage | None = None,
    ) -> None:
        """Start without a topic.

        Args:
            mcap: Writer of the file.
            robot_name: Name of the robot in the viewer topics.
            log_time_clock: Clock of the file's log times, and of the timestamps in the messages.
            on_viewer_message: Called with each message that is written, and its log time. None if not needed.
        """
        self._mcap = mcap
        self._converter = FoxgloveConverter(robot_name)
        self._log_time_clock: LogTimeClock = log_time_clock
        self._on_viewer_message = on_viewer_message
        self._channel_id_by_topic: dict[str, int] = {}  # channel numbers by topic
        self._schema_id_by_name: dict[str, int] = {}  # schema numbers by name
        self._message_count_by_topic: Counter[str] = Counter()  # messages written, by topic

    def write(self, key: str, payload: bytes, log_time_ns: int, publish_time_ns: int) -> int:
        """Convert one message of the robot into messages for viewers, and write these.

        Args:
            key: Key of the robot's message.
            payload: The encoded message of the robot.
            log_time_ns: Time of the message by the clock of the file's log times.
            publish_time_ns: Time of the message by the other one of robot clock and wall clock.

        Returns:
            The number of messages written; often 0, because drawings are made at fixed periods.
        """
        messages = self._converter.convert(key, payload, log_time_ns)
        for message in messages:
            channel_id = self._channel_id_by_topic.get(message.topic)
            if channel_id is None:
                channel_id = self._open_channel(message)
            self._message_count_by_topic[message.topic] += 1
            self._mcap.add_message(
                channel_id,
                log_time_ns,
                publish_time_ns,
                self._message_count_by_topic[message.topic],
                message.payload,
            )
            if self._on_viewer_message is not None:
                self._on_viewer_message(message, log_time_ns)
        return len(messages)

    def _open_channel(self, message: FoxgloveMessage) -> int:
        """Add the channel of a message to the file, with its schema if that is new, and return the channel's id."""
        schema = make_schema(message.message_type)
        if schema.name not in self._schema_id_by_name:
            self._schema_id_by_name[schema.name] = self._mcap.add_schema(
                schema.name, schema.schema_encoding, schema.data
            )
        schema_id = self._schema_id_by_name[schema.name]
        metadata = with_log_time_clock({}, self._log_time_clock)
        channel_id = self._mcap.add_channel(
            message.topic, schema.message_encoding, schema_id, metadata
        )
        self._channel_id_by_topic[message.topic] = channel_id
        return channel_id
