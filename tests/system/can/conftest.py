"""Tests in this folder need a real SocketCAN bus, vcan0; the fixture `channel` provides its name.

They are skipped if there is no bus. In CI a missing bus is an error, because skipped tests would hide that the bus
was not tested.
"""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_testing.can.interface import assert_succeeded, run_ip

CHANNEL = "vcan0"
HERE = Path(__file__).parent
RUN_COMMAND = "python deploy/vm/with_vcan.py -- .venv/bin/python -m pytest tests/system/can"
REQUIRING_VARIABLES = ("CI", "SNAKESIM_NEED_VCAN")


def find_bus_problem(channel: str) -> str | None:
    """Return why no raw CAN socket can be bound to the interface, or None if one can."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw_socket:
            raw_socket.bind((channel,))
    except OSError as error:
        return f"no CAN socket on {channel}: {error.strerror}"
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    can_tests = [item for item in items if HERE in item.path.parents]
    if not can_tests:
        return
    for item in can_tests:
        item.add_marker(pytest.mark.can)
    reason = find_bus_problem(CHANNEL)
    if reason is None:
        return
    for name in REQUIRING_VARIABLES:
        if os.environ.get(name, "") not in ("", "0", "false"):
            raise pytest.UsageError(
                f"{reason}, and {name} is set: tests/system/can may not be skipped. Run: {RUN_COMMAND}"
            )
    for item in can_tests:
        item.add_marker(pytest.mark.skip(reason=f"{reason}. Run: {RUN_COMMAND}"))


@pytest.fixture
def channel() -> str:
    """Provide the name of a CAN interface that is up."""
    return CHANNEL


@pytest.fixture
def raw_socket(channel: str) -> Iterator[socket.socket]:
    """Provide a raw CAN socket on the bus, with a timeout of two seconds."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as opened:
        opened.settimeout(2.0)
        opened.bind((channel,))
        yield opened


@pytest.fixture
def spare_channel() -> Iterator[str]:
    """Provide an interface that the test may take down."""
    name = f"vcan{os.getpid() % 100_000}"
    added = run_ip("link", "add", name, "type", "vcan")
    if added.returncode:
        pytest.skip(f"may not add an interface here: {added.stderr.strip()}")
    assert_succeeded(run_ip("link", "set", name, "up"))
    yield name
    run_ip("link", "delete", name)
