"""What is on disk after anything: kills, full and read-only and slow disks; and true exit codes."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from snakesim_hal.host.latch import ESTOP
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import EstopRequest, LifecycleRequest, RobotStatus
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import REPORT_FILENAME
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.processes import assert_no_process_left
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.command import (
    SNAKESIM_COMMAND,
    TIMEOUT_S,
    CompletedRun,
    read_summary,
    run_program,
    run_to_summary,
    running_armed_snakesim,
    running_snakesim,
)

pytestmark = pytest.mark.e2e

# 50 Hz has the longest lease, 100 ms: a busy test machine may well forget a process for 50 ms.
LONG = [
    "triplet",
    "--controller",
    "hold",
    "--duration",
    "30",
    "--clock-mode",
    "realtime",
    "--set",
    "rate_hz=50",
]
SHORT = ["triplet", "--duration", "5", "--seed", "7"]
RATE_HZ = 50
IN_ONE, LOCKED = ["--in-process"], "mount -o remount,ro ."
FULL = "No space left on device; the run continues"
READ_ONLY = "Read-only file system; the run continues, but nothing of it is recorded"


def handles(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    return bool(int(status.partition("SigCgt:")[2].split()[0], 16) >> (number - 1) & 1)


def newest_status(session: Session) -> RobotStatus:
    found = session.wait_for_latched(keys.STATUS, RobotStatus, TIMEOUT_S)
    assert found is not None
    return found


# --- kills -----------------------------------------------------------------------------------------------------


def test_record_of_killed_host_misses_only_the_last_second(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            wait_until(lambda: newest_status(session).tick > 100, "two seconds")
            host, tick = run.part("host"), newest_status(session).tick
        os.kill(host, signal.SIGKILL)
        assert run.end() == 1, run.printed()
        said = run.printed()
    assert "host was ended by SIGKILL" in said
    assert "the last second may be missing" in said
    assert "Traceback" not in said
    record, summary = RunRecord.load(tmp_path / "run"), read_summary(tmp_path / "run")
    assert round(record.time_s[-1] * RATE_HZ) > tick - RATE_HZ
    assert summary.ticks == len(record.time_s)
    assert summary.duration_s == pytest.approx(len(record.time_s) / RATE_HZ)
    assert "host was ended by SIGKILL" in summary.ended
    assert any("last second" in lack for lack in summary.missing)
    assert summary.command_digest == record.host.command_digest
    assert record.control_states
    assert "last second" in (tmp_path / "run" / REPORT_FILENAME).read_text()


@pytest.mark.slow
def test_a_killed_supervisor_leaves_a_record_too(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            wait_until(lambda: newest_status(session).tick > 75, "one and a half seconds")
            tick = newest_status(session).tick
        os.kill(run.process.pid, signal.SIGKILL)
        run.end()
    record = RunRecord.load(tmp_path / "run")
    assert round(record.time_s[-1] * RATE_HZ) > tick - RATE_HZ
    assert record.host.ended == "running"
    assert record.control_states
    result = command.snakesim("study", "compare", "run", "run", cwd=tmp_path)
    assert result.code == 3
    assert "last second may be missing" in result.out
    assert "its end: it breaks off" in result.err
    ended, _ = command.run_to_summary(tmp_path / "run", *SHORT)  # and its folder can be used again
    assert ended.code == 0
    assert "held an earlier run: moved to" in ended.out


# --- complete, or not ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("when", [pytest.param("starting", marks=pytest.mark.slow), "armed"])
def test_a_host_that_is_stopped_is_no_complete_run(tmp_path: Path, when: str) -> None:
    with running_snakesim(tmp_path / "run", *LONG) as run:
        run.wait_for("network:")
        if when == "armed":
            run.wait_for(" s  ")
        host = run.part("host")
        wait_until(lambda: handles(host, signal.SIGTERM), "a host that takes signals")
        os.kill(host, signal.SIGTERM)
        assert run.end() == 1, run.printed()
    summary = read_summary(tmp_path / "run")
    assert summary.ended.startswith("the host was stopped by a signal after ")
    assert " of 30 s" in summary.ended
    assert f"fault: {summary.ended}" in run.printed()
    assert_no_process_left(tmp_path / "run")


@pytest.mark.slow
def test_record_time_while_disarmed_does_not_count(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG, "--duration", "2") as run:
        assert command.run_command_for_robot(run, "robot", "disarm").code == 0
        assert run.end() == 1, run.printed()
    ended = read_summary(tmp_path / "run").ended
    assert "of 2 s" in ended
    assert "the time was over before the requested armed time was reached" in ended


# --- the disk --------------------------------------------------------------------------------------------------


def in_a_file_system(
    tmp_path: Path, options: str, prepare: str, *arguments: str
) -> tuple[CompletedRun, Path]:
    """A run whose --out is in a tmpfs of its own, mounted where nobody else sees it; what it left is copied out."""
    if (
        shutil.which("unshare") is None
        or subprocess.run(["unshare", "-rm", "true"], check=False).returncode
    ):
        pytest.skip("this machine lets nobody mount a file system of their own (unshare -rm)")
    disk, left = tmp_path / "disk", tmp_path / "left"
    disk.mkdir()
    script = (
        'disk=$1; left=$2; options=$3; prepare=$4; shift 4; mount -t tmpfs -o "$options" tmpfs "$disk" || exit 99; '
        'cd "$disk" && eval "$prepare"; cd "$left/.."; "$@"; code=$?; cp -a "$disk" "$left"; exit $code'
    )
    network = [] if "--in-process" in arguments else ["--endpoint", find_free_endpoint()]
    typed = [*SNAKESIM_COMMAND, "run", *arguments, "--out", str(disk / "run"), *network]
    apart = ["unshare", "-rm", "sh", "-c", script, "sh", disk, left, options, prepare]
    done = run_program([*apart, *typed], tmp_path, timeout_s=120.0)
    assert_no_process_left(disk / "run")
    assert done.code != 99, done.err
    return done, left / "run"


def orderly(ended: CompletedRun, left: Path, *, code: int, warning: str) -> None:
    """One warning, no traceback, no empty or half-written file, the right exit code."""
    assert ended.code == code, ended.out + ended.err
    assert "Traceback" not in ended.out + ended.err
    assert ended.err == ""
    assert ended.out.count("warning:") == 1
    assert warning in ended.out
    assert "\nrecord: incomplete: " in ended.out
    files = [path for path in left.rglob("*") if path.is_file()]
    assert all(path.stat().st_size > 0 and path.suffix != ".partial" for path in files), files
    assert not any(
        "Traceback" in path.read_text(errors="replace") for path in files if path.suffix == ".log"
    )


@pytest.fixture(scope="module")
def digest(tmp_path_factory: pytest.TempPathFactory) -> str:
    return command.run_to_summary(tmp_path_factory.mktemp("good") / "run", *SHORT)[1].command_digest


@pytest.mark.parametrize(
    ("options", "prepare", "more", "warning"),
    [
        pytest.param(
            "size=1M", "cat /dev/zero > ballast 2> /dev/null", IN_ONE, FULL, marks=pytest.mark.slow
        ),
        ("size=48k", "", IN_ONE, FULL),  # room for the configuration and little else
        # less than the black box alone takes: rows are lost whoever fills it first
        pytest.param("size=250k", "", [], FULL, marks=pytest.mark.slow),
        pytest.param("size=1M,nr_inodes=4", "", IN_ONE, FULL, marks=pytest.mark.slow),
        pytest.param("size=1M", LOCKED, [], READ_ONLY, marks=pytest.mark.slow),
        ("size=1M", f"mkdir run; echo '{{}}' > run/config.json; {LOCKED}", IN_ONE, READ_ONLY),
    ],
)
def test_record_on_full_or_readonly_disk_does_not_affect_run(
    tmp_path: Path, digest: str, options: str, prepare: str, more: list[str], warning: str
) -> None:
    ended, left = in_a_file_system(tmp_path, options, prepare, *SHORT, *more)
    orderly(ended, left, code=3, warning=warning)
    assert f"command digest        {digest[:16]}" in ended.out
    if (left / "blackbox.rows").is_file():
        assert "of 500 ticks are missing in the black box" in ended.out


@pytest.mark.slow
def test_a_fault_outranks_a_full_disk(tmp_path: Path) -> None:
    ended, left = in_a_file_system(
        tmp_path, "size=100k", "", *SHORT, "--in-process", "--fault", "mute:joint_3@1"
    )
    orderly(ended, left, code=1, warning="No space left on device")
    assert "joint_3" in ended.out.partition("\nfault: ")[2].partition("\n")[0]


@pytest.mark.slow
def test_a_full_disk_disturbs_no_tick_in_real_time(tmp_path: Path) -> None:
    arguments = [*LONG, "--duration", "5"]
    ended, left = in_a_file_system(tmp_path, "size=100k", "", *arguments)
    orderly(ended, left, code=3, warning="No space left on device")
    assert "time                  5.00 s in 5.0" in ended.out


SLOW = '''
"""Makes writing to regular files slow in every process that finds this module: a slow disk, or one that hangs."""

import os
import pathlib
import stat
import time

HANGS = pathlib.Path(os.environ["SLOW_DISK_HANGS"])


def waiting(function, slow):
    def wrapped(*arguments, **more):
        if slow(arguments):
            time.sleep(0.2)
            while HANGS.exists():
                time.sleep(0.1)
        return function(*arguments, **more)

    return wrapped


def to_a_disk(arguments):
    return stat.S_ISREG(os.fstat(arguments[0]).st_mode) and "memfd" not in os.readlink(f"/proc/self/fd/{arguments[0]}")


os.write, os.pwrite = waiting(os.write, to_a_disk), waiting(os.pwrite, to_a_disk)
pathlib.Path.rename = waiting(pathlib.Path.rename, lambda arguments: arguments[0].name.endswith(".partial"))
'''


@pytest.fixture
def hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Every process of a run has a slow disk from now on; while this file is there it hangs."""
    (tmp_path / "slow").mkdir()
    (tmp_path / "slow" / "sitecustomize.py").write_text(SLOW)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "slow"))
    monkeypatch.setenv("SLOW_DISK_HANGS", str(tmp_path / "hangs"))
    return tmp_path / "hangs"


