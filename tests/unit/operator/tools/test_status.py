"""How long `snakesim status` tries to connect: only once on loopback without a local robot, otherwise longer."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.local_registry import LocalRobot
from snakesim_hal.network.session import ConnectionSettings, Session
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S
from snakesim_operator.robot_commands import status

LOCAL_ENDPOINT = "tcp/127.0.0.1:7461"
REMOTE_ENDPOINT = "tcp/10.0.0.1:7447"


@pytest.mark.parametrize(
    ("endpoint", "has_local_robot", "expected_timeout_s"),
    [
        (LOCAL_ENDPOINT, False, 0.0),
        (LOCAL_ENDPOINT, True, CONNECT_TIMEOUT_S),
        (REMOTE_ENDPOINT, False, CONNECT_TIMEOUT_S),
    ],
)
def test_status_tries_once_only_on_loopback_without_robot(
    endpoint: str,
    has_local_robot: bool,
    expected_timeout_s: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    timeouts_s: list[float] = []

    @contextmanager
    def refuse(_link: ConnectionSettings, connect_timeout_s: float) -> Iterator[Session]:
        """Store the timeout of this attempt, and fail."""
        timeouts_s.append(connect_timeout_s)
        raise NotConnectedError("nothing listens")
        yield

    monkeypatch.setattr(status, "open_session", refuse)
    robot = LocalRobot(
        namespace="planar13",
        robot="planar13",
        backend="sim",
        endpoint=LOCAL_ENDPOINT,
        stop_host="127.0.0.1",
        stop_port=9,
        pid=1,
    )
    monkeypatch.setattr(
        RobotSelection, "list_local_robots", lambda _self: [robot] if has_local_robot else []
    )
    assert status.print_status(RobotSelection(endpoint)) == 1
    assert timeouts_s == [expected_timeout_s]
