"""The measured force of a contact is its mean over 50 ms."""

import pytest

from snakesim_hal.model.measured_force import MeasuredForce


def test_measured_force_of_blow_equals_push_of_same_impulse() -> None:
    blow = MeasuredForce(0.002)
    push = MeasuredForce(0.002)
    for step in range(25):
        blow.add_sample({"peg": 100.0} if step == 3 else {})
        push.add_sample({"peg": 4.0})
    assert blow.max_n == pytest.approx(4.0)
    assert push.max_n == pytest.approx(4.0)


def test_measured_force_of_each_contact_expires_after_50_ms() -> None:
    measured_force = MeasuredForce(0.01)
    for _ in range(5):
        measured_force.add_sample({("peg_0", 1): 6.0, ("peg_1", 1): 9.0, ("peg_1", 2): 5.0})
    assert measured_force.max_n == pytest.approx(9.0)
    for _ in range(4):
        measured_force.add_sample({})
    assert measured_force.max_n == pytest.approx(9.0 / 5)
    measured_force.add_sample({})
    assert measured_force.max_n == 0.0
