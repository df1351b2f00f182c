"""Endpoints on the loopback interface that no process uses."""

import socket


def free_port() -> int:
    """A TCP port of the loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """For a Zenoh network."""
    return f"tcp/127.0.0.1:{free_port()}"
