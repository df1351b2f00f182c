"""The benches that our own backends have to stand on."""

import os
from typing import Any

import pytest

from snakesim_can_backend.protocol.definitions import Frame, node_of
from snakesim_hal.conformance.bench import Bench

VCAN = "SNAKESIM_VCAN"  # set by deploy/vm/with_vcan.py: the kernel here has vcan0, and it is up
ABOUT_OPENINGS = ("same_seed", "closing_twice", "opens_again")
ON_VCAN = ('backend.channels=["vcan0"]', 'backend.twins="process"')


@pytest.hookimpl(optionalhook=True)
def pytest_snakesim_benches() -> list[Bench]:
    """Simulator, CAN on a bus inside the process, CAN on the kernel's virtual bus with modules as processes."""
    if os.environ.get(VCAN):  # `make test-vcan`
        return [Bench("can-vcan", "can", sets=ON_VCAN, mute=cut_off)]
    return [Bench("sim", "sim"), Bench("can-virtual", "can", mute=cut_off)]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """In an emulated machine an opening takes half a minute: clauses that are about openings are left to `-m slow`.

    The other clauses open and close the bus several times anyway.
    """
    for item in items:
        if os.environ.get(VCAN) == "guest" and any(words in item.name for words in ABOUT_OPENINGS):
            item.add_marker(pytest.mark.slow)


def cut_off(backend: Any, joint: int) -> None:
    """From now on the driver hears nothing of a joint's module."""
    take = backend._reading.take

    def hear(frame: Frame) -> None:
        if node_of(frame.id) != joint + 1:
            take(frame)

    backend._reading.take = hear
