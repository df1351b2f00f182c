"""A pool of worker processes returns results, leaves no files or processes, and listens on no socket."""

import math
import os
import tempfile
from pathlib import Path

import psutil
import pytest

from snakesim_operator.base import worker_pool
from snakesim_operator.base.worker_pool import (
    FOLDER_PREFIX,
    CallFailure,
    CallResult,
    CallTookTooLongError,
    WorkerDiedError,
    WorkerPool,
)


def exit_at_first_call(file: str) -> str:
    """End this process in the first call, and return a text in the second. The file marks the first call."""
    if not Path(file).exists():
        Path(file).touch()
        os._exit(1)
    return "again"


def list_listening_sockets() -> list[object]:
    """Return every TCP socket of this process and its children that accepts connections."""
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    sockets = [socket for process in processes for socket in process.net_connections("tcp")]
    return [socket for socket in sockets if socket.status == psutil.CONN_LISTEN]


def test_worker_pool_runs_calls_in_processes_without_listening_sockets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    abandoned_folder = tmp_path / f"{FOLDER_PREFIX}killed"
    abandoned_folder.mkdir()
    monkeypatch.setattr(worker_pool, "MAX_UNLOCKED_S", 0.0)
    sockets_before = list_listening_sockets()
    with WorkerPool(2) as pool:
        assert pool.run_and_collect(math.sqrt, [(4.0,), (9.0,), (16.0,)]) == [2.0, 3.0, 4.0]
        assert list_listening_sockets() == sockets_before
        (folder,) = tmp_path.glob(f"{FOLDER_PREFIX}*")
        assert Path(pool.run_and_collect(tempfile.mkdtemp, [()])[0]).is_relative_to(folder)
        # The workers have a lower priority than other processes.
        assert pool.run_and_collect(os.nice, [(0,)]) == [max(os.nice(0), 10)]
        children = psutil.Process().children()
        assert len(children) == 2
    assert not any(child.is_running() for child in children)
    assert not list(tmp_path.iterdir()), "temporary files of the workers remain"


@pytest.mark.heavy
def test_worker_pool_call_that_fails_affects_no_other_call(tmp_path: Path) -> None:
    calls = [("os._exit(3)",), ("1 / 0",), ("time.sleep(60)",), ("1 + 1",)]
    with WorkerPool(2) as pool:
        outcomes = dict(pool.run_calls(eval, calls, timeout_s=5.0))
        assert outcomes[3] == CallResult(2)
        errors = [
            outcome.error
            for outcome in map(outcomes.get, range(3))
            if isinstance(outcome, CallFailure)
        ]
        assert [type(error) for error in errors] == [
            WorkerDiedError,
            ZeroDivisionError,
            CallTookTooLongError,
        ]
        assert pool.run_and_collect(exit_at_first_call, [(str(tmp_path / "tried"),)]) == ["again"]
