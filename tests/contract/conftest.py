"""The benches that our own backends have to stand on."""

import os
from typing import Any

import pytest

from snakesim_can_backend.protocol.definitions import Frame, node_of
from snakesim_hal.conformance.bench import Bench

VCAN = "SNAKESIM_VCAN"  # set by deploy/vm/with_vcan.py: the kernel here has vcan0, and it is up
IN_AN_EMULATED_MACHINE = (  # an opening takes half a minute there: `-m ""` runs the other clauses, too
    "every_joint_is_valid",
    "position_mode",
    "leaving_armed",
    "a_silent_joint",
    "falls_silent",
    "a_closed_backend",
)
ON_VCAN = ('backend.channels=["vcan0"]', 'backend.twins="process"')


@pytest.hookimpl(optionalhook=True)
def pytest_snakesim_benches() -> list[Bench]:
    """Simulator, CAN on a bus inside the process, CAN on the kernel's virtual bus with modules as processes."""
    if os.environ.get(VCAN):  # `make test-vcan`
        return [Bench("can-vcan", "can", sets=ON_VCAN, mute=cut_off)]
    return [Bench("sim", "sim"), Bench("can-virtual", "can", mute=cut_off)]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of the contract on the kernel's bus, what depends on that bus; the whole of it is for `make test-all`."""
    if os.environ.get(VCAN) != "guest":
        return
    for item in items:
        if item.path.name == "test_contract.py" and not any(words in item.name for words in IN_AN_EMULATED_MACHINE):
            item.add_marker(pytest.mark.slow)


def cut_off(backend: Any, joint: int) -> None:
    """From now on the driver hears nothing of a joint's module."""
    take = backend._reading.take

    def hear(frame: Frame) -> None:
        if node_of(frame.id) != joint + 1:
            take(frame)

    backend._reading.take = hear
