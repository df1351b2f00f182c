"""Fixtures of the system tests: two connected sessions, and threads that alternate as quickly as processes do."""

from collections.abc import Iterator

import pytest

from snakesim_hal.network.session import Session
from snakesim_testing.hal.local_network import connected_sessions, fast_thread_switching


@pytest.fixture
def sessions() -> Iterator[tuple[Session, Session]]:
    """Provide two Zenoh sessions in one namespace that are connected over loopback."""
    with connected_sessions("worm", "worm") as (first, second):
        yield first, second


@pytest.fixture
def quick_threads() -> Iterator[None]:
    """Let Python switch between threads more often than it does by default."""
    with fast_thread_switching():
        yield
