"""An emulated module reads and writes parameters over the bus: ranges and refusals."""

import struct

import pytest

from snakesim_can_backend.protocol.definitions import (
    PARAMETERS,
    CanFrame,
    ModuleParameter,
    Opcode,
    ParameterOperation,
    ParameterResult,
)
from snakesim_testing.can.module_rig import (
    BOOTED_AT_US,
    arm_module,
    boot_module,
    decode_frames_of,
    make_parameter_request,
)


def request_parameter(module, *request, **fields):
    """Send a parameter request, and return the result and the value of the answer."""
    module.frames.clear()
    module.receive(make_parameter_request(*request, **fields), BOOTED_AT_US)
    [answer] = decode_frames_of(module.frames, Opcode.PARAMETER_ANSWER)
    return ParameterResult(int(answer["result"])), answer["value"]


@pytest.mark.parametrize(
    "index",
    [
        parameter_index
        for parameter_index, description in PARAMETERS.items()
        if description.writable
    ],
)
def test_parameter_range_ends_can_be_written_in_single_precision(index):
    module = boot_module()
    for end in (PARAMETERS[index].low, PARAMETERS[index].high):
        result, value = request_parameter(module, index, end)
        assert result == ParameterResult.DONE
        assert value == pytest.approx(end, rel=1e-6)


@pytest.mark.parametrize(
    ("index", "value", "result"),
    [
        (ModuleParameter.WATCHDOG, 0.101, ParameterResult.OUT_OF_RANGE),
        (ModuleParameter.WATCHDOG, 0.0, ParameterResult.OUT_OF_RANGE),
        (ModuleParameter.IMU_EVERY, 1.5, ParameterResult.OUT_OF_RANGE),
        (ModuleParameter.RATED_TORQUE, 1.0, ParameterResult.READ_ONLY),
        (0, 1.0, ParameterResult.UNKNOWN_INDEX),
        (14, 1.0, ParameterResult.UNKNOWN_INDEX),
    ],
)
def test_parameter_invalid_request_is_refused_and_changes_nothing(index, value, result):
    module = boot_module()
    before = dict(module.parameters.values)
    assert request_parameter(module, index, value)[0] == result
    assert module.parameters.values == before


def test_parameter_value_nan_is_refused():
    module = boot_module()
    valid_request = make_parameter_request(ModuleParameter.DAMPING, 1.0)
    module.receive(
        CanFrame(valid_request.id, valid_request.data[:2] + struct.pack("<f", float("nan"))),
        BOOTED_AT_US,
    )
    assert (
        decode_frames_of(module.frames, Opcode.PARAMETER_ANSWER)[0]["result"]
        == ParameterResult.OUT_OF_RANGE
    )


def test_parameter_of_armed_module_is_read_but_not_written():
    module = arm_module()
    assert (
        request_parameter(module, ModuleParameter.DAMPING, 1.0)[0]
        == ParameterResult.NOT_WHILE_ARMED
    )
    assert (
        request_parameter(module, ModuleParameter.DAMPING, operation=ParameterOperation.SAVE)[0]
        == ParameterResult.NOT_WHILE_ARMED
    )
    assert (
        request_parameter(module, ModuleParameter.DAMPING, operation=ParameterOperation.READ)[0]
        == ParameterResult.DONE
    )
    assert (
        request_parameter(module, ModuleParameter.DAMPING, operation=3)[0]
        == ParameterResult.UNKNOWN_OPERATION
    )
