"""`snakesim drive replay can` computes the joint states from the log of a bus, bit-identical to the recorded ones."""

import json
import re
import shutil
from pathlib import Path

import can
import pytest

from snakesim_can_backend.protocol.definitions import Opcode, frame_id
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

DURATION_S = "0.5"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide the folder of a run on emulated modules, one of them mounted differently, with the log of its bus."""
    folder = tmp_path_factory.mktemp("bus") / "run"
    log = folder.with_name("bus.log")
    options: list[str] = []
    for joint_key in ("sign=-1", "zero_rad=0.3", "gear=1.5"):
        options += ["--set", f"robot.joints.joint_6.{joint_key}"]
    options += ["--duration", DURATION_S, "--set", f"backends.can.log={log}"]
    result, _ = run_to_summary(folder, "triplet", "--backend", "can", *options)
    assert result.code == 0, result.printed
    return folder


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_bus_replay_of_log_computes_the_recorded_states(run: Path, suffix: str) -> None:
    log = run.with_name("bus.log")
    if suffix != ".log":
        with can.LogReader(log) as frames, can.Logger(run.with_name(f"other{suffix}")) as other:
            for frame in frames:
                other(frame)
        log = run.with_name(f"other{suffix}")
    result = snakesim("drive", "replay", "can", str(run), str(log), cwd=run)
    assert result.code == 0
    assert "joint states of 50 ticks are those of the record, to the bit" in result.out
    assert "did not answer" not in result.out


def test_bus_replay_of_log_without_one_answer_names_joint(run: Path, tmp_path: Path) -> None:
    lines = run.with_name("bus.log").read_text().splitlines(keepends=True)
    frame_of_joint_4 = f" {frame_id(Opcode.JOINT_STATE, 4):03X}#"
    answer_lines = [index for index, line in enumerate(lines) if frame_of_joint_4 in line]
    del lines[answer_lines[30]]
    log = tmp_path / "lost.log"
    log.write_text("".join(lines))
    result = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert result.code == 1
    assert "joint_4 did not answer 1 Syncs in time" in result.out
    assert "joint_4, " in result.out
    assert "1 of 50 ticks differ" in result.out


def test_bus_replay_of_truncated_log_compares_up_to_its_end(run: Path, tmp_path: Path) -> None:
    log = tmp_path / "cut.log"
    complete_log = run.with_name("bus.log").read_bytes()
    cut_byte = complete_log.index(b"\n", 3 * len(complete_log) // 5) + 8  # within a line
    log.write_bytes(complete_log[:cut_byte])
    result = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    ticks = re.search(r"joint states of (\d+) ticks are those of the record", result.out)
    assert result.code == 0, result.out
    assert ticks is not None, result.out
    assert 10 < int(ticks[1]) < 50, result.out
    line_count = len(log.read_bytes().splitlines())
    assert f"1 line is not a complete frame and was left out: line {line_count}: '(" in result.out
    assert "did not answer" not in result.out, "the log does not contain the rest of that tick"


def test_bus_replay_of_candump_output_without_times_computes_recorded_states(
    run: Path, tmp_path: Path
) -> None:
    printed = ""
    for frame in can.LogReader(run.with_name("bus.log")):
        data = "".join(f" {byte:02X}" for byte in frame.data)
        printed += f"  can0  {frame.arbitration_id:03X}   [{frame.dlc}] {data}\n"
    log = tmp_path / "printed.log"
    log.write_text(printed)
    result = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert result.code == 0, result.out
    assert "joint states of 50 ticks are those of the record, to the bit" in result.out
    assert "the frames have no times" in result.out


def test_bus_replay_refuses_log_of_another_drive_type(run: Path, tmp_path: Path) -> None:
    log = tmp_path / "odrive.log"
    heartbeats = "".join(f"(1700000000.{tick:06d}) can0 {node << 5 | 1:03X}#0000000001000000 R\n"
                         for tick in range(20) for node in range(1, 14))  # fmt: skip
    versions = "".join(
        f"(1700000001.{tick:06d}) can0 080#020404580006{tick:02X}00 R\n" for tick in range(20)
    )
    # The version frames of axis 4 have the id of a Sync.
    log.write_text(heartbeats + versions)
    result = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert result.code == 1, result.out
    assert "280 frames, and no Sync among them: the log of another bus; " in result.out
    assert "frames look like ODrive's heartbeat" in result.out

    odrive_run = tmp_path / "run"
    shutil.copytree(run, odrive_run)
    config = json.loads((odrive_run / "config.json").read_text())
    (odrive_run / "config.json").write_text(json.dumps(config | {"backend": "odrive"}))
    result = snakesim("drive", "replay", "can", str(odrive_run), str(log), cwd=tmp_path)
    assert result.code == 2
    assert "is a run with the backend 'odrive', and `snakesim drive replay can` reads" in result.err


@pytest.mark.parametrize(
    ("name", "content"),
    [("bus.log", "not a frame\n"), ("bus.blf", "LOGG damaged"), ("bus.txt", ""), ("bus.asc", None)],
)
def test_bus_replay_refuses_file_that_is_no_log(
    run: Path, tmp_path: Path, name: str, content: str | None
) -> None:
    log = tmp_path / name
    if content is not None:
        log.write_text(content)
    result = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert result.code == 2
    assert "cannot be read as a log of a CAN bus (.log, .asc, .blf)" in result.err
