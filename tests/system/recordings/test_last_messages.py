"""The recorder of a run writes the messages that arrive after the run has told it to end."""

import threading
import time
from pathlib import Path

from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.recorder_process import record_to_file
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.clock_samples import make_clock_sample

TICKS = 300
TICK_S = 0.01  # so that the last messages take longer than the two seconds in which a silent host is waited for


def test_recorder_at_end_writes_messages_as_long_as_they_arrive(tmp_path: Path) -> None:
    endpoint = find_free_endpoint()
    link = ConnectionSettings(endpoint, "planar13")
    path = tmp_path / "recording.mcap"
    is_told_to_end = threading.Event()
    recorder = threading.Thread(
        target=lambda: record_to_file(
            link, path, lambda: not is_told_to_end.is_set(), wait_for_host_exit=True
        )
    )
    with open_session(ConnectionSettings(endpoint, "planar13", listen=True)) as host:
        host.declare_alive(HAL)
        clocks = host.declare_publisher(keys.CLOCK, Clock, lossless=True)
        recorder.start()
        wait_until(clocks.has_subscriber, "the recorder has subscribed")
        is_told_to_end.set()
        for tick in range(TICKS):
            host.send(keys.CLOCK, make_clock_sample(tick).payload)
            time.sleep(TICK_S)
    recorder.join()
    recorded = [message.payload for message in RecordingReader(path).read_messages([keys.CLOCK])]
    assert recorded == [make_clock_sample(tick).payload for tick in range(TICKS)]
