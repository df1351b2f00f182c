"""The units of signals that come from messages."""

import pytest

from snakesim_hal.wire.messages import ControlState
from snakesim_operator.features.console.robot_data.signals import find_signal_unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        pytest.param("control.propulsion_n", "N", id="field-of-the-message"),
        pytest.param("control.custom.turn_rad_s", "rad/s", id="unit-in-the-name"),
        pytest.param("control.custom.gain", "1", id="no-unit-in-the-name"),
    ],
)
def test_signal_unit_of_control_state_is_known(name: str, unit: str) -> None:
    assert find_signal_unit(name, ControlState) == unit
