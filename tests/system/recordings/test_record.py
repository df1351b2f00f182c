"""A run leaves a usable record and the right exit code after kills, and on full, read-only and slow disks."""

import os
import re
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

# 50 Hz has the longest lease, 100 ms: a busy test machine may pause a process for 50 ms.
LONG_RUN = [
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
SHORT_RUN = ["triplet", "--duration", "5", "--seed", "7"]
RATE_HZ = 50
IN_PROCESS = ["--in-process"]
REMOUNT_READ_ONLY = "mount -o remount,ro ."
DISK_FULL_WARNING = "No space left on device; the run continues"
READ_ONLY_WARNING = "Read-only file system; the run continues, but nothing of it is recorded"


def has_signal_handler(pid: int, number: signal.Signals) -> bool:
    """Return whether a process has a handler for a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    caught_signals = int(status.partition("SigCgt:")[2].split()[0], 16)  # a bit for each signal
    return bool(caught_signals >> (number - 1) & 1)


def read_newest_status(session: Session) -> RobotStatus:
    """Return the newest status that the host has published."""
    status = session.wait_for_latched(keys.STATUS, RobotStatus, TIMEOUT_S)
    assert status is not None
    return status


# --- kills -------------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_record_of_killed_host_misses_only_the_last_second(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG_RUN) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            wait_until(lambda: read_newest_status(session).tick > 100, "two seconds")
            host = run.part("host")
            tick = read_newest_status(session).tick
        os.kill(host, signal.SIGKILL)
        assert run.end() == 1, run.printed()
        printed = run.printed()
    assert "host was ended by SIGKILL" in printed
    assert "the last second may be missing" in printed
    assert "Traceback" not in printed
    record = RunRecord.load(tmp_path / "run")
    summary = read_summary(tmp_path / "run")
    assert round(record.time_s[-1] * RATE_HZ) > tick - RATE_HZ
    assert summary.ticks == len(record.time_s)
    assert summary.duration_s == pytest.approx(len(record.time_s) / RATE_HZ)
    assert "host was ended by SIGKILL" in summary.ended
    assert any("last second" in sentence for sentence in summary.missing)
    assert summary.command_digest == record.host.command_digest
    assert record.control_states
    assert "last second" in (tmp_path / "run" / REPORT_FILENAME).read_text()


@pytest.mark.slow
def test_record_of_killed_supervisor_misses_only_the_last_second(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG_RUN) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            wait_until(lambda: read_newest_status(session).tick > 75, "one and a half seconds")
            tick = read_newest_status(session).tick
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
    # The folder can be used for another run.
    result, _ = command.run_to_summary(tmp_path / "run", *SHORT_RUN)
    assert result.code == 0
    assert "held an earlier run: moved to" in result.out


# --- complete, or not --------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize("when", [pytest.param("starting", marks=pytest.mark.slow), "armed"])
def test_record_of_host_stopped_by_signal_is_incomplete(tmp_path: Path, when: str) -> None:
    with running_snakesim(tmp_path / "run", *LONG_RUN) as run:
        run.wait_for("network:")
        if when == "armed":
            run.wait_for(" s  ")
        host = run.part("host")
        wait_until(lambda: has_signal_handler(host, signal.SIGTERM), "the host handles signals")
        os.kill(host, signal.SIGTERM)
        assert run.end() == 1, run.printed()
    summary = read_summary(tmp_path / "run")
    assert summary.ended.startswith("the host was stopped by a signal after ")
    assert " of 30 s" in summary.ended
    assert f"fault: {summary.ended}" in run.printed()
    assert_no_process_left(tmp_path / "run")


@pytest.mark.slow
def test_record_time_while_disarmed_does_not_count(tmp_path: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG_RUN, "--duration", "2") as run:
        assert command.run_command_for_robot(run, "robot", "disarm").code == 0
        assert run.end() == 1, run.printed()
    result = read_summary(tmp_path / "run").ended
    assert "of 2 s" in result
    assert "the time was over before the requested armed time was reached" in result


# --- the disk ----------------------------------------------------------------------------------------------------


def run_in_file_system(
    tmp_path: Path, options: str, prepare: str, *arguments: str
) -> tuple[CompletedRun, Path]:
    """Run with `--out` in a new tmpfs that only this run can see.

    Args:
        tmp_path: folder of the test.
        options: mount options, such as the size.
        prepare: shell commands that are executed in the file system before the run.
        arguments: arguments of `snakesim run`.

    Returns:
        The finished command, and a copy of the folder of the run.
    """
    if (
        shutil.which("unshare") is None
        or subprocess.run(["unshare", "-rm", "true"], check=False).returncode
    ):
        pytest.skip("this machine does not allow users to mount a file system (unshare -rm)")
    disk = tmp_path / "disk"
    run_folder = tmp_path / "left"
    disk.mkdir()
    script = (
        'disk=$1; left=$2; options=$3; prepare=$4; shift 4; mount -t tmpfs -o "$options" tmpfs "$disk" || exit 99; '
        'cd "$disk" && eval "$prepare"; cd "$left/.."; "$@"; code=$?; cp -a "$disk" "$left"; exit $code'
    )
    network = [] if "--in-process" in arguments else ["--endpoint", find_free_endpoint()]
    run_command = [*SNAKESIM_COMMAND, "run", *arguments, "--out", str(disk / "run"), *network]
    unshare_command = [
        "unshare",
        "-rm",
        "sh",
        "-c",
        script,
        "sh",
        disk,
        run_folder,
        options,
        prepare,
    ]
    result = run_program([*unshare_command, *run_command], tmp_path, timeout_s=120.0)
    assert_no_process_left(disk / "run")
    assert result.code != 99, result.err
    return result, run_folder / "run"


def assert_orderly_end(result: CompletedRun, run_folder: Path, *, code: int, warning: str) -> None:
    """Check the exit code, that one warning and no traceback was printed, and that all files are complete."""
    assert result.code == code, result.out + result.err
    assert "Traceback" not in result.out + result.err
    assert result.err == ""
    assert result.out.count("warning:") == 1
    assert warning in result.out
    assert "\nrecord: incomplete: " in result.out
    files = [path for path in run_folder.rglob("*") if path.is_file()]
    assert all(path.stat().st_size > 0 and path.suffix != ".partial" for path in files), files
    assert not any(
        "Traceback" in path.read_text(errors="replace") for path in files if path.suffix == ".log"
    )


@pytest.fixture(scope="module")
def digest(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Provide the command digest of the short run on a good disk."""
    return command.run_to_summary(tmp_path_factory.mktemp("good") / "run", *SHORT_RUN)[
        1
    ].command_digest


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("options", "prepare", "extra_arguments", "warning"),
    [
        pytest.param(
            "size=1M",
            "cat /dev/zero > ballast 2> /dev/null",
            IN_PROCESS,
            DISK_FULL_WARNING,
            marks=pytest.mark.slow,
        ),
        (
            "size=48k",
            "",
            IN_PROCESS,
            DISK_FULL_WARNING,
        ),  # room for the configuration and little else
        # The black box alone needs more, so that rows are lost in every case.
        pytest.param("size=250k", "", [], DISK_FULL_WARNING, marks=pytest.mark.slow),
        pytest.param(
            "size=1M,nr_inodes=4", "", IN_PROCESS, DISK_FULL_WARNING, marks=pytest.mark.slow
        ),
        pytest.param("size=1M", REMOUNT_READ_ONLY, [], READ_ONLY_WARNING, marks=pytest.mark.slow),
        (
            "size=1M",
            f"mkdir run; echo '{{}}' > run/config.json; {REMOUNT_READ_ONLY}",
            IN_PROCESS,
            READ_ONLY_WARNING,
        ),
    ],
)
def test_record_on_full_or_readonly_disk_does_not_affect_run(
    tmp_path: Path,
    digest: str,
    options: str,
    prepare: str,
    extra_arguments: list[str],
    warning: str,
) -> None:
    result, run_folder = run_in_file_system(
        tmp_path, options, prepare, *SHORT_RUN, *extra_arguments
    )
    assert_orderly_end(result, run_folder, code=3, warning=warning)
    assert f"command digest        {digest[:16]}" in result.out
    if (run_folder / "blackbox.rows").is_file():
        assert "of 500 ticks are missing in the black box" in result.out


