"""The supervisor starts and stops the processes of a run, also while they start or if they ignore a signal."""

import signal
import socket
import time
from pathlib import Path

import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.session import ConnectionSettings
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.recorder_process import record_to_file
from snakesim_operator.run.ending import RunEnding
from snakesim_operator.run.processes import children
from snakesim_operator.run.processes.children import start_child, stop_children
from snakesim_operator.run.processes.supervisor import RunSupervisor
from snakesim_operator.run.run_files import RunFiles
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

IGNORE_SIGTERM_CODE = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(60)
"""


def make_recorder_arguments(out: Path) -> list[str]:
    """Make the command line of a recorder whose network is never opened."""
    endpoint = find_free_endpoint()
    return [
        "snakesim_operator.recording.recorder_process",
        "triplet",
        "--endpoint",
        endpoint,
        "--out",
        str(out),
    ]


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.1])
def test_child_interrupted_while_it_starts_prints_no_traceback(delay_s: float) -> None:
    printed = bytearray()
    child = start_child(
        "control", ["snakesim_hal.programs.service_program", "control", "--help"], printed.extend
    )
    time.sleep(delay_s)
    child.process.send_signal(signal.SIGINT)
    assert child.process.wait(30) == 0, child.output.last_lines()
    assert child.output.last_lines()
    assert b"Traceback" not in printed


def test_recorder_that_waits_for_a_network_ends_at_once(tmp_path: Path) -> None:
    """The network of a run that ends at once is gone before a slow recorder has started."""
    recorder = start_child("recorder", make_recorder_arguments(tmp_path), lambda _output: None)
    time.sleep(3.0)  # now it waits for the network; on a slow computer it still starts
    stop_children([recorder])
    assert recorder.process.returncode == -signal.SIGTERM
    assert not recorder.was_killed
    assert not (tmp_path / RECORDING_FILENAME).exists(), "the recorder created a recording"


def test_record_to_file_stopped_before_network_opens_raises_error(tmp_path: Path) -> None:
    with raises_error(NotConnectedError, code="network/nothing-listens"):
        record_to_file(
            ConnectionSettings(find_free_endpoint(), "worm"),
            tmp_path / RECORDING_FILENAME,
            lambda: False,
        )
    assert not (tmp_path / RECORDING_FILENAME).exists()


def test_child_ended_while_it_starts_is_reported(tmp_path: Path) -> None:
    printed: list[str] = []
    files = RunFiles(tmp_path, printed.append)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stop_port:
        supervisor = RunSupervisor(files, RunEnding(), printed.append, stop_port)
        supervisor.start("recorder", make_recorder_arguments(tmp_path), vital=False)
        supervisor.end_all_processes()
    files.close()
    assert supervisor.losses_by_process == {
        "recorder": "recorder had not started when the run ended"
    }
    assert printed == [
        "warning: recorder had not started when the run ended: there is nothing of it"
    ]


def test_child_that_does_not_end_is_killed_and_described(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ignore_sigterm.py").write_text(IGNORE_SIGTERM_CODE)
    monkeypatch.setattr(children, "STOP_TIMEOUT_S", 0.2)
    printed = bytearray()
    child = start_child(
        "control", ["ignore_sigterm"], printed.extend, extra_env={"PYTHONPATH": str(tmp_path)}
    )
    wait_until(lambda: b"ready" in printed, "the child ignores SIGTERM")
    stop_children([child])
    assert (
        child.describe_exit()
        == "control was killed: it had not ended 0.2 s after the request to end"
    )


def test_child_is_not_killed_while_its_file_grows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes_bytes = iter([0, 100, 200, 200])
    (tmp_path / "ignore_sigterm.py").write_text(IGNORE_SIGTERM_CODE)
    monkeypatch.setattr(children, "STOP_TIMEOUT_S", 0.2)
    monkeypatch.setattr(
        children.ChildProcess, "measure_written_bytes", lambda _child: next(sizes_bytes)
    )
    printed = bytearray()
    child = start_child(
        "recorder", ["ignore_sigterm"], printed.extend, extra_env={"PYTHONPATH": str(tmp_path)}
    )
    wait_until(lambda: b"ready" in printed, "the child ignores SIGTERM")
    stop_children([child])
    assert list(sizes_bytes) == [], "the child was killed before its file stopped growing"
    assert child.was_killed


def test_child_without_file_has_written_nothing(tmp_path: Path) -> None:
    child = start_child(
        "recorder", ["ends_at_once"], lambda _output: None, written_file=tmp_path / "recording.mcap"
    )
    assert child.measure_written_bytes() == 0
    (tmp_path / "recording.mcap").write_bytes(b"abc")
    assert child.measure_written_bytes() == 3
    stop_children([child])
