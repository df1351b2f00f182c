"""Texts of injected faults are parsed and refused. `driver/test_faults_seen.py` tests their effects."""

import pytest

from snakesim_can_backend.emulator.faults import parse_fault
from snakesim_drivers.emulation.emulator_control import format_typed_fault, parse_typed_fault
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_testing.messages import raises_error


def test_emulator_typed_fault_starts_or_ends_immediately():
    fault = FaultInjection("mute", "joint_2")
    assert parse_typed_fault("mute joint_2\n") == (fault, True)
    assert parse_typed_fault("mute joint_2 off") == (fault, False)
    assert parse_typed_fault("cut bus_1") == (FaultInjection("cut", "bus_1"), True)
    for begins in (True, False):
        assert parse_typed_fault(format_typed_fault(fault, begins=begins)) == (fault, begins)


@pytest.mark.parametrize(
    "text", ["mute", "mute joint_2 on", "boil joint_1", "mute joint_2=1", "x" * 400]
)
def test_emulator_typed_fault_of_another_form_is_refused(text: str):
    with raises_error(ConfigError, code="injection/unknown-fault"):
        parse_typed_fault(text)


@pytest.mark.parametrize(
    "text",
    [
        "mote:joint_3@2",
        "mute:joint_5@2",
        "wrong:joint_1@1",
        "kill:control@1",
    ],
)
def test_emulator_invalid_fault_text_is_refused(text: str):
    with raises_error(ConfigError, code=("injection/unknown-fault", "injection/unknown-target")):
        parse_fault(text, 4)
