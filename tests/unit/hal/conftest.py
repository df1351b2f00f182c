"""A network of two, and threads that share one interpreter as if they were processes."""

import sys
from collections.abc import Iterator

import pytest

from snakesim_hal.network.session import Session
from tests.unit.hal.local_network import meeting


@pytest.fixture
def sessions() -> Iterator[tuple[Session, Session]]:
    with meeting("worm", "worm") as (here, there):
        yield here, there


@pytest.fixture
def quick_threads() -> Iterator[None]:
    """Host and client share one interpreter here; in real life they are processes."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)
    yield
    sys.setswitchinterval(before)
