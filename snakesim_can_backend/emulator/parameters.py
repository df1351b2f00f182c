"""A module's parameters: present values, and those in its flash, which survive a restart."""

import math
from struct import Struct

from snakesim_can_backend.protocol.codec import codec
from snakesim_can_backend.protocol.definitions import (
    PARAMETERS,
    Frame,
    Opcode,
    Operation,
    Parameter,
    ParameterRange,
    Result,
    SafeMotion,
)

WHOLE = frozenset((Parameter.STOP_MODE, Parameter.CONTACT_EVERY, Parameter.IMU_EVERY, Parameter.TAIL))
_single = Struct("<f")


def from_factory(rated_torque_nm: float, rated_speed_rad_s: float) -> dict[Parameter, float]:
    """The flash of a new module. Gains are 0: a module that has not been configured holds nothing."""
    torque = min(rated_torque_nm, PARAMETERS[Parameter.RATED_TORQUE].high)
    speed = min(rated_speed_rad_s, PARAMETERS[Parameter.RATED_SPEED].high)
    return dict.fromkeys(Parameter, 0.0) | {
        Parameter.TORQUE_LIMIT: torque,
        Parameter.SPEED_LIMIT: speed,
        Parameter.ANGLE_LIMIT: PARAMETERS[Parameter.ANGLE_LIMIT].high,
        Parameter.WATCHDOG: 0.1,
        Parameter.STOP_MODE: float(SafeMotion.DAMP),
        Parameter.CONTACT_EVERY: 1.0,
        Parameter.RATED_TORQUE: torque,
        Parameter.RATED_SPEED: speed,
    }


class Parameters:
    """Reads, writes and saves; a write takes effect at once and is lost at a restart unless saved."""

    def __init__(self, flash: dict[Parameter, float]) -> None:
        self._flash = dict(flash)
        self.values = dict(flash)

    def restart(self) -> None:
        """Reload the saved values."""
        self.values = dict(self._flash)

    def answer(self, node: int, data: bytes, armed: bool) -> Frame:
        """Carry out a ParameterRequest; returns the ParameterAnswer."""
        index, operation, raw = _read_request(data)
        parameter = Parameter(index) if index in PARAMETERS else None
        result = Result.UNKNOWN_INDEX if parameter is None else self._do(parameter, operation, raw, armed)
        value = 0.0 if parameter is None else self.values[parameter]
        return _write_answer(node, (index, operation, result, int.from_bytes(_single.pack(value), "little")))

    def _do(self, parameter: Parameter, operation: int, raw: int, armed: bool) -> Result:
        if operation == Operation.READ:
            return Result.DONE
        if operation not in (Operation.WRITE, Operation.SAVE):
            return Result.UNKNOWN_OPERATION
        allowed = PARAMETERS[parameter]
        if not allowed.writable:
            return Result.READ_ONLY
        if armed:
            return Result.NOT_WHILE_ARMED
        if operation == Operation.SAVE:
            self._flash[parameter] = self.values[parameter]
            return Result.DONE
        value = within(allowed, _single.unpack((raw & 0xFFFFFFFF).to_bytes(4, "little"))[0])
        if value is None or (parameter in WHOLE and value != int(value)):
            return Result.OUT_OF_RANGE
        self.values[parameter] = value
        return Result.DONE


def within(allowed: ParameterRange, value: float) -> float | None:
    """The value if it is in range, None if not. On the bus bounds are single precision: 0.1 becomes slightly more."""
    if not math.isfinite(value):
        return None
    slack = 1e-6 * max(abs(allowed.low), abs(allowed.high))
    if not allowed.low - slack <= value <= allowed.high + slack:
        return None
    return min(max(value, allowed.low), allowed.high)


_read_request = codec()[Opcode.PARAMETER_REQUEST].reader("index", "operation", "value")
_write_answer = codec()[Opcode.PARAMETER_ANSWER].writer("index", "operation", "result", "value")
