"""The folder of a run: one run at a time, and nothing of an earlier one is lost."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.run.folder import LOCK, choose_default_folder, lock_run_folder
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

HOLD = """
import sys, time
from pathlib import Path
from snakesim_operator.run.folder import lock_run_folder
with lock_run_folder(Path(sys.argv[1]), print):
    print("held", flush=True)
    time.sleep(60)
"""


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def leave(folder: Path, **files: str) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)


def test_a_folder_is_held_and_let_go(tmp_path: Path) -> None:
    out, said = tmp_path / "deep" / "run", list[str]()
    with lock_run_folder(out, said.append) as held:
        assert held == out
        assert content(out) == {LOCK: str(os.getpid())}
        with raises_error(ConfigError, code="file/in-use"):
            lock_run_folder(out, said.append).__enter__()
    assert content(out) == {}
    assert said == []


def test_an_earlier_run_is_moved_aside_every_time(tmp_path: Path) -> None:
    out, said = tmp_path / "run", list[str]()
    for number in range(3):
        with lock_run_folder(out, said.append):
            leave(out, config_json=f"{number}", notes_txt="mine")
            os.utime(out / "config.json", (1.8e9, 1.8e9))  # one after the other, within a second
    assert content(out)["config.json"] == "2"
    asides = sorted(path for path in tmp_path.iterdir() if path != out)
    assert [content(aside) for aside in asides] == [
        {"config.json": f"{n}", "notes.txt": "mine"} for n in range(2)
    ]
    assert all(re.fullmatch(r"run\.\d{8}-\d{6}(-2)?", aside.name) for aside in asides)
    assert said == [f"{out} held an earlier run: moved to {aside}" for aside in asides]


OLD = [
    "host.json",
    "blackbox.rows",
    "recording.mcap",
    "telemetry.jsonl",
    "blackbox.npz",
    "report.html",
]


@pytest.mark.parametrize("name", OLD)
def test_a_run_that_was_killed_is_an_earlier_run_too(tmp_path: Path, name: str) -> None:
    leave(tmp_path / "run", **{name.replace(".", "_"): "x"})
    with lock_run_folder(tmp_path / "run", lambda _: None) as out:
        assert not (out / name).exists()


def test_what_is_no_run_stays(tmp_path: Path) -> None:
    leave(tmp_path / "run", notes_txt="mine")
    with lock_run_folder(tmp_path / "run", pytest.fail) as out:
        assert content(out)["notes.txt"] == "mine"


def test_half_written_files_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    with lock_run_folder(tmp_path / "run", pytest.fail) as out:
        (out / "host.json.partial").write_text("")
    assert content(out) == {}


def test_run_folder_in_use_refuses_second_process_until_killed(tmp_path: Path) -> None:
    out = tmp_path / "run"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        leave(out, config_json="of the holder")
        before = content(out)
        with raises_error(ConfigError, code="file/in-use", field="--out"):
            lock_run_folder(out, pytest.fail).__enter__()
        assert content(out) == before
        assert list(tmp_path.iterdir()) == [out]
        holder.send_signal(signal.SIGKILL)
        holder.wait(10)
        said: list[str] = []
        with lock_run_folder(out, said.append):
            assert len(said) == 1
    finally:
        holder.kill()
        holder.wait(10)
        assert holder.stdout is not None
        holder.stdout.close()


def test_many_that_want_one_folder_at_once(tmp_path: Path) -> None:
    """One gets it, also while an earlier run is being moved aside."""
    out = tmp_path / "run"
    leave(out, config_json="earlier")
    several = [
        subprocess.Popen(
            [sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for _ in range(5)
    ]
    try:
        wait_until(lambda: sum(one.poll() is None for one in several) == 1, "all but one refused")
        (winner,) = (one for one in several if one.poll() is None)
        wait_until(lambda: content(out) == {LOCK: str(winner.pid)}, "the winner's folder")
        assert [content(path) for path in tmp_path.iterdir() if path != out] == [
            {"config.json": "earlier"}
        ]
    finally:
        for one in several:
            one.kill()
            _, err = one.communicate(timeout=10)
            assert b"Traceback" not in err or b"ConfigError" in err


def test_run_folder_moved_aside_is_not_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, aside, open_file = tmp_path / "run", tmp_path / "aside", os.open
    leave(out, notes_txt="mine")

    def late(path: str, *args: int, dir_fd: int | None = None) -> int:
        if path == LOCK and not aside.exists():
            out.rename(aside)
        return open_file(path, *args, dir_fd=dir_fd)

    monkeypatch.setattr(os, "open", late)
    with lock_run_folder(out, pytest.fail):
        assert content(out) == {LOCK: str(os.getpid())}
        assert content(aside) == {"notes.txt": "mine"}


@pytest.mark.parametrize("out", ["file", "file/run", "/proc/run"])
def test_what_cannot_be_a_folder_is_wrong_input(tmp_path: Path, out: str) -> None:
    (tmp_path / "file").write_text("mine")
    with raises_error(ConfigError, code="file/not-writable", field="--out"):
        lock_run_folder(tmp_path / out, pytest.fail).__enter__()
    assert (tmp_path / "file").read_text() == "mine"


def test_the_folder_that_one_is_in_is_not_moved_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave(tmp_path, config_json="x")
    monkeypatch.chdir(tmp_path)
    with raises_error(ConfigError, code="file/already-exists"):
        lock_run_folder(Path(), pytest.fail).__enter__()
    assert content(tmp_path) == {"config.json": "x"}


def test_run_folder_is_new_when_none_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first = choose_default_folder("triplet")
    first.mkdir(parents=True)
    assert re.fullmatch(r"runs/triplet-\d{8}-\d{6}", str(first))
    assert not choose_default_folder("triplet").exists()
