"""A recording contains what was on the wire, even if its recorder was killed or its disk is full or slow."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import pytest
from mcap.reader import make_reader

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode, format_encoding
from snakesim_hal.wire.custom_sample import make_message_schema
from snakesim_hal.wire.messages import (
    Clock,
    CustomSample,
    EstopRequest,
    LocomotionIntent,
    RobotDescription,
    TickDone,
)
from snakesim_hal.wire.quantities import bounded
from snakesim_operator.recording import tap as tap_module
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recorder_process import record_to_file
from snakesim_operator.recording.recover import recover_recording
from snakesim_operator.recording.tap import MessageTap
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_testing.hal.small_robots import PERIOD_NS, make_description
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.file_size import limited_file_size
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error
from snakesim_testing.operator.clock_samples import make_clock_sample


class Whisker(CustomSample, frozen=True, kw_only=True):
    """Bend of a whisker."""

    bend_rad: Annotated[float, bounded(-2.0, 2.0, "rad")]


def make_done_sample(tick: int, service: str = "control") -> ReceivedSample:
    """Make the sample in which a service reports that it has answered a tick."""
    return ReceivedSample(
        keys.done_key(service),
        encode(TickDone(tick=tick)),
        format_encoding(TickDone),
        time.monotonic_ns(),
    )


def test_recording_stores_messages_bytewise_with_robot_time(tmp_path: Path) -> None:
    recording = RecordingWriter(tmp_path / "a.mcap")
    intent = ReceivedSample(
        keys.INTENT,
        encode(LocomotionIntent(timestamp_ns=5, requester="anna")),
        format_encoding(LocomotionIntent),
        time.monotonic_ns(),
    )
    negative = msgspec.structs.replace(
        make_done_sample(0), payload=msgspec.msgpack.encode({"tick": -1})
    )
    sent = [
        make_clock_sample(7),
        make_done_sample(8),
        make_done_sample(2_000_000),
        intent,
        make_done_sample(6, "guidance"),
        negative,
    ]
    for arrival in sent:
        recording.write_arrival(arrival)
    recording.close({"dropped": {}})
    reader = RecordingReader(tmp_path / "a.mcap")
    stored = list(reader.read_messages())
    assert [(message.key, message.payload, message.encoding) for message in stored] == [
        (sample.key, sample.payload, sample.encoding) for sample in sent
    ]
    # A message with an impossible tick or without a tick gets the time of the newest clock.
    assert [message.robot_time_ns // PERIOD_NS for message in stored] == [7, 8, 7, 7, 6, 7]
    assert all(abs(message.wall_time_ns - time.time_ns()) < 60e9 for message in stored)
    assert reader.is_complete
    assert reader.metadata == {"dropped": {}}
    assert not reader.missing


def test_recording_is_read_by_mcap_library_with_schemas(tmp_path: Path) -> None:
    recording = RecordingWriter(tmp_path / "a.mcap")
    for tick in range(50):
        recording.write_arrival(make_clock_sample(tick))
        if tick in (20, 30):
            recording.flush()
    recording.close({"version": "1"})
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages())
        times_from_tick_25_ns = [
            message.log_time for *_, message in reader.iter_messages(starting_at=25 * PERIOD_NS)
        ]
        summary = reader.get_summary()
        metadata = list(reader.iter_metadata())
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 50
    assert len(summary.chunk_indexes) == 3
    assert times_from_tick_25_ns == [tick * PERIOD_NS for tick in range(25, 50)]
    assert summary.statistics.message_start_time == 0
    assert summary.statistics.message_end_time == 49 * PERIOD_NS
    assert [(entry.name, entry.metadata) for entry in metadata] == [
        ("snakesim", {"version": '"1"'})
    ]
    schema, channel, message = messages[-1]
    assert schema is not None
    assert schema.name == "snakesim.Clock"
    assert schema.encoding == "jsonschema"
    assert channel.topic == keys.CLOCK
    assert channel.message_encoding == "msgpack"
    assert message.log_time == 49 * PERIOD_NS


RECORD_ENDLESSLY_CODE = """
import os, sys, time
from collections.abc import Iterator
from pathlib import Path
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.recording.recover import recover_recording
from snakesim_testing.harness.file_size import limited_file_size
from snakesim_testing.operator.clock_samples import make_clock_sample
recording = RecordingWriter(Path(sys.argv[1]))
for tick in range(10**9):
    recording.write_arrival(make_clock_sample(tick))
    recording.flush_when_due()
    print(time.monotonic(), tick, flush=True)
    time.sleep(0.002)
