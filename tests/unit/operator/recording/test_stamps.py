"""Recordings whose log times are wall-clock times: they contain both times, and readers get robot time."""

import time
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode, format_encoding
from snakesim_hal.wire.messages import Contacts
from snakesim_operator.recording.log_clock import CLOCK_ENTRY
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recover import recover_recording
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate

YEAR_2020_NS = 1_577_836_800 * 10**9
MAX_ROBOT_NS = 10 * 10**9
PERIOD_NS = 10_000_000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of half a second whose log times are robot times."""
    out = tmp_path_factory.mktemp("stamps") / "run"
    simulate(load_scenario("triplet", [parse_set_option("duration_s=0.5")]).config, out)
    return out / RECORDING_FILENAME


@pytest.fixture(scope="module")
def wall_recording(recording: Path) -> Path:
    """A copy of the recording whose log times are wall-clock times."""
    path = recording.parent / "wall.mcap"
    recover_recording(recording, path, "wall")
    return path


def read_with_mcap_reader(
    path: Path, topics: list[str] | None = None
) -> list[tuple[Any, Any, Any]]:
    """Read a file with the library mcap.

    Args:
        path: the recording.
        topics: of protobuf messages; None: all messages, which are not decoded.

    Returns:
        Channel, message and decoded protobuf of each message, in the order of the file.
    """
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        if topics is None:
            return [
                (channel, message, None)
                for _, channel, message in reader.iter_messages(log_time_order=False)
            ]
        decoded = reader.iter_decoded_messages(topics, log_time_order=False)
        return [(channel, message, content) for _, channel, message, content in decoded]


def test_recording_copy_with_wall_times_keeps_both_times(
    recording: Path, wall_recording: Path
) -> None:
    messages = read_with_mcap_reader(wall_recording)
    assert messages
    for channel, message, _ in messages:
        assert channel.metadata[CLOCK_ENTRY] == "wall"
        assert message.log_time > YEAR_2020_NS
        assert message.publish_time < MAX_ROBOT_NS
    assert list(RecordingReader(wall_recording).read_messages()) == list(
        RecordingReader(recording).read_messages()
    )
    assert RecordingReader(wall_recording).missing == []


def test_recording_gives_the_same_run_with_either_times(
    recording: Path, wall_recording: Path
) -> None:
    wall_run = RunRecord.load(wall_recording)
    robot_run = RunRecord.load(recording)
    assert wall_run.host.command_digest == robot_run.host.command_digest
    assert wall_run.time_s.tolist() == robot_run.time_s.tolist()


def test_recording_messages_for_viewers_have_times_of_one_clock(
    recording: Path, wall_recording: Path
) -> None:
    """A viewer looks up transforms by the timestamps in the messages, at the log time that it shows."""
    for path, min_time_ns in ((recording, 0), (wall_recording, YEAR_2020_NS)):
        states = read_with_mcap_reader(path, ["/planar13/joint_states"])
        assert len(states) > 45
        for _, message, content in states:
            assert content.timestamp.ToNanoseconds() == message.log_time >= min_time_ns
        assert read_with_mcap_reader(path, ["/planar13/tf"])


def test_recording_copy_back_to_robot_time_equals_the_original(
    recording: Path, wall_recording: Path, tmp_path: Path
) -> None:
    recover_recording(wall_recording, tmp_path / "robot.mcap", "robot")
    copied = read_with_mcap_reader(tmp_path / "robot.mcap")
    original = read_with_mcap_reader(recording)
    assert all(CLOCK_ENTRY not in channel.metadata for channel, _, _ in copied)
    copied_rows, original_rows = (
        [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for channel, message, _ in messages
        ]
        for messages in (copied, original)
    )
    assert copied_rows == original_rows


def test_recording_copy_without_chosen_clock_keeps_log_times(
    wall_recording: Path, tmp_path: Path
) -> None:
    count, _ = recover_recording(wall_recording, tmp_path / "again.mcap")
    original = read_with_mcap_reader(wall_recording)
    copy = read_with_mcap_reader(tmp_path / "again.mcap")
    assert [message.log_time for _, message, _ in copy] == [
        message.log_time for _, message, _ in original
    ]
    assert count == len(copy)


def test_recorder_writes_wall_times_and_robot_times(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", log_time_clock="wall")
    contacts = Contacts(tick=3, timestamp_ns=3 * PERIOD_NS, contacts=[])
    before_ns = time.time_ns()
    sample = ReceivedSample(
        keys.CONTACTS, encode(contacts), format_encoding(Contacts), time.monotonic_ns()
    )
    writer.write_arrival(sample)
    writer.close({})
    ((_, message, _),) = read_with_mcap_reader(tmp_path / "a.mcap")
    assert message.publish_time == 3 * PERIOD_NS
    assert message.log_time == pytest.approx(before_ns, abs=10**9)
    (read_message,) = RecordingReader(tmp_path / "a.mcap").read_messages()
    assert read_message.robot_time_ns == message.publish_time
    assert read_message.wall_time_ns == message.log_time
