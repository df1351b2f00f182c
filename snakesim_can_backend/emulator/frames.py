"""The frames of an emulated module: readers and writers of raw numbers, and how measurements become raw numbers.

A raw number counts the steps of its signal on the bus. Layouts, steps and ranges come from the DBC file. Measurements
are rounded to the nearest step and clamped to the range of their signal.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_can_backend.protocol.codec import FrameSignal, load_layouts
from snakesim_can_backend.protocol.definitions import ModuleFault, Opcode
from snakesim_hal.base.arrays import Floats
from snakesim_hal.physics.physics_model import LinkLoad

NO_CONTACT = (0, 0, 0, 0, 0, 0)
MAX_STEPS = 1e12  # far beyond every signal's range, but still small enough for an int64
WET_PERCENT = 100.0  # water sensor of a module that leaks


@dataclass(slots=True)
class ModuleReadings:
    """The sensor readings of one module at a Sync, in raw numbers."""

    angle: int
    velocity: int
    torque: int
    derated: bool = False
    contact: Sequence[int] = NO_CONTACT  # force x, y, z, place along the link, bearing, touched
    tail_contact: Sequence[int] = NO_CONTACT
    gyro: Sequence[int] | None = None  # (3,)
    acceleration: Sequence[int] | None = None  # (3,)
    shaft_load: int | None = None


@dataclass(slots=True)
class EmulatedHealth:
    """The internal measurements of one module."""

    speed_rad_s: float = 0.0
    winding_c: float = 20.0
    board_c: float = 25.0
    voltage_v: float = 24.0
    current_a: float = 0.0
    leak: bool = False
    # Whether the joint's angle or the motor's current cannot be measured.
    sensor_failed: bool = False


class SignalRounder:
    """Converts measurements to raw numbers; for all signals that have the same step, offset and range."""

    def __init__(self, signal: FrameSignal) -> None:
        self._offset = signal.offset
        self._steps_per_unit = 1.0 / signal.scale
        self._min_raw = round((signal.low - signal.offset) / signal.scale)
        self._max_raw = round((signal.high - signal.offset) / signal.scale)

    def to_raw(self, value: float) -> int:
        """Return the nearest step within the range; NaN becomes 0."""
        if math.isnan(value):
            return 0
        steps = (value - self._offset) * self._steps_per_unit
        finite_steps = min(max(steps, -MAX_STEPS), MAX_STEPS)
        return int(min(max(round(finite_steps), self._min_raw), self._max_raw))

    def to_raw_array(self, values: Floats) -> list[int]:
        """Return the nearest steps within the range, as `to_raw` does for one value."""
        steps = (values - self._offset) * self._steps_per_unit
        finite_steps = np.nan_to_num(steps, posinf=MAX_STEPS, neginf=-MAX_STEPS)
        return (
            np.clip(np.rint(finite_steps), self._min_raw, self._max_raw).astype(np.int64).tolist()
        )


def encode_contact(load: LinkLoad) -> tuple[int, int, int, int, int, int]:
    """Return the raw numbers of a contact report: force x, y and z, place along the link, bearing, touched.

    A bearing wraps around: half a revolution to either side is the same.
    """
    x, y, z = load.position_l
    force_x, force_y, force_z = load.force_l
    bearing_rad = math.atan2(z, y)
    return (
        FORCE.to_raw(force_x),
        FORCE.to_raw(force_y),
        FORCE.to_raw(force_z),
        ALONG.to_raw(x),
        round(bearing_rad / BEARING_STEP_RAD),
        1,
    )


def encode_health(health: EmulatedHealth) -> tuple[int, int, int, int, int, int]:
    """Return the raw numbers of a Health report: voltage, current, two temperatures, leak, water."""
    water_percent = WET_PERCENT if health.leak else 0.0
    return (
        VOLTAGE.to_raw(health.voltage_v),
        CURRENT.to_raw(health.current_a),
        MOTOR_C.to_raw(health.winding_c),
        BOARD_C.to_raw(health.board_c),
        int(health.leak),
        WATER.to_raw(water_percent),
    )


_layouts = load_layouts()

LENGTHS: dict[int, int] = {opcode: _layouts[opcode].length for opcode in Opcode}  # bytes, by opcode

# --- frames of the host -------------------------------------------------------------------------------------------

read_sync = _layouts[Opcode.SYNC].make_reader("count", "time")
read_command = _layouts[Opcode.COMMAND].make_reader("action", "key")
# Position, velocity and torque share their bits, so that reading one of them reads the target of every mode.
read_setpoint = _layouts[Opcode.SET_POINT].make_reader("mode", "count", "position", "torque_limit")

_setpoint_signals = _layouts[Opcode.SET_POINT].signals
TARGET_STEPS = (  # one step of a setpoint's target, by mode
    0.0,  # passive
    _setpoint_signals["position"].scale,  # rad, -3.2767 to 3.2767
    _setpoint_signals["velocity"].scale,  # rad/s, -32.767 to 32.767
    _setpoint_signals["torque"].scale,  # N·m, -32.767 to 32.767
)
TORQUE_LIMIT_STEP_NM = _setpoint_signals["torque_limit"].scale  # 0 to 65.535 N·m

# --- frames of a module -------------------------------------------------------------------------------------------

_CONTACT_SIGNALS = ("force_x", "force_y", "force_z", "along", "bearing", "touched", "count")

write_joint_state = _layouts[Opcode.JOINT_STATE].make_writer(
    "angle", "velocity", "torque", "count", "state", "derated"
)
write_contact = _layouts[Opcode.CONTACT].make_writer(*_CONTACT_SIGNALS)
write_tail_contact = _layouts[Opcode.TAIL_CONTACT].make_writer(*_CONTACT_SIGNALS)
write_gyro = _layouts[Opcode.GYRO].make_writer("rate_x", "rate_y", "rate_z", "count")
write_acceleration = _layouts[Opcode.ACCELEROMETER].make_writer(
    "acceleration_x", "acceleration_y", "acceleration_z", "count"
)
write_shaft_load = _layouts[Opcode.SHAFT_LOAD].make_writer("torque", "count")
write_heartbeat = _layouts[Opcode.HEARTBEAT].make_writer(
    "state",
    "mode",
    "last_stop",
    *(f"fault_{fault.name.lower()}" for fault in ModuleFault),
    "uptime",
)
write_health = _layouts[Opcode.HEALTH].make_writer(
    "voltage", "current", "motor_temperature", "board_temperature", "leak", "water"
)
write_identity = _layouts[Opcode.IDENTITY].make_writer(
    "serial", "firmware_major", "firmware_minor", "protocol", "emulated", "stepped"
)


# --- measurements -------------------------------------------------------------------------------------------------


def _make_rounder(opcode: Opcode, signal: str) -> SignalRounder:
    return SignalRounder(_layouts[opcode].signals[signal])


ANGLE = _make_rounder(Opcode.JOINT_STATE, "angle")  # rad, -3.2768 to 3.2767
VELOCITY = _make_rounder(Opcode.JOINT_STATE, "velocity")  # rad/s, -32.768 to 32.767
TORQUE = _make_rounder(Opcode.JOINT_STATE, "torque")  # N·m, -32.768 to 32.767
FORCE = _make_rounder(Opcode.CONTACT, "force_x")  # N, -204.8 to 204.75
ALONG = _make_rounder(Opcode.CONTACT, "along")  # m from the joint, -0.256 to 0.2555
BEARING_STEP_RAD = _layouts[Opcode.CONTACT].signals["bearing"].scale  # a revolution has 256 steps
RATE = _make_rounder(Opcode.GYRO, "rate_x")  # rad/s, -32.768 to 32.767
ACCELERATION = _make_rounder(Opcode.ACCELEROMETER, "acceleration_x")  # m/s², -327.68 to 327.67
SHAFT_LOAD = _make_rounder(Opcode.SHAFT_LOAD, "torque")  # N·m, -32.768 to 32.767
VOLTAGE = _make_rounder(Opcode.HEALTH, "voltage")  # V, 0 to 65.535
CURRENT = _make_rounder(Opcode.HEALTH, "current")  # A, -32.768 to 32.767
MOTOR_C = _make_rounder(Opcode.HEALTH, "motor_temperature")  # °C, -40 to 215
BOARD_C = _make_rounder(Opcode.HEALTH, "board_temperature")  # °C, -40 to 215
WATER = _make_rounder(Opcode.HEALTH, "water")  # percent
