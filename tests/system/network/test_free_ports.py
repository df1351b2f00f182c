"""Ports that are chosen now and bound later."""

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
PORTS_EACH = BLOCK_PORTS + 6  # more than one block
CHOOSE = f"""
from snakesim_hal.network.free_ports import find_free_port
print(*[find_free_port() for _ in range({PORTS_EACH})], flush=True)
input()
"""


def test_processes_that_choose_ports_at_the_same_time_get_different_ones() -> None:
    """All of them choose before any of them has bound a port."""
    choosing = [
        subprocess.Popen(
            make_python_command("-c", CHOOSE),
            env=make_child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(PROCESSES)
    ]
    try:
        chosen: list[int] = []
        for process in choosing:
            assert process.stdout is not None
            chosen += [int(port) for port in process.stdout.readline().split()]
    finally:
        for process in choosing:
            process.communicate("\n")
    assert len(set(chosen)) == PROCESSES * PORTS_EACH
    first_of_kernel = int(free_ports.LOCAL_RANGE.read_text().split()[0])
    assert min(chosen) >= FIRST_PORT
    assert max(chosen) < first_of_kernel, "the kernel may give it to any program"


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_port_that_another_program_uses_is_left_out(kind: socket.SocketKind) -> None:
    before = find_free_port()
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind((LOOPBACK, before + 1))
        if kind == socket.SOCK_STREAM:
            taken.listen()
        assert find_free_port() not in (before, before + 1)


def test_forked_process_does_not_get_the_ports_of_its_parent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = find_free_port()
    monkeypatch.setattr(os, "getpid", lambda: 1)
    assert (find_free_port() - FIRST_PORT) // BLOCK_PORTS != (before - FIRST_PORT) // BLOCK_PORTS


def test_when_all_ports_are_claimed_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_ports, "_ports", iter(()))
    monkeypatch.setattr(free_ports, "_read_first_local_port", lambda: FIRST_PORT)
    with raises_error(NotConnectedError, code="network/port-in-use", field="--endpoint"):
        find_free_port()
