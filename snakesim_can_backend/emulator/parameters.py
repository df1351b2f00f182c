"""A module's parameters: present values, and those in its flash, which survive a restart."""

import math
from struct import Struct

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    PARAMETERS,
    Frame,
    ModuleParameter,
    Opcode,
    ParameterOperation,
    ParameterRange,
    ParameterResult,
    SafeMotion,
)

WHOLE = frozenset(
    (ModuleParameter.STOP_MODE, ModuleParameter.CONTACT_EVERY, ModuleParameter.IMU_EVERY, ModuleParameter.TAIL)
)
_single = Struct("<f")


def make_factory_defaults(rated_torque_nm: float, rated_speed_rad_s: float) -> dict[ModuleParameter, float]:
    """The flash of a new module. Gains are 0: a module that has not been configured holds nothing."""
    torque = min(rated_torque_nm, PARAMETERS[ModuleParameter.RATED_TORQUE].high)
    speed = min(rated_speed_rad_s, PARAMETERS[ModuleParameter.RATED_SPEED].high)
    return dict.fromkeys(ModuleParameter, 0.0) | {
        ModuleParameter.TORQUE_LIMIT: torque,
        ModuleParameter.SPEED_LIMIT: speed,
        ModuleParameter.ANGLE_LIMIT: PARAMETERS[ModuleParameter.ANGLE_LIMIT].high,
        ModuleParameter.WATCHDOG: 0.1,
        ModuleParameter.STOP_MODE: float(SafeMotion.DAMP),
        ModuleParameter.CONTACT_EVERY: 1.0,
        ModuleParameter.RATED_TORQUE: torque,
        ModuleParameter.RATED_SPEED: speed,
    }


class ParameterStore:
    """Reads, writes and saves; a write takes effect at once and is lost at a restart unless saved."""

    def __init__(self, flash: dict[ModuleParameter, float]) -> None:
        self._flash = dict(flash)
        self.values = dict(flash)

    def restart(self) -> None:
        """Reload the saved values."""
        self.values = dict(self._flash)

    def answer_request(self, node: int, data: bytes, armed: bool) -> Frame:
        """Carry out a ParameterRequest; returns the ParameterAnswer."""
        index, operation, raw = _read_request(data)
        parameter = ModuleParameter(index) if index in PARAMETERS else None
        result = ParameterResult.UNKNOWN_INDEX if parameter is None else self._do(parameter, operation, raw, armed)
        value = 0.0 if parameter is None else self.values[parameter]
        return _write_answer(node, (index, operation, result, int.from_bytes(_single.pack(value), "little")))

    def _do(self, parameter: ModuleParameter, operation: int, raw: int, armed: bool) -> ParameterResult:
        if operation == ParameterOperation.READ:
            return ParameterResult.DONE
        if operation not in (ParameterOperation.WRITE, ParameterOperation.SAVE):
            return ParameterResult.UNKNOWN_OPERATION
        allowed = PARAMETERS[parameter]
        if not allowed.writable:
            return ParameterResult.READ_ONLY
        if armed:
            return ParameterResult.NOT_WHILE_ARMED
        if operation == ParameterOperation.SAVE:
            self._flash[parameter] = self.values[parameter]
            return ParameterResult.DONE
        value = clamp_to_range(allowed, _single.unpack((raw & 0xFFFFFFFF).to_bytes(4, "little"))[0])
        if value is None or (parameter in WHOLE and value != int(value)):
            return ParameterResult.OUT_OF_RANGE
        self.values[parameter] = value
        return ParameterResult.DONE


def clamp_to_range(allowed: ParameterRange, value: float) -> float | None:
    """The value if it is in range, None if not. On the bus bounds are single precision: 0.1 becomes slightly more."""
    if not math.isfinite(value):
        return None
    slack = 1e-6 * max(abs(allowed.low), abs(allowed.high))
    if not allowed.low - slack <= value <= allowed.high + slack:
        return None
    return min(max(value, allowed.low), allowed.high)


_read_request = load_layouts()[Opcode.PARAMETER_REQUEST].make_reader("index", "operation", "value")
_write_answer = load_layouts()[Opcode.PARAMETER_ANSWER].make_writer("index", "operation", "result", "value")
