"""A network of two, and threads that share one interpreter as if they were processes."""

from collections.abc import Iterator

import pytest

from snakesim_hal.network.session import Session
from snakesim_testing.hal.local_network import connected_sessions, fast_thread_switching


@pytest.fixture
def sessions() -> Iterator[tuple[Session, Session]]:
    with connected_sessions("worm", "worm") as (here, there):
        yield here, there


@pytest.fixture
def quick_threads() -> Iterator[None]:
    with fast_thread_switching():
        yield
