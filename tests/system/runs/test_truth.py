"""What a run says of itself is what happened: who stands still does not locomote, and a run that ended has an end."""

from pathlib import Path

import msgspec
import pytest

from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode, format_encoding
from snakesim_hal.wire.messages import ControlState
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import REPORT_FILENAME
from snakesim_operator.results.summary import summarize_run
from snakesim_testing.runs.in_process_command import run_to_summary

STILL = (
    "from snakesim_hal.controller import ControllerCommand, make_position_setpoints\n"
    "from snakesim_gnc.control.hold import HoldPose\n\n\n"
    "class Still(HoldPose):\n"
    "    def update(self, observation):\n"
    "        return ControllerCommand(super().update(observation).setpoints)\n"
)


def test_silent_standing_controller_does_not_locomote(tmp_path: Path) -> None:
    (tmp_path / "still.py").write_text(STILL)
    ended, summary = run_to_summary(
        tmp_path / "run", "triplet", "--controller", "./still.py:Still", "--duration", "3"
    )
    assert ended.code == 0
    assert summary.locomoting_fraction == 0.0
    assert summary.last_state == "NotLocomoting"
    assert summary.last_reason == "standing still: less than 20 mm in 1 s"
    assert "locomoting            0 %" in ended.out
    assert (
        "Did not locomote: standing still: less than 20 mm in 1 s."
        in (tmp_path / "run" / REPORT_FILENAME).read_text()
    )


@pytest.mark.slow
def test_moving_snake_locomotes_from_first_measured_motion(tmp_path: Path) -> None:
    ended, summary = run_to_summary(tmp_path / "run", "peg_row", "--duration", "4")
    assert ended.code == 0
    assert summary.path_distance_m is not None
    assert summary.path_distance_m > 0.5
    assert summary.locomoting_fraction is not None
    assert summary.locomoting_fraction > 0.95
    states = [
        state.state
        for state in RunRecord.load(tmp_path / "run").control_states
        if state.state != "Idle"
    ]
    assert states[0] == "NotLocomoting"
    assert states[-1] == "Locomoting"


def test_missing_clock_after_end_of_run_is_ignored(tmp_path: Path) -> None:
    _, summary = run_to_summary(tmp_path / "run", "triplet", "--duration", "1")
    assert summary.last_state not in (None, "PowerOff")
    last = RunRecord.load(tmp_path / "run").control_states[-1]
    gone = msgspec.structs.replace(last, state="PowerOff", reason="no clock from the HAL")
    before = list(RecordingReader(tmp_path / "run" / RECORDING_FILENAME).read_messages())
    (tmp_path / "run" / RECORDING_FILENAME).unlink()
    recording = RecordingWriter(tmp_path / "run" / RECORDING_FILENAME)
    for reported in before:
        recording.write_arrival(
            ReceivedSample(reported.key, reported.payload, reported.encoding, reported.wall_time_ns)
        )
    reported = ReceivedSample(keys.CONTROL_STATE, encode(gone), format_encoding(ControlState), 0)
    recording.write_arrival(reported)  # as control reports it while a host writes a long record
    recording.close({})
    again = summarize_run(RunRecord.load(tmp_path / "run"), "complete")
    assert again.last_state == summary.last_state
    assert again.last_reason == summary.last_reason
