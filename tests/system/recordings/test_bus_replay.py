"""`snakesim drive replay can`: the log of a bus gives the joint states that were recorded, to the bit."""

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
    """The folder of a run on emulated modules, one of them mounted otherwise, with the log of its bus."""
    folder = tmp_path_factory.mktemp("bus") / "run"
    log = folder.with_name("bus.log")
    mounted = ("sign=-1", "zero_rad=0.3", "gear=1.5")
    flags = [word for one in mounted for word in ("--set", f"robot.joints.joint_6.{one}")]
    more = ("--duration", DURATION_S, "--set", f"backends.can.log={log}")
    ended, _ = run_to_summary(folder, "triplet", "--backend", "can", *flags, *more)
    assert ended.code == 0, ended.printed
    return folder


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_the_log_gives_the_recorded_states(run: Path, suffix: str) -> None:
    log = run.with_name("bus.log")
    if suffix != ".log":
        with can.LogReader(log) as frames, can.Logger(run.with_name(f"other{suffix}")) as other:
            for frame in frames:
                other(frame)
        log = run.with_name(f"other{suffix}")
    ended = snakesim("drive", "replay", "can", str(run), str(log), cwd=run)
    assert ended.code == 0
    assert "joint states of 50 ticks are those of the record, to the bit" in ended.out
    assert "did not answer" not in ended.out


def test_a_lost_answer_is_found(run: Path, tmp_path: Path) -> None:
    lines = run.with_name("bus.log").read_text().splitlines(keepends=True)
    answers = [
        i for i, line in enumerate(lines) if f" {frame_id(Opcode.JOINT_STATE, 4):03X}#" in line
    ]
    del lines[answers[30]]
    log = tmp_path / "lost.log"
    log.write_text("".join(lines))
    ended = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert ended.code == 1
    assert "joint_4 did not answer 1 Syncs in time" in ended.out
    assert "joint_4, " in ended.out
    assert "1 of 50 ticks differ" in ended.out


def test_bus_replay_of_cut_log_compares_up_to_the_cut(run: Path, tmp_path: Path) -> None:
    log = tmp_path / "cut.log"
    whole = run.with_name("bus.log").read_bytes()
    cut_at = whole.index(b"\n", 3 * len(whole) // 5) + 8
    log.write_bytes(whole[:cut_at])
    ended = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    ticks = re.search(r"joint states of (\d+) ticks are those of the record", ended.out)
    assert ended.code == 0 and ticks is not None and 10 < int(ticks[1]) < 50, ended.out
    last = len(log.read_bytes().splitlines())
    assert f"1 line is no whole frame and was left out: line {last}: '(" in ended.out
    assert "did not answer" not in ended.out, (
        "the log ends there; nothing is known of the rest of that tick"
    )


def test_what_candump_prints_without_times_gives_them_too(run: Path, tmp_path: Path) -> None:
    printed = ""
    for frame in can.LogReader(run.with_name("bus.log")):
        data = "".join(f" {byte:02X}" for byte in frame.data)
        printed += f"  can0  {frame.arbitration_id:03X}   [{frame.dlc}] {data}\n"
    log = tmp_path / "printed.log"
    log.write_text(printed)
    ended = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert (
        ended.code == 0
        and "joint states of 50 ticks are those of the record, to the bit" in ended.out
    ), ended.out
    assert "the frames have no times" in ended.out


def test_bus_replay_refuses_log_of_another_drive_type(run: Path, tmp_path: Path) -> None:
    log = tmp_path / "odrive.log"
    heartbeats = "".join(f"(1700000000.{tick:06d}) can0 {node << 5 | 1:03X}#0000000001000000 R\n"
                         for tick in range(20) for node in range(1, 14))  # fmt: skip
    versions = "".join(
        f"(1700000001.{tick:06d}) can0 080#020404580006{tick:02X}00 R\n" for tick in range(20)
    )
    log.write_text(heartbeats + versions)  # of axis 4; the id is that of a Sync
    ended = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert (
        ended.code == 1
        and "280 frames, and no Sync among them: the log of another bus; " in ended.out
    ), ended.out
    assert "frames look like ODrive's heartbeat" in ended.out
    other = tmp_path / "run"
    shutil.copytree(run, other)
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps(config | {"backend": "odrive"}))
    ended = snakesim("drive", "replay", "can", str(other), str(log), cwd=tmp_path)
    assert ended.code == 2
    assert "is a run with the backend 'odrive', and `snakesim drive replay can` reads" in ended.err


@pytest.mark.parametrize(
    ("name", "content"),
    [("bus.log", "not a frame\n"), ("bus.blf", "LOGG damaged"), ("bus.txt", ""), ("bus.asc", None)],
)
def test_what_is_no_log_is_refused(
    run: Path, tmp_path: Path, name: str, content: str | None
) -> None:
    log = tmp_path / name
    if content is not None:
        log.write_text(content)
    ended = snakesim("drive", "replay", "can", str(run), str(log), cwd=tmp_path)
    assert ended.code == 2
    assert "cannot be read as a log of a CAN bus (.log, .asc, .blf)" in ended.err
