"""A free port stays reserved between the moment it is chosen and the moment a program binds it."""

import os
import socket
import subprocess

import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_hal.network import free_ports
from snakesim_hal.network.free_ports import BLOCK_PORTS, FIRST_PORT, LOOPBACK, find_free_port
from snakesim_testing.messages import raises_error

PROCESSES = 4
PORTS_EACH = BLOCK_PORTS + 6  # so that each process needs more than one block
CHOOSE_PORTS_CODE = f"""
from snakesim_hal.network.free_ports import find_free_port
print(*[find_free_port() for _ in range({PORTS_EACH})], flush=True)
input()
"""


def test_find_free_port_in_several_processes_returns_different_ports() -> None:
    """All processes choose before any of them has bound a port."""
    processes = [
        subprocess.Popen(
            make_python_command("-c", CHOOSE_PORTS_CODE),
            env=make_child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(PROCESSES)
    ]
    try:
        chosen: list[int] = []
        for process in processes:
            assert process.stdout is not None
            chosen += [int(port) for port in process.stdout.readline().split()]
    finally:
        for process in processes:
            process.communicate("\n")
    assert len(set(chosen)) == PROCESSES * PORTS_EACH
    first_ephemeral_port = int(free_ports.LOCAL_RANGE.read_text().split()[0])
    assert min(chosen) >= FIRST_PORT
    assert max(chosen) < first_ephemeral_port, "the kernel may give it to any program"


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_find_free_port_skips_port_of_another_program(kind: socket.SocketKind) -> None:
    chosen_port = find_free_port()
    next_port = chosen_port + 1
    with socket.socket(socket.AF_INET, kind) as other_program:
        if kind == socket.SOCK_STREAM:
            # As servers do: a connection that has ended recently does not keep them from binding the port.
            other_program.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other_program.bind((LOOPBACK, next_port))
        if kind == socket.SOCK_STREAM:
            other_program.listen()
        assert find_free_port() not in (chosen_port, next_port)


def test_find_free_port_in_forked_process_uses_another_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parent_port = find_free_port()
    monkeypatch.setattr(os, "getpid", lambda: 1)
    child_port = find_free_port()
    parent_block = (parent_port - FIRST_PORT) // BLOCK_PORTS
    child_block = (child_port - FIRST_PORT) // BLOCK_PORTS
    assert child_block != parent_block


def test_find_free_port_when_all_are_claimed_raises_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(free_ports, "_ports", iter(()))
    monkeypatch.setattr(free_ports, "_read_first_local_port", lambda: FIRST_PORT)
    with raises_error(NotConnectedError, code="network/port-in-use", field="--endpoint"):
        find_free_port()
