"""The recorder as a process: beside a run and as part of it, killed, and what is played from its file."""

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
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.command import run_in_background, running_armed_snakesim

pytestmark = pytest.mark.e2e

TRUSTED = "https://app.foxglove.dev"
LONG = [
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


def sighted_live(address: str, origin: str | None = None) -> list[str]:
    """The frames that a viewer of Foxglove's is told of. origin: of the page that it is, if it is one."""
    of = None if origin is None else Origin(origin)
    with connect(
        address, origin=of, subprotocols=[Subprotocol("foxglove.sdk.v1")], proxy=None
    ) as viewer:
        frames: dict[str, str] | None = None
        while frames is None:
            reported = viewer.recv(10.0)
            if isinstance(reported, str) and (message := json.loads(reported))["op"] == "advertise":
                frames = next(
                    (row for row in message["channels"] if row["topic"] == "/planar13/tf"), None
                )
        assert frames["encoding"] == frames["schemaEncoding"] == "protobuf"
        viewer.send(
            json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": frames["id"]}]})
        )
        while isinstance(reported := viewer.recv(10.0), str):
            pass
        operation, _, time_ns = struct.unpack("<BIQ", reported[:13])
        assert operation == 1
        assert 0 < time_ns < 60e9  # robot time
        return [
            frame.child_frame_id for frame in FrameTransforms.FromString(reported[13:]).transforms
        ]


@pytest.mark.slow
def test_recorder_loss_does_not_end_run_and_another_records(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG) as run:
        time.sleep(1.0)
        os.kill(run.part("recorder"), signal.SIGKILL)
        typed = ("record", "--endpoint", run.endpoint, "--out", "beside.mcap")
        with run_in_background(
            tmp_path, *typed, "--foxglove", "0", "--foxglove-origin", TRUSTED
        ) as beside:
            assert beside.stdout is not None
            address = (
                next(line for line in beside.stdout if "Foxglove" in line)
                .rpartition(" ")[2]
                .strip()
            )
            file = tmp_path / "beside.mcap"
            wait_until(
                lambda: file.exists() and file.stat().st_size > 10_000,
                "the first second of the recording",
            )
            links = sighted_live(address)
            assert (
                sighted_live(address, address.replace("ws", "http"))
                == sighted_live(address, TRUSTED)
                == links
            )
            for theirs in ("http://evil.example", "null", "file://", "http://localhost:8080"):
                with pytest.raises(InvalidStatus, match="403"):
                    sighted_live(address, theirs)
            time.sleep(1.0)
            beside.send_signal(signal.SIGINT)
            said = beside.stdout.read()
            assert "messages in" in said
            assert beside.wait(20) == 0
            assert said.count("refused a viewer") == 4 and "http://evil.example" in said, said
        assert links == [f"link_{i}" for i in range(14)]
        assert run.end() == 3, run.printed()  # complete, but the record is incomplete
    assert run.printed().count("warning:") == 1
    assert "recorder was ended by SIGKILL" in run.printed()
    kept = list(RecordingReader(tmp_path / "run" / RECORDING_FILENAME).read_messages([keys.JOINTS]))
    assert len(kept) > 10
    alone = RunRecord.load(tmp_path / "beside.mcap")
    assert alone.config.name == "triplet"
    assert len(alone.time_s) > 40
    assert command.snakesim("recording", "report", "beside.mcap", cwd=tmp_path).code == 0


def test_a_recording_is_played_with_its_timing(tmp_path: Path) -> None:
    ended = command.snakesim(
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
    assert ended.code == 0
    assert not (tmp_path / "bare" / RECORDING_FILENAME).exists()
    command.snakesim(
        "run", "triplet", "--in-process", "--duration", "1", "--out", "run", cwd=tmp_path
    )
    endpoint, said = find_free_endpoint(), list[str]()
    how = {"endpoint": endpoint, "namespace": "again", "rate": 0.5, "step": False}
    player = threading.Thread(
        target=play_recording,
        args=(tmp_path / "run" / RECORDING_FILENAME, iter(()), said.append),
        kwargs=how,
    )
    player.start()
    wait_until(lambda: bool(said), "the player")
    with open_session(ConnectionSettings(endpoint, "again"), 5.0) as session:
        robots = session.declare_latched_reader(keys.DESCRIPTION, RobotDescription)
        clocks, began = session.declare_reader(keys.CLOCK, Clock), time.monotonic()
        found = list[Clock]()
        wait_until(
            lambda: bool(found.extend(clocks.drain())) or bool(found and found[-1].tick == 99),
            "the last tick",
        )
        assert time.monotonic() - began > 1.0
        assert len(found) > 50
        assert robots.drain()[-1].robot == "planar13"
    player.join(10)
    assert "messages played" in said[-1]
