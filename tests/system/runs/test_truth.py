"""A run reports what happened: a snake that does not move does not locomote, and the last state is the true one."""

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

HOLD_WITHOUT_REPORT_CODE = (
    "from snakesim_hal.controller import ControllerCommand, make_position_setpoints\n"
    "from snakesim_gnc.control.hold import HoldPose\n\n\n"
    "class Still(HoldPose):\n"
    "    def update(self, observation):\n"
    "        return ControllerCommand(super().update(observation).setpoints)\n"
)


@pytest.mark.heavy
def test_summary_of_standing_controller_without_report_is_not_locomoting(tmp_path: Path) -> None:
    (tmp_path / "still.py").write_text(HOLD_WITHOUT_REPORT_CODE)
    result, summary = run_to_summary(
        tmp_path / "run", "triplet", "--controller", "./still.py:Still", "--duration", "3"
    )
    assert result.code == 0
    assert summary.locomoting_fraction == 0.0
    assert summary.last_state == "NotLocomoting"
    assert summary.last_reason == "standing still: less than 20 mm in 1 s"
    assert "locomoting            0 %" in result.out
    assert (
        "Did not locomote: standing still: less than 20 mm in 1 s."
        in (tmp_path / "run" / REPORT_FILENAME).read_text()
    )


@pytest.mark.slow
def test_summary_of_moving_snake_is_locomoting_from_first_motion(tmp_path: Path) -> None:
    result, summary = run_to_summary(tmp_path / "run", "peg_row", "--duration", "4")
    assert result.code == 0
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


def test_summary_ignores_missing_clock_after_end_of_run(tmp_path: Path) -> None:
    _, summary = run_to_summary(tmp_path / "run", "triplet", "--duration", "1")
    assert summary.last_state not in (None, "PowerOff")
    last_state = RunRecord.load(tmp_path / "run").control_states[-1]
    power_off = msgspec.structs.replace(
        last_state, state="PowerOff", reason="no clock from the HAL"
    )
    path = tmp_path / "run" / RECORDING_FILENAME
    messages = list(RecordingReader(path).read_messages())
    path.unlink()
    recording = RecordingWriter(path)
    for message in messages:
        recording.write_arrival(
            ReceivedSample(message.key, message.payload, message.encoding, message.wall_time_ns)
        )
    # Control reports this while a host writes a long record.
    recording.write_arrival(
        ReceivedSample(keys.CONTROL_STATE, encode(power_off), format_encoding(ControlState), 0)
    )
    recording.close({})
    new_summary = summarize_run(RunRecord.load(tmp_path / "run"), "complete")
    assert new_summary.last_state == summary.last_state
    assert new_summary.last_reason == summary.last_reason
