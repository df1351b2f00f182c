"""Tests in this folder need a real SocketCAN bus, vcan0; they find its name in the fixture `channel`.

Where there is none they are skipped, except in CI: a run there that met no bus has not tested what it says.
"""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_testing.can.interface import assert_succeeded, run_ip

CHANNEL = "vcan0"
HERE = Path(__file__).parent
RUN = "python deploy/vm/with_vcan.py -- .venv/bin/python -m pytest tests/system/can"
NEEDED = ("CI", "SNAKESIM_NEED_VCAN")


def no_bus_because(channel: str) -> str | None:
    """Why no raw CAN socket can be bound to the interface, or None if one can."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as tried:
            tried.bind((channel,))
    except OSError as error:
        return f"no CAN socket on {channel}: {error.strerror}"
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    ours = [item for item in items if HERE in item.path.parents]
    if not ours:
        return
    for item in ours:
        item.add_marker(pytest.mark.can)
    reason = no_bus_because(CHANNEL)
    if reason is None:
        return
    if asked_by := [name for name in NEEDED if os.environ.get(name, "") not in ("", "0", "false")]:
        raise pytest.UsageError(
            f"{reason}, and {asked_by[0]} is set: tests/system/can may not be skipped. Run: {RUN}"
        )
    for item in ours:
        item.add_marker(pytest.mark.skip(reason=f"{reason}. Run: {RUN}"))


@pytest.fixture
def channel() -> str:
    """The name of a CAN interface that is up."""
    return CHANNEL


@pytest.fixture
def raw_socket(channel: str) -> Iterator[socket.socket]:
    """A raw CAN socket on the bus, which gives up waiting after two seconds."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as opened:
        opened.settimeout(2.0)
        opened.bind((channel,))
        yield opened


@pytest.fixture
def spare_channel() -> Iterator[str]:
    """An interface of the test's own, which it may take down."""
    name = f"vcan{os.getpid() % 100_000}"
    added = run_ip("link", "add", name, "type", "vcan")
    if added.returncode:
        pytest.skip(f"may not add an interface here: {added.stderr.strip()}")
    assert_succeeded(run_ip("link", "set", name, "up"))
    yield name
    run_ip("link", "delete", name)
