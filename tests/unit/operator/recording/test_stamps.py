"""Files whose log times are the wall clock: every time is kept, and this program reads robot time from them."""

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
    out = tmp_path_factory.mktemp("stamps") / "run"
    simulate(load_scenario("triplet", [parse_set_option("duration_s=0.5")]).config, out)
    return out / RECORDING_FILENAME


@pytest.fixture(scope="module")
def wall(recording: Path) -> Path:
    path = recording.parent / "wall.mcap"
    recover_recording(recording, path, "wall")
    return path


def read_with_stock_reader(
    path: Path, topics: list[str] | None = None
) -> list[tuple[Any, Any, Any]]:
    """Return channel, message and decoded protobuf of each message, in the order of the file."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        if topics is None:
            return [
                (channel, message, None)
                for _, channel, message in reader.iter_messages(log_time_order=False)
            ]
        decoded = reader.iter_decoded_messages(topics, log_time_order=False)
        return [(channel, message, content) for _, channel, message, content in decoded]


def test_copy_with_wall_stamps_keeps_both_times_of_every_message(
    recording: Path, wall: Path
) -> None:
    found = read_with_stock_reader(wall)
    assert found
    for channel, message, _ in found:
        assert channel.metadata[CLOCK_ENTRY] == "wall"
        assert message.log_time > YEAR_2020_NS
        assert message.publish_time < MAX_ROBOT_NS
    assert list(RecordingReader(wall).read_messages()) == list(
        RecordingReader(recording).read_messages()
    )
    assert RecordingReader(wall).missing == []


def test_run_is_the_same_with_either_stamps(recording: Path, wall: Path) -> None:
    by_wall = RunRecord.load(wall)
    by_robot = RunRecord.load(recording)
    assert by_wall.host.command_digest == by_robot.host.command_digest
    assert by_wall.time_s.tolist() == by_robot.time_s.tolist()


def test_messages_for_viewers_are_stamped_by_the_same_clock(recording: Path, wall: Path) -> None:
    """A viewer looks up transforms by the timestamps in the messages, at the log time that it shows."""
    for path, least_ns in ((recording, 0), (wall, YEAR_2020_NS)):
        states = read_with_stock_reader(path, ["/planar13/joint_states"])
        assert len(states) > 45
        for _, message, content in states:
            assert content.timestamp.ToNanoseconds() == message.log_time >= least_ns
        assert read_with_stock_reader(path, ["/planar13/tf"])


def test_copy_of_a_copy_is_in_robot_time_again(recording: Path, wall: Path, tmp_path: Path) -> None:
    recover_recording(wall, tmp_path / "robot.mcap", "robot")
    found = read_with_stock_reader(tmp_path / "robot.mcap")
    original = read_with_stock_reader(recording)
    assert all(CLOCK_ENTRY not in channel.metadata for channel, _, _ in found)
    found_times, original_times = (
        [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for channel, message, _ in messages
        ]
        for messages in (found, original)
    )
    assert found_times == original_times


def test_copy_without_a_choice_keeps_the_stamps(wall: Path, tmp_path: Path) -> None:
    count, _ = recover_recording(wall, tmp_path / "again.mcap")
    original, copy = (read_with_stock_reader(path) for path in (wall, tmp_path / "again.mcap"))
    assert [message.log_time for _, message, _ in copy] == [
        message.log_time for _, message, _ in original
    ]
    assert count == len(copy)


def test_recorder_writes_wall_stamps(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", log_time_clock="wall")
    contacts = Contacts(tick=3, timestamp_ns=3 * PERIOD_NS, contacts=[])
    before_ns = time.time_ns()
    writer.write_arrival(
        ReceivedSample(
            keys.CONTACTS, encode(contacts), format_encoding(Contacts), time.monotonic_ns()
        )
    )
    writer.close({})
    ((_, message, _),) = read_with_stock_reader(tmp_path / "a.mcap")
    assert message.publish_time == 3 * PERIOD_NS
    assert message.log_time == pytest.approx(before_ns, abs=10**9)
    (read,) = RecordingReader(tmp_path / "a.mcap").read_messages()
    assert (read.robot_time_ns, read.wall_time_ns) == (message.publish_time, message.log_time)
