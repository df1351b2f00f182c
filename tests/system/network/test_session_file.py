"""A Zenoh session file decides how a process connects; settings that SnakeSIM depends on are refused."""

import json
from pathlib import Path

import pytest
import zenoh

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.network.router import open_router
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.session_file import read_session
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

NO_SCOUTING = "scouting: {multicast: {enabled: false}, gossip: {enabled: false}}"


def write_session_file(folder: Path, text: str) -> Path:
    """Write `lab.json5` into a folder and return its path."""
    path = folder / "lab.json5"
    path.write_text(text)
    return path


def test_session_file_connects_sessions_and_stock_zenoh_at_router(tmp_path: Path) -> None:
    endpoint = find_free_endpoint()
    router = tmp_path / "router.json5"
    router.write_text(f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}}, {NO_SCOUTING}}}')
    path = write_session_file(
        tmp_path, f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, {NO_SCOUTING}}}'
    )
    link = ConnectionSettings.from_session_file(read_session(path), "worm")
    assert link.endpoint == endpoint
    assert link.namespace == "worm"
    with (
        raises_error(NotConnectedError, code="certificate/rejected", field="lab.json5"),
        open_session(link, connect_timeout_s=0.1),
    ):
        pass
    with (
        open_router(router),
        open_session(link) as snakesim_session,
        zenoh.open(zenoh.Config.from_file(path)) as stock_session,
    ):
        snakesim_session.declare_alive("control")
        wait_until(
            lambda: list_tokens(stock_session) == ["worm/alive/control"],
            "the stock session sees the token of SnakeSIM's session",
            20.0,
        )


def list_tokens(session: zenoh.Session) -> list[str]:
    """Return the keys of the liveliness tokens that a session sees."""
    return [
        str(reply.ok.key_expr) for reply in session.liveliness().get("**") if reply.ok is not None
    ]


@pytest.mark.parametrize(
    "text",
    [
        '{connect: {endpoints: ["tcp/10.0.0.1:7447"]}}',
        '{mode: "peer", connect: {endpoints: ["tcp/10.0.0.1:7447"]}}',
        '{mode: "client"}',
        '{mode: "client", connect: {endpoints: ["tcp/10.0.0.1:0"]}}',
        '{mode: "client", connect: {endpoints: ["tcp/10.0.0.1:7447"]}, scouting: {gossip: {enabled: true}}}',
        '{mode: "client", connect: {endpoints: ["tcp/10.0.0.1:7447"]}, listen: {endpoints: ["tcp/0.0.0.0:1"]}}',
        '{mode: "client", connect: {endpoints: ["tcp/10.0.0.1:7447"]}, namespace: "a b"}',
        '{mode: "client", connct: {}}',
        "{mode: ",
    ],
)
def test_session_file_with_forbidden_setting_is_refused_by_name(text: str, tmp_path: Path) -> None:
    with raises_error(
        ConfigError, code=("network/invalid-address", "network/session-file"), field="lab.json5"
    ):
        read_session(write_session_file(tmp_path, text))


def test_session_file_with_namespace_refuses_another_robot(tmp_path: Path) -> None:
    settings = {
        "mode": "client",
        "connect": {"endpoints": ["tcp/10.0.0.1:7447"]},
        "namespace": "worm",
    }
    session = read_session(write_session_file(tmp_path, json.dumps(settings)))
    assert ConnectionSettings.from_session_file(session).namespace == "worm"
    assert ConnectionSettings.from_session_file(session, "worm").namespace == "worm"
    with raises_error(ConfigError, code="network/session-file", field="worm"):
        ConnectionSettings.from_session_file(session, "eel")
