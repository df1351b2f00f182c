"""The folder of a run belongs to one run at a time, and the files of an earlier run are moved and not lost."""

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

LOCK_FOLDER_CODE = """
import sys, time
from pathlib import Path
from snakesim_operator.run.folder import lock_run_folder
with lock_run_folder(Path(sys.argv[1]), print):
    print("locked", flush=True)
    time.sleep(60)
"""


def read_files(folder: Path) -> dict[str, str]:
    """Return the text of each file in a folder, by its name."""
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def write_files(folder: Path, **files: str) -> None:
    """Write files into a folder. The name of a keyword has `_` where the name of its file has a dot."""
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)


def test_run_folder_is_locked_until_the_run_ends(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    printed: list[str] = []
    with lock_run_folder(out, printed.append) as locked:
        assert locked == out
        assert read_files(out) == {LOCK: str(os.getpid())}
        with raises_error(ConfigError, code="file/in-use"):
            lock_run_folder(out, printed.append).__enter__()
    assert read_files(out) == {}
    assert printed == []


def test_run_folder_with_earlier_run_is_moved_every_time(tmp_path: Path) -> None:
    out = tmp_path / "run"
    printed: list[str] = []
    for number in range(3):
        with lock_run_folder(out, printed.append):
            write_files(out, config_json=f"{number}", notes_txt="mine")
            os.utime(out / "config.json", (1.8e9, 1.8e9))  # all runs are of the same second
    assert read_files(out)["config.json"] == "2"
    moved_folders = sorted(path for path in tmp_path.iterdir() if path != out)
    assert [read_files(folder) for folder in moved_folders] == [
        {"config.json": f"{number}", "notes.txt": "mine"} for number in range(2)
    ]
    for folder in moved_folders:
        assert re.fullmatch(r"run\.\d{8}-\d{6}(-2)?", folder.name)
    assert printed == [f"{out} held an earlier run: moved to {folder}" for folder in moved_folders]


RUN_FILES = [
    "host.json",
    "blackbox.rows",
    "recording.mcap",
    "telemetry.jsonl",
    "blackbox.npz",
    "report.html",
]


@pytest.mark.parametrize("name", RUN_FILES)
def test_run_folder_with_any_run_file_is_moved(tmp_path: Path, name: str) -> None:
    write_files(tmp_path / "run", **{name.replace(".", "_"): "x"})
    with lock_run_folder(tmp_path / "run", lambda _: None) as out:
        assert not (out / name).exists()


def test_run_folder_with_other_files_is_not_moved(tmp_path: Path) -> None:
    write_files(tmp_path / "run", notes_txt="mine")
    with lock_run_folder(tmp_path / "run", pytest.fail) as out:
        assert read_files(out)["notes.txt"] == "mine"


def test_run_folder_partial_files_are_removed_at_the_end(tmp_path: Path) -> None:
    with lock_run_folder(tmp_path / "run", pytest.fail) as out:
        (out / "host.json.partial").write_text("")
    assert read_files(out) == {}


def test_run_folder_in_use_refuses_second_process_until_killed(tmp_path: Path) -> None:
    out = tmp_path / "run"
    holder = subprocess.Popen(
        [sys.executable, "-c", LOCK_FOLDER_CODE, str(out)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        write_files(out, config_json="of the holder")
        files_before = read_files(out)
        with raises_error(ConfigError, code="file/in-use", field="--out"):
            lock_run_folder(out, pytest.fail).__enter__()
        assert read_files(out) == files_before
        assert list(tmp_path.iterdir()) == [out]
        holder.send_signal(signal.SIGKILL)
        holder.wait(10)
        printed: list[str] = []
        with lock_run_folder(out, printed.append):
            assert len(printed) == 1
    finally:
        holder.kill()
        holder.wait(10)
        assert holder.stdout is not None
        holder.stdout.close()


@pytest.mark.heavy
def test_run_folder_requested_by_many_processes_is_locked_by_one(tmp_path: Path) -> None:
    """One process locks the folder, also while an earlier run is being moved."""
    out = tmp_path / "run"
    write_files(out, config_json="earlier")
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", LOCK_FOLDER_CODE, str(out)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for _ in range(5)
    ]
    try:
        wait_until(
            lambda: sum(process.poll() is None for process in processes) == 1,
            "all processes but one have ended",
        )
        (winner,) = (process for process in processes if process.poll() is None)
        wait_until(lambda: read_files(out) == {LOCK: str(winner.pid)}, "the folder is locked")
        assert [read_files(path) for path in tmp_path.iterdir() if path != out] == [
            {"config.json": "earlier"}
        ]
    finally:
        for process in processes:
            process.kill()
            _, err = process.communicate(timeout=10)
            assert b"Traceback" not in err or b"ConfigError" in err


def test_run_folder_moved_by_another_process_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    moved_folder = tmp_path / "aside"
    open_file = os.open
    write_files(out, notes_txt="mine")

    def move_folder_and_open(path: str, *args: int, dir_fd: int | None = None) -> int:
        if path == LOCK and not moved_folder.exists():
            out.rename(moved_folder)
        return open_file(path, *args, dir_fd=dir_fd)

    monkeypatch.setattr(os, "open", move_folder_and_open)
    with lock_run_folder(out, pytest.fail):
        assert read_files(out) == {LOCK: str(os.getpid())}
        assert read_files(moved_folder) == {"notes.txt": "mine"}


@pytest.mark.parametrize("out", ["file", "file/run", "/proc/run"])
def test_run_folder_that_cannot_be_created_is_refused(tmp_path: Path, out: str) -> None:
    (tmp_path / "file").write_text("mine")
    with raises_error(ConfigError, code="file/not-writable", field="--out"):
        lock_run_folder(tmp_path / out, pytest.fail).__enter__()
    assert (tmp_path / "file").read_text() == "mine"


def test_run_folder_that_is_the_working_folder_is_not_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(tmp_path, config_json="x")
    monkeypatch.chdir(tmp_path)
    with raises_error(ConfigError, code="file/already-exists"):
        lock_run_folder(Path(), pytest.fail).__enter__()
    assert read_files(tmp_path) == {"config.json": "x"}


def test_run_folder_without_option_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = choose_default_folder("triplet")
    first.mkdir(parents=True)
    assert re.fullmatch(r"runs/triplet-\d{8}-\d{6}", str(first))
    assert not choose_default_folder("triplet").exists()