@pytest.mark.slow
def test_record_with_fault_on_full_disk_keeps_fault_exit_code(tmp_path: Path) -> None:
    result, run_folder = run_in_file_system(
        tmp_path, "size=100k", "", *SHORT_RUN, "--in-process", "--fault", "mute:joint_3@1"
    )
    assert_orderly_end(result, run_folder, code=1, warning="No space left on device")
    assert "joint_3" in result.out.partition("\nfault: ")[2].partition("\n")[0]


@pytest.mark.quiet
def test_record_on_full_disk_delays_no_tick_in_realtime(tmp_path: Path) -> None:
    arguments = [*LONG_RUN, "--duration", "5"]
    result, run_folder = run_in_file_system(tmp_path, "size=100k", "", *arguments)
    assert_orderly_end(result, run_folder, code=3, warning="No space left on device")
    duration = re.search(r"time +5\.00 s in (\d+\.\d+) s", result.out)
    assert duration is not None, result.out
    assert float(duration[1]) == pytest.approx(5.0, abs=0.1)


SLOW_DISK_CODE = '''
"""Makes writing to regular files slow in every process that finds this module: a slow disk, or one that hangs."""

import os
import re
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
def hang_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give every process of a run a slow disk; provide the file whose existence blocks the disk."""
    (tmp_path / "slow").mkdir()
    (tmp_path / "slow" / "sitecustomize.py").write_text(SLOW_DISK_CODE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "slow"))
    monkeypatch.setenv("SLOW_DISK_HANGS", str(tmp_path / "hangs"))
    return tmp_path / "hangs"


@pytest.mark.slow
def test_record_on_slow_disk_is_complete_and_delays_no_tick(
    tmp_path: Path, hang_file: Path
) -> None:
    result, summary = run_to_summary(tmp_path / "run", *LONG_RUN, "--duration", "4")
    assert result.code == 0, result.out
    assert "warning:" not in result.out
    assert summary.wall_s == pytest.approx(4.0, abs=0.1)
    assert summary.overruns < 10
    assert summary.missing == []
    assert len(RunRecord.load(tmp_path / "run").time_s) == 200
    assert not hang_file.exists()


@pytest.mark.quiet
def test_record_on_hanging_disk_delays_nothing(tmp_path: Path, hang_file: Path) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG_RUN, "--stay") as run:
        wait_until(lambda: (tmp_path / "run" / "host.json").is_file(), "the first numbers on disk")
        hang_file.touch()
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            tick_before = read_newest_status(session).tick
            time.sleep(1.0)
            assert read_newest_status(session).tick - tick_before >= 0.8 * RATE_HZ
            start_s = time.monotonic()
            answer = session.send_request(keys.ESTOP, EstopRequest(requester="anna"))
            assert answer.ok
            assert answer.lifecycle == "estop"
            assert time.monotonic() - start_s < 3.0
            assert "not stored yet" in answer.reason or (tmp_path / "run" / ESTOP).exists()
            assert session.send_request(keys.LIFECYCLE, LifecycleRequest(action="finish")).ok
        assert run.end(30.0) == 1, run.printed()
        assert "the disk has not answered" in run.printed()
        assert "Traceback" not in run.printed()
