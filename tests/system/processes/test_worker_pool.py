"""Worker processes: what they give back, what is left of them, and that nothing can connect to them."""

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


def exit_unless(file: str) -> str:
    """End this process, but the second time."""
    if not Path(file).exists():
        Path(file).touch()
        os._exit(1)
    return "again"


def listening_sockets() -> list[object]:
    """Every TCP socket of this process and its children that somebody could connect to."""
    driver_type = [psutil.Process(), *psutil.Process().children(recursive=True)]
    sockets = [socket for one in driver_type for socket in one.net_connections("tcp")]
    return [socket for socket in sockets if socket.status == psutil.CONN_LISTEN]


def test_calls_are_spread_over_processes_to_which_nothing_can_connect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    abandoned = tmp_path / f"{FOLDER_PREFIX}killed"
    abandoned.mkdir()
    monkeypatch.setattr(worker_pool, "MAX_UNLOCKED_S", 0.0)
    before = listening_sockets()
    with WorkerPool(2) as pool:
        assert pool.run_and_collect(math.sqrt, [(4.0,), (9.0,), (16.0,)]) == [2.0, 3.0, 4.0]
        assert listening_sockets() == before
        (folder,) = tmp_path.glob(f"{FOLDER_PREFIX}*")
        assert Path(pool.run_and_collect(tempfile.mkdtemp, [()])[0]).is_relative_to(folder)
        assert pool.run_and_collect(os.nice, [(0,)]) == [max(os.nice(0), 10)], "others come first"
        children = psutil.Process().children()
        assert len(children) == 2
    assert not any(child.is_running() for child in children)
    assert not list(tmp_path.iterdir()), "temporary files of the workers"


def test_a_call_that_fails_costs_no_other(tmp_path: Path) -> None:
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
        assert pool.run_and_collect(exit_unless, [(str(tmp_path / "tried"),)]) == ["again"]
