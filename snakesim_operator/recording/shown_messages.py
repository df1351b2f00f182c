"""Writes the messages for viewers, which are made of the robot's messages, into an MCAP file."""

from collections import Counter
from collections.abc import Callable

from snakesim_operator.recording.foxglove import FoxgloveChannels
from snakesim_operator.recording.foxglove_topics import FoxgloveMessage, make_schema
from snakesim_operator.recording.mcap_file import McapFile
from snakesim_operator.recording.stamps import Stamps, mark_stamps

Show = Callable[[FoxgloveMessage, int], None]  # gets a message for viewers, and its log time in ns


class ShownMessages:
    """The topics for viewers in one file."""

    def __init__(self, mcap: McapFile, robot_name: str, stamps: Stamps, show: Show | None = None) -> None:
        """Start without a topic.

        Args:
            mcap: The file.
            robot_name: The robot's name in the topics.
            stamps: The clock of the file's log times, and of the timestamps in the messages.
            show: Gets each message that is written.
        """
        self._mcap = mcap
        self._foxglove = FoxgloveChannels(robot_name)
        self._stamps: Stamps = stamps
        self._show = show
        self._channels: dict[str, int] = {}  # channel numbers by topic
        self._schemas: dict[str, int] = {}  # schema numbers by name
        self._counts: Counter[str] = Counter()  # messages written, by topic

    def write(self, key: str, payload: bytes, log_ns: int, publish_ns: int) -> int:
        """Write what is made of one message of the robot, and return the number of messages written.

        Args:
            key: Key of the robot's message.
            payload: The encoded message.
            log_ns: Its time by the clock of the file's log times.
            publish_ns: Its time by the other clock.
        """
        messages = self._foxglove.convert(key, payload, log_ns)
        for message in messages:
            channel = self._channels.get(message.topic)
            if channel is None:
                channel = self._open_channel(message)
            self._counts[message.topic] += 1
            self._mcap.add(channel, log_ns, publish_ns, self._counts[message.topic], message.payload)
            if self._show is not None:
                self._show(message, log_ns)
        return len(messages)

    def _open_channel(self, message: FoxgloveMessage) -> int:
        """Return the number of a new channel."""
        schema = make_schema(message.message_type)
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._mcap.add_schema(schema.name, schema.schema_encoding, schema.data)
        schema_number = self._schemas[schema.name]
        metadata = mark_stamps({}, self._stamps)
        channel = self._mcap.add_channel(message.topic, schema.message_encoding, schema_number, metadata)
        self._channels[message.topic] = channel
        return channel
