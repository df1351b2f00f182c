"""How long `snakesim status` tries to connect: once where nothing can listen yet, longer where something may."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.local_registry import LocalRobot
from snakesim_hal.network.session import ConnectionSettings, Session
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S
from snakesim_operator.robot_commands import status

HERE = "tcp/127.0.0.1:7461"
ELSEWHERE = "tcp/10.0.0.1:7447"


@pytest.mark.parametrize(
    ("endpoint", "runs_here", "seconds"),
    [(HERE, False, 0.0), (HERE, True, CONNECT_TIMEOUT_S), (ELSEWHERE, False, CONNECT_TIMEOUT_S)],
)
def test_one_attempt_is_enough_on_loopback(
    endpoint: str, runs_here: bool, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[float] = []

    @contextmanager
    def refuse(_link: ConnectionSettings, connect_timeout_s: float) -> Iterator[Session]:
        tried.append(connect_timeout_s)
        raise NotConnectedError("nothing listens")
        yield

    monkeypatch.setattr(status, "open_session", refuse)
    robot = LocalRobot(
        namespace="planar13",
        robot="planar13",
        backend="sim",
        endpoint=HERE,
        stop_host="127.0.0.1",
        stop_port=9,
        pid=1,
    )
    monkeypatch.setattr(
        RobotSelection, "list_local_robots", lambda _self: [robot] if runs_here else []
    )
    assert status.print_status(RobotSelection(endpoint)) == 1
    assert tried == [seconds]
