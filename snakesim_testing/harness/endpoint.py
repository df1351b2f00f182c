"""Finds endpoints on the loopback interface that no process uses, and that no other test gets."""

from snakesim_hal.network.free_ports import find_free_port


def find_free_endpoint() -> str:
    """Return the address of an unused TCP port of the loopback interface, for a Zenoh network."""
    return f"tcp/127.0.0.1:{find_free_port()}"
