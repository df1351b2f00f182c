"""Processes of a run, from the outside."""

import signal
import time

import pytest

from snakesim_operator.run.children import start_child


@pytest.mark.parametrize("after_s", [0.0, 0.02, 0.1])
def test_an_interrupt_while_a_child_starts_leaves_no_traceback(after_s: float) -> None:
    said = bytearray()
    child = start_child("control", ["snakesim_hal.programs.service_program", "control", "--help"], said.extend)
    time.sleep(after_s)
    child.process.send_signal(signal.SIGINT)
    assert child.process.wait(30) == 0, child.output.last_lines()
    assert child.output.last_lines()
    assert b"Traceback" not in said
