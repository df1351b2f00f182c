"""Parameters by the bus: ranges, refusals, what is kept."""

import struct

import pytest

from snakesim_can_backend.protocol.definitions import PARAMETERS, Frame, Opcode, Operation, Parameter, Result
from tests.unit.can_backend.emulator.rig import BOOTED, armed, booted, only, parameter


def ask(module, *request, **given):
    module.frames.clear()
    module.receive(parameter(*request, **given), BOOTED)
    [answer] = only(module.frames, Opcode.PARAMETER_ANSWER)
    return Result(int(answer["result"])), answer["value"]


@pytest.mark.parametrize("index", [p for p, r in PARAMETERS.items() if r.writable])
def test_both_ends_of_every_range_can_be_written_in_single_precision(index):
    module = booted()
    for end in (PARAMETERS[index].low, PARAMETERS[index].high):
        result, value = ask(module, index, end)
        assert result == Result.DONE and value == pytest.approx(end, rel=1e-6)


@pytest.mark.parametrize(
    ("index", "value", "result"),
    [
        (Parameter.WATCHDOG, 0.101, Result.OUT_OF_RANGE),
        (Parameter.WATCHDOG, 0.0, Result.OUT_OF_RANGE),
        (Parameter.IMU_EVERY, 1.5, Result.OUT_OF_RANGE),
        (Parameter.RATED_TORQUE, 1.0, Result.READ_ONLY),
        (0, 1.0, Result.UNKNOWN_INDEX),
        (14, 1.0, Result.UNKNOWN_INDEX),
    ],
)
def test_what_is_wrong_is_refused_and_changes_nothing(index, value, result):
    module = booted()
    before = dict(module.parameters.values)
    assert ask(module, index, value)[0] == result
    assert module.parameters.values == before


def test_nan_is_refused():
    module = booted()
    good = parameter(Parameter.DAMPING, 1.0)
    module.receive(Frame(good.id, good.data[:2] + struct.pack("<f", float("nan"))), BOOTED)
    assert only(module.frames, Opcode.PARAMETER_ANSWER)[0]["result"] == Result.OUT_OF_RANGE


def test_an_armed_module_may_be_read_and_not_written():
    module = armed()
    assert ask(module, Parameter.DAMPING, 1.0)[0] == Result.NOT_WHILE_ARMED
    assert ask(module, Parameter.DAMPING, operation=Operation.SAVE)[0] == Result.NOT_WHILE_ARMED
    assert ask(module, Parameter.DAMPING, operation=Operation.READ)[0] == Result.DONE
    assert ask(module, Parameter.DAMPING, operation=3)[0] == Result.UNKNOWN_OPERATION