"""


def test_recording_of_killed_recorder_misses_at_most_a_second(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = subprocess.Popen(
        [sys.executable, "-c", RECORD_ENDLESSLY_CODE, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    times_and_ticks: list[tuple[float, int]] = []
    while not times_and_ticks or times_and_ticks[-1][0] - times_and_ticks[0][0] < 1.2:
        time_s, tick = process.stdout.readline().split()
        times_and_ticks.append((float(time_s), int(tick)))
    os.kill(process.pid, signal.SIGKILL)
    process.wait(10)
    process.stdout.close()
    reader = RecordingReader(path)
    message_count = len(list(reader.read_messages()))
    last_time_s, _ = times_and_ticks[-1]
    ticks_a_second_before = [tick for time_s, tick in times_and_ticks if time_s < last_time_s - 1.0]
    assert message_count > ticks_a_second_before[-1]
    assert not reader.is_complete
    assert "its end: it breaks off" in reader.missing[0]
    # The mcap library may raise an error at the end of the file.
    with path.open("rb") as file, contextlib.suppress(Exception):
        library_times_ns = [
            message.log_time
            for _, _, message in make_reader(file).iter_messages(log_time_order=False)
        ]
        assert len(library_times_ns) == message_count


def test_recording_on_full_disk_ends_readable(tmp_path: Path) -> None:
    with limited_file_size(20_000):
        recording = RecordingWriter(tmp_path / "a.mcap")
        for tick in range(5000):
            recording.write_arrival(make_clock_sample(tick))
            if tick % 50 == 0:
                recording.flush()
        recording.close({})
    assert "File too large" in recording.failure
    reader = RecordingReader(tmp_path / "a.mcap")
    ticks = [message.robot_time_ns // PERIOD_NS for message in reader.read_messages()]
    assert len(ticks) > 200
    assert ticks == list(range(len(ticks)))
    assert not reader.losses.damage_count
    assert not reader.is_complete


def test_message_tap_flooded_is_bounded_and_counts_dropped_messages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tap_module, "MAX_QUEUED_BYTES", 1000)
    network = LocalNetwork()
    tap = MessageTap(network.create_session())
    publisher = network.create_session().declare_publisher(keys.done_key("control"), TickDone)
    for tick in range(2000):
        publisher.put(TickDone(tick=tick))
    arrivals = tap.take_arrivals()
    assert sum(len(arrival.payload) for arrival in arrivals) <= 1000
    assert len(arrivals) + tap.dropped_count_by_key[keys.done_key("control")] == 2000
    publisher.put(TickDone(tick=1))
    assert len(tap.take_arrivals()) == 1


def test_message_tap_in_lockstep_waits_once_for_slow_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tap_module, "MAX_QUEUED_BYTES", 100)
    monkeypatch.setattr(tap_module, "DISK_TIMEOUT_S", 2.0)
    network = LocalNetwork()
    tap = MessageTap(network.create_session())
    publisher = network.create_session().declare_publisher(keys.done_key("control"), TickDone)
    tap.is_lossless = True
    start_s = time.monotonic()
    for tick in range(200):
        publisher.put(TickDone(tick=tick))
    assert 2.0 <= time.monotonic() - start_s < 4.0  # the tap waits once for the disk
    assert tap.dropped_count_by_key.total() + len(tap.take_arrivals()) == 200


def test_recover_recording_of_unreadable_file_leaves_no_copy(tmp_path: Path) -> None:
    """Damaged recordings that can be copied: tests/system/recordings/test_damaged_recordings.py."""
    (tmp_path / "bad.mcap").write_bytes(b"no recording at all")
    with raises_error(ConfigError, code="recording/not-readable", field="bad.mcap"):
        recover_recording(tmp_path / "bad.mcap", tmp_path / "copy.mcap")
    assert not (tmp_path / "copy.mcap").exists()


@contextlib.contextmanager
def recorded_host(path: Path) -> Iterator[tuple[Session, threading.Event]]:
    """Record a host into a file, and end the recording when the host leaves at the end of the context.

    Yields:
        The session of the host, and an event that requests the end of the recording.
    """
    endpoint = find_free_endpoint()
    link = ConnectionSettings(endpoint, "planar13")
    stop_requested = threading.Event()
    recorder = threading.Thread(
        target=lambda: record_to_file(
            link, path, lambda: not stop_requested.is_set(), wait_for_host_exit=True
        )
    )
    with open_session(ConnectionSettings(endpoint, "planar13", listen=True)) as host:
        host.declare_alive(HAL)
        clocks = host.declare_publisher(keys.CLOCK, Clock, lossless=True)
        recorder.start()
        wait_until(
            lambda: clocks.has_subscriber() and host.list_tokens(keys.alive_key("recorder")),
            "the recorder connects",
        )
        yield host, stop_requested
    recorder.join()


def read_clock_payloads(path: Path) -> list[bytes]:
    """Return the payload of every clock message of a recording."""
    return [message.payload for message in RecordingReader(path).read_messages([keys.CLOCK])]


def test_recording_ends_after_last_samples_of_its_host(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with recorded_host(path) as (host, stop_requested):
        for tick in range(40):
            host.send(keys.CLOCK, make_clock_sample(tick).payload)
            if tick == 20:
                stop_requested.set()
                time.sleep(0.2)  # many cycles of the recorder
    assert read_clock_payloads(path) == [make_clock_sample(tick).payload for tick in range(40)]


def test_recorder_confirms_receipt_of_all_earlier_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    tick_count = 2000
    with recorded_host(path) as (host, stop_requested):
        for tick in range(tick_count):
            host.send(keys.CLOCK, make_clock_sample(tick).payload)
        answers = host.send_request_to_all(
            keys.RECEIVED, TickDone(tick=tick_count), 60.0, follows_all_messages=True
        )
        assert [answer.ok for _, answer in answers] == [True]
        stop_requested.set()
    expected = [make_clock_sample(tick).payload for tick in range(tick_count)]
    assert read_clock_payloads(path) == expected


def test_recorder_refuses_receipt_request_that_it_cannot_decode(tmp_path: Path) -> None:
    with recorded_host(tmp_path / "a.mcap") as (host, stop_requested):
        other_message = EstopRequest(requester="a client")
        answers = list(host.send_request_to_all(keys.RECEIVED, other_message, 60.0))
        assert [answer.ok for _, answer in answers] == [False]
        assert [answer.refusal for _, answer in answers] == ["unknown_message"]
        stop_requested.set()


def test_recording_at_its_end_continues_as_long_as_messages_arrive(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    tick_count = 300
    tick_s = 0.01  # together longer than the two seconds in which a silent host is waited for
    with recorded_host(path) as (host, stop_requested):
        stop_requested.set()
        for tick in range(tick_count):
            host.send(keys.CLOCK, make_clock_sample(tick).payload)
            time.sleep(tick_s)
    expected = [make_clock_sample(tick).payload for tick in range(tick_count)]
    assert read_clock_payloads(path) == expected


def test_recording_sample_before_description_keeps_its_schema(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    custom_key = keys.custom_key("left")
    early_sample = ReceivedSample(
        custom_key,
        msgspec.msgpack.encode({"tick": 3}),
        "application/msgpack;snakesim.CustomSample/1",
        0,
    )
    later_sample = msgspec.structs.replace(early_sample, monotonic_ns=1)
    schema = make_message_schema(Whisker, "test")
    description = msgspec.structs.replace(make_description(), custom={custom_key: schema})
    description_sample = ReceivedSample(
        keys.DESCRIPTION, encode(description), format_encoding(RobotDescription), 0
    )
    recording = RecordingWriter(path)
    for sample in (early_sample, make_clock_sample(4), description_sample, later_sample):
        recording.write_arrival(sample)
    recording.close({})
    with path.open("rb") as file:
        schemas = {
            schema.name
            for schema, _, _ in make_reader(file).iter_messages(topics=[custom_key])
            if schema
        }
    assert schemas == {"snakesim.custom.Whisker"}
    assert recording.counts[custom_key] == 2
