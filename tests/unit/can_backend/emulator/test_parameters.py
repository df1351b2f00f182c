"""Parameters by the bus: ranges, refusals, what is kept."""

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


def ask(module, *request, **given):
    module.frames.clear()
    module.receive(make_parameter_request(*request, **given), BOOTED_AT_US)
    [answer] = decode_frames_of(module.frames, Opcode.PARAMETER_ANSWER)
    return ParameterResult(int(answer["result"])), answer["value"]


@pytest.mark.parametrize("index", [p for p, r in PARAMETERS.items() if r.writable])
def test_parameter_range_ends_can_be_written_in_single_precision(index):
    module = boot_module()
    for end in (PARAMETERS[index].low, PARAMETERS[index].high):
        result, value = ask(module, index, end)
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
def test_what_is_wrong_is_refused_and_changes_nothing(index, value, result):
    module = boot_module()
    before = dict(module.parameters.values)
    assert ask(module, index, value)[0] == result
    assert module.parameters.values == before


def test_nan_is_refused():
    module = boot_module()
    good = make_parameter_request(ModuleParameter.DAMPING, 1.0)
    module.receive(CanFrame(good.id, good.data[:2] + struct.pack("<f", float("nan"))), BOOTED_AT_US)
    assert (
        decode_frames_of(module.frames, Opcode.PARAMETER_ANSWER)[0]["result"]
        == ParameterResult.OUT_OF_RANGE
    )


def test_an_armed_module_may_be_read_and_not_written():
    module = arm_module()
    assert ask(module, ModuleParameter.DAMPING, 1.0)[0] == ParameterResult.NOT_WHILE_ARMED
    assert (
        ask(module, ModuleParameter.DAMPING, operation=ParameterOperation.SAVE)[0]
        == ParameterResult.NOT_WHILE_ARMED
    )
    assert (
        ask(module, ModuleParameter.DAMPING, operation=ParameterOperation.READ)[0]
        == ParameterResult.DONE
    )
    assert ask(module, ModuleParameter.DAMPING, operation=3)[0] == ParameterResult.UNKNOWN_OPERATION