@pytest.mark.slow
def test_a_slow_disk_delays_no_tick_and_loses_nothing(tmp_path: Path, hangs: Path) -> None:
    ended, summary = run_to_summary(tmp_path / "run", *LONG, "--duration", "4")
    assert ended.code == 0 and "warning:" not in ended.out, ended.out
    assert summary.wall_s == pytest.approx(4.0, abs=0.1)
    assert summary.overruns < 10
    assert summary.missing == []
    assert len(RunRecord.load(tmp_path / "run").time_s) == 200
    assert not hangs.exists()


@pytest.mark.slow
def test_record_on_hanging_disk_delays_nothing(tmp_path: Path, hangs: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG, "--stay") as run:
        wait_until(lambda: (tmp_path / "run" / "host.json").is_file(), "the first numbers on disk")
        hangs.touch()
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            before = newest_status(session).tick
            time.sleep(1.0)
            assert newest_status(session).tick - before >= 0.8 * RATE_HZ
            began = time.monotonic()
            answer = session.send_request(keys.ESTOP, EstopRequest(requester="anna"))
            assert answer.ok
            assert answer.lifecycle == "estop"
            assert time.monotonic() - began < 3.0
            assert "not stored yet" in answer.reason or (tmp_path / "run" / ESTOP).exists()
            assert session.send_request(keys.LIFECYCLE, LifecycleRequest(action="finish")).ok
        assert run.end(30.0) == 1, run.printed()
        assert "the disk has not answered" in run.printed()
        assert "Traceback" not in run.printed()
