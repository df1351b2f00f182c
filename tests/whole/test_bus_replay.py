"""`snakesim can replay`: the log of a bus gives the joint states that were recorded, to the bit."""

from pathlib import Path

import can
import pytest

from snakesim_can_backend.protocol.definitions import Opcode, frame_id
from tests.whole.command import run_to_summary, snakesim

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
    assert ended.code == 0, ended.said
    return folder


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc"])
def test_the_log_gives_the_recorded_states(run: Path, suffix: str) -> None:
    log = run.with_name("bus.log")
    if suffix != ".log":
        with can.LogReader(log) as frames, can.Logger(run.with_name(f"other{suffix}")) as other:
            for frame in frames:
                other(frame)
        log = run.with_name(f"other{suffix}")
    ended = snakesim("can", "replay", str(run), str(log), cwd=run)
    assert ended.code == 0 and "joint states of 50 ticks are those of the record, to the bit" in ended.out
    assert "did not answer" not in ended.out


def test_a_lost_answer_is_found(run: Path, tmp_path: Path) -> None:
    lines = run.with_name("bus.log").read_text().splitlines(keepends=True)
    answers = [i for i, line in enumerate(lines) if f" {frame_id(Opcode.JOINT_STATE, 4):03X}#" in line]
    del lines[answers[30]]
    log = tmp_path / "lost.log"
    log.write_text("".join(lines))
    ended = snakesim("can", "replay", str(run), str(log), cwd=tmp_path)
    assert ended.code == 1 and "joint_4 did not answer 1 Syncs in time" in ended.out
    assert "joint_4, " in ended.out and "1 of 50 ticks differ" in ended.out


@pytest.mark.parametrize(
    ("name", "content"), [("bus.log", "not a frame\n"), ("bus.blf", "LOGG damaged"), ("bus.txt", ""), ("bus.asc", None)]
)
def test_what_is_no_log_is_refused(run: Path, tmp_path: Path, name: str, content: str | None) -> None:
    log = tmp_path / name
    if content is not None:
        log.write_text(content)
    ended = snakesim("can", "replay", str(run), str(log), cwd=tmp_path)
    assert ended.code == 2 and "cannot be read as a log of a CAN bus (.log, .asc, .blf)" in ended.err
