"""A module's reports as frames: numbers rounded to the steps of the bus, and clamped to their range."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_can_backend.protocol.codec import Signal, load_layouts
from snakesim_can_backend.protocol.definitions import Opcode
from snakesim_hal.base.arrays import Floats
from snakesim_hal.physics.physics_model import LinkLoad

UNTOUCHED = (0, 0, 0, 0, 0, 0)


class Rounder:
    """Raw numbers of one or more signals with the same layout except for their place."""

    def __init__(self, signal: Signal) -> None:
        self._offset, self._per_unit = signal.offset, 1.0 / signal.scale
        self._low, self._high = (round((end - signal.offset) / signal.scale) for end in (signal.low, signal.high))

    def to_raw(self, value: float) -> int:
        """The nearest step; NaN becomes 0."""
        if math.isnan(value):
            return 0
        return int(
            min(max(round(min(max((value - self._offset) * self._per_unit, -1e12), 1e12)), self._low), self._high)
        )

    def to_raw_array(self, values: Floats) -> list[int]:
        """The same for an array."""
        raw = np.nan_to_num((values - self._offset) * self._per_unit, posinf=1e12, neginf=-1e12)
        return np.clip(np.rint(raw), self._low, self._high).astype(np.int64).tolist()


@dataclass(slots=True)
class ModuleReadings:
    """One module's sensor readings at a Sync, in raw numbers."""

    angle: int
    velocity: int
    torque: int
    derated: bool = False
    contact: Sequence[int] = UNTOUCHED  # force x, y, z, along, bearing, touched
    tail_contact: Sequence[int] = UNTOUCHED
    gyro: Sequence[int] | None = None
    acceleration: Sequence[int] | None = None
    shaft_load: int | None = None


@dataclass(slots=True)
class ModuleHealth:
    """A module's internal measurements."""

    speed_rad_s: float = 0.0
    winding_c: float = 20.0
    board_c: float = 25.0
    voltage_v: float = 24.0
    current_a: float = 0.0
    leak: bool = False


def encode_contact(load: LinkLoad) -> tuple[int, int, int, int, int, int]:
    """The raw numbers of a Contact. A bearing wraps around: half a turn to either side is the same."""
    x, y, z = load.position_l
    fx, fy, fz = load.force_l
    return (
        FORCE.to_raw(fx),
        FORCE.to_raw(fy),
        FORCE.to_raw(fz),
        ALONG.to_raw(x),
        round(math.atan2(z, y) / BEARING_STEP),
        1,
    )


def encode_health(inside: ModuleHealth) -> tuple[int, int, int, int, int, int]:
    """The raw numbers of a Health."""
    leak = inside.leak
    return (
        VOLTAGE.to_raw(inside.voltage_v),
        CURRENT.to_raw(inside.current_a),
        MOTOR_C.to_raw(inside.winding_c),
        BOARD_C.to_raw(inside.board_c),
        int(leak),
        WATER.to_raw(100.0 if leak else 0.0),
    )


def _rounder(opcode: Opcode, signal: str) -> Rounder:
    return Rounder(load_layouts()[opcode].signals[signal])


ANGLE = _rounder(Opcode.JOINT_STATE, "angle")
VELOCITY = _rounder(Opcode.JOINT_STATE, "velocity")
TORQUE = _rounder(Opcode.JOINT_STATE, "torque")
FORCE = _rounder(Opcode.CONTACT, "force_x")
ALONG = _rounder(Opcode.CONTACT, "along")
BEARING_STEP = load_layouts()[Opcode.CONTACT].signals["bearing"].scale
RATE = _rounder(Opcode.GYRO, "rate_x")
ACCELERATION = _rounder(Opcode.ACCELEROMETER, "acceleration_x")
SHAFT_LOAD = _rounder(Opcode.SHAFT_LOAD, "torque")
VOLTAGE = _rounder(Opcode.HEALTH, "voltage")
CURRENT = _rounder(Opcode.HEALTH, "current")
MOTOR_C = _rounder(Opcode.HEALTH, "motor_temperature")
BOARD_C = _rounder(Opcode.HEALTH, "board_temperature")
WATER = _rounder(Opcode.HEALTH, "water")
