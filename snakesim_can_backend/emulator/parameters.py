"""A module's parameters: current values, and those in its flash, which survive a restart."""

import math
from struct import Struct

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    PARAMETERS,
    CanFrame,
    ModuleParameter,
    Opcode,
    ParameterOperation,
    ParameterRange,
    ParameterResult,
    SafeMotion,
)

INTEGER_PARAMETERS = frozenset(
    (
        ModuleParameter.STOP_MODE,
        ModuleParameter.CONTACT_EVERY,
        ModuleParameter.IMU_EVERY,
        ModuleParameter.TAIL,
    )
)
FACTORY_WATCHDOG_S = 0.1
FACTORY_CONTACT_EVERY = 1.0  # Syncs
RANGE_TOLERANCE = 1e-6  # of a range's largest bound; bounds have single precision on the bus
FLOAT_BYTES = 4
FLOAT_MASK = 0xFFFFFFFF
FLOAT32_STRUCT = Struct("<f")


def make_factory_defaults(
    rated_torque_nm: float, rated_speed_rad_s: float
) -> dict[ModuleParameter, float]:
    """Return the flash of a new module. Gains are 0: a module that has not been configured holds nothing."""
    torque_nm = min(rated_torque_nm, PARAMETERS[ModuleParameter.RATED_TORQUE].high)
    speed_rad_s = min(rated_speed_rad_s, PARAMETERS[ModuleParameter.RATED_SPEED].high)
    return dict.fromkeys(ModuleParameter, 0.0) | {
        ModuleParameter.TORQUE_LIMIT: torque_nm,
        ModuleParameter.SPEED_LIMIT: speed_rad_s,
        ModuleParameter.ANGLE_LIMIT: PARAMETERS[ModuleParameter.ANGLE_LIMIT].high,
        ModuleParameter.WATCHDOG: FACTORY_WATCHDOG_S,
        ModuleParameter.STOP_MODE: float(SafeMotion.DAMP),
        ModuleParameter.CONTACT_EVERY: FACTORY_CONTACT_EVERY,
        ModuleParameter.RATED_TORQUE: torque_nm,
        ModuleParameter.RATED_SPEED: speed_rad_s,
    }


class ParameterStore:
    """The parameters of one module. A write takes effect at once, and is lost at a restart unless it is saved."""

    def __init__(self, flash: dict[ModuleParameter, float]) -> None:
        self._flash = dict(flash)
        self.values = dict(flash)

    def restart(self) -> None:
        """Load the saved values."""
        self.values = dict(self._flash)

    def handle_request(self, node_id: int, data: bytes, is_armed: bool) -> CanFrame:
        """Read, write or save a parameter as a ParameterRequest demands, and return the response.

        Args:
            node_id: Node id of the module.
            data: Data bytes of the request.
            is_armed: Whether the module drives its motor; if so, no parameter can be changed.

        Returns:
            The response frame (`PARAMETER_ANSWER`), with the value of the parameter afterwards.
        """
        index, operation, raw_value = _decode_request(data)
        result = ParameterResult.UNKNOWN_INDEX
        value = 0.0
        if index in PARAMETERS:
            parameter = ModuleParameter(index)
            result = self._execute_operation(parameter, operation, raw_value, is_armed)
            value = self.values[parameter]
        # On the bus, a value is the bits of a float32 as an unsigned integer.
        current_raw_value = int.from_bytes(FLOAT32_STRUCT.pack(value), "little")
        return _encode_response(node_id, (index, operation, result, current_raw_value))

    def _execute_operation(
        self, parameter: ModuleParameter, operation: int, raw_value: int, is_armed: bool
    ) -> ParameterResult:
        match operation:
            case ParameterOperation.READ:
                return ParameterResult.DONE
            case ParameterOperation.WRITE | ParameterOperation.SAVE:
                pass
            case _:
                return ParameterResult.UNKNOWN_OPERATION
        if not PARAMETERS[parameter].writable:
            return ParameterResult.READ_ONLY
        if is_armed:
            return ParameterResult.NOT_WHILE_ARMED
        if operation == ParameterOperation.SAVE:
            self._flash[parameter] = self.values[parameter]
            return ParameterResult.DONE
        return self._write_value(parameter, raw_value)

    def _write_value(self, parameter: ModuleParameter, raw_value: int) -> ParameterResult:
        """Set the current value of a parameter to the float with these bits, if it is allowed."""
        (requested,) = FLOAT32_STRUCT.unpack(
            (raw_value & FLOAT_MASK).to_bytes(FLOAT_BYTES, "little")
        )
        value = clamp_to_range(PARAMETERS[parameter], requested)
        if value is None:
            return ParameterResult.OUT_OF_RANGE
        if parameter in INTEGER_PARAMETERS and value != int(value):
            return ParameterResult.OUT_OF_RANGE
        self.values[parameter] = value
        return ParameterResult.DONE


def clamp_to_range(allowed: ParameterRange, value: float) -> float | None:
    """Return a value within the range, or None if the value is out of range.

    A bound has single precision on the bus, where 0.1 becomes slightly more. So a value that is beyond a bound by no
    more than that becomes the bound.
    """
    if not math.isfinite(value):
        return None
    tolerance = RANGE_TOLERANCE * max(abs(allowed.low), abs(allowed.high))
    if not allowed.low - tolerance <= value <= allowed.high + tolerance:
        return None
    return min(max(value, allowed.low), allowed.high)


_decode_request = load_layouts()[Opcode.PARAMETER_REQUEST].make_reader(
    "index", "operation", "value"
)
_encode_response = load_layouts()[Opcode.PARAMETER_ANSWER].make_writer(
    "index", "operation", "result", "value"
)
