"""The texts of faults on request; what they do to modules is in `driver/test_faults_seen.py`."""

import pytest

from snakesim_can_backend.emulator.faults import format_typed_fault, parse_fault, parse_typed_fault
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import Injection


def test_what_is_typed_is_a_fault_that_begins_or_ends_now():
    fault = Injection("mute", "joint_2", 7.0)
    assert parse_typed_fault("mute joint_2\n", 4, 7.0) == (fault, True)
    assert parse_typed_fault("mute joint_2 off", 4, 7.0) == (fault, False)
    for begins in (True, False):
        assert parse_typed_fault(format_typed_fault(fault, begins=begins), 4, 7.0) == (fault, begins)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mote:joint_3@2", "knows no 'mote', only mute, freeze"),
        ("mute:joint_5@2", "no joint_5; this run has joint_1 to joint_4"),
        ("wrong:joint_1@1", "modules support mute, freeze, reboot"),
        ("kill:control@1", "modules support mute, freeze, reboot"),
    ],
)
def test_wrong_texts_are_told_what_is_allowed(text: str, message: str):
    with pytest.raises(ConfigError, match=message):
        parse_fault(text, 4)
