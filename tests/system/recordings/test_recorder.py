"""The recorder process as a part of a run and beside it: it may be killed, and its file can be played back."""

import json
import os
import signal
import struct
import threading
import time
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, RobotDescription
from snakesim_operator.playback.play import play_recording
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.hal.local_network import wait_for_tick
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.command import run_in_background, running_armed_snakesim

pytestmark = pytest.mark.e2e

TRUSTED = "https://app.foxglove.dev"
RUN_OF_7_S = [
    "triplet",
    "--controller",
    "hold",
    "--duration",
    "7",
    "--clock-mode",
    "realtime",
    "--set",
    "rate_hz=50",
]


def read_foxglove_frames(address: str, origin: str | None = None) -> list[str]:
    """Connect as a Foxglove viewer and return the names of the coordinate frames that it receives.

    Args:
        address: WebSocket address of the recorder.
        origin: origin of the web page that contains the viewer; None for a program.
    """
    origin_header = None if origin is None else Origin(origin)
    with connect(
        address, origin=origin_header, subprotocols=[Subprotocol("foxglove.sdk.v1")], proxy=None
    ) as viewer:
        channel: dict[str, str] | None = None
        while channel is None:
            reply = viewer.recv(10.0)
            if isinstance(reply, str) and (message := json.loads(reply))["op"] == "advertise":
                channel = next(
                    (entry for entry in message["channels"] if entry["topic"] == "/planar13/tf"),
                    None,
                )
        assert channel["encoding"] == "protobuf"
        assert channel["schemaEncoding"] == "protobuf"
        subscription = {"id": 1, "channelId": channel["id"]}
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
        while isinstance(reply := viewer.recv(10.0), str):
            pass
        operation, _, robot_time_ns = struct.unpack("<BIQ", reply[:13])
        assert operation == 1
        assert 0 < robot_time_ns < 60e9
        transforms = FrameTransforms.FromString(reply[13:]).transforms
        return [frame.child_frame_id for frame in transforms]


@pytest.mark.slow
def test_recorder_loss_does_not_end_run_and_another_records(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *RUN_OF_7_S) as run:
        time.sleep(1.0)
        os.kill(run.part("recorder"), signal.SIGKILL)
        arguments = ("record", "--endpoint", run.endpoint, "--out", "second.mcap")
        with run_in_background(
            tmp_path, *arguments, "--foxglove", "0", "--foxglove-origin", TRUSTED
        ) as second_recorder:
            assert second_recorder.stdout is not None
            address_line = next(line for line in second_recorder.stdout if "Foxglove" in line)
            address = address_line.rpartition(" ")[2].strip()
            file = tmp_path / "second.mcap"
            wait_until(
                lambda: file.exists() and file.stat().st_size > 10_000,
                "the first second of the recording",
            )
            links = read_foxglove_frames(address)
            own_origin = address.replace("ws", "http")
            assert read_foxglove_frames(address, own_origin) == links
            assert read_foxglove_frames(address, TRUSTED) == links
            for origin in ("http://evil.example", "null", "file://", "http://localhost:8080"):
                with pytest.raises(InvalidStatus, match="403"):
                    read_foxglove_frames(address, origin)
            time.sleep(1.0)
            second_recorder.send_signal(signal.SIGINT)
            printed = second_recorder.stdout.read()
            assert "messages in" in printed
            assert second_recorder.wait(20) == 0
            assert printed.count("refused a viewer") == 4, printed
            assert "http://evil.example" in printed
        assert links == [f"link_{i}" for i in range(14)]
        assert run.end() == 3, run.printed()  # the run is complete, but its record is incomplete
    assert run.printed().count("warning:") == 1
    assert "recorder was ended by SIGKILL" in run.printed()
    recording = RecordingReader(tmp_path / "run" / RECORDING_FILENAME)
    assert len(list(recording.read_messages([keys.JOINTS]))) > 10
    second_record = RunRecord.load(tmp_path / "second.mcap")
    assert second_record.config.name == "triplet"
    assert len(second_record.time_s) > 40
    assert command.snakesim("recording", "report", "second.mcap", cwd=tmp_path).code == 0


@pytest.mark.heavy
def test_played_recording_keeps_its_timing_at_half_rate(tmp_path: Path) -> None:
    result = command.snakesim(
        "run",
        "triplet",
        "--in-process",
        "--no-record",
        "--duration",
        "0.1",
        "--out",
        "bare",
        cwd=tmp_path,
    )
    assert result.code == 0
    assert not (tmp_path / "bare" / RECORDING_FILENAME).exists()
    command.snakesim(
        "run", "triplet", "--in-process", "--duration", "1", "--out", "run", cwd=tmp_path
    )
    endpoint = find_free_endpoint()
    printed: list[str] = []
    player = threading.Thread(
        target=play_recording,
        args=(tmp_path / "run" / RECORDING_FILENAME, iter(()), printed.append),
        kwargs={"endpoint": endpoint, "namespace": "again", "rate": 0.5, "step": False},
    )
    player.start()
    wait_until(lambda: bool(printed), "the player starts")
    with open_session(ConnectionSettings(endpoint, "again"), 5.0) as session:
        descriptions = session.declare_latched_reader(keys.DESCRIPTION, RobotDescription)
        clock_reader = session.declare_reader(keys.CLOCK, Clock)
        start_s = time.monotonic()
        clocks = wait_for_tick(clock_reader, 99, "the last tick")
        assert clocks[-1].tick == 99
        assert time.monotonic() - start_s > 1.0
        assert len(clocks) > 50
        assert descriptions.drain()[-1].robot == "planar13"
    player.join(10)
    assert "messages played" in printed[-1]
