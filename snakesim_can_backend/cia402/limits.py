"""Units of a drive, and its limits, which must suit the joint before the drive is used. Pure."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from snakesim_can_backend.cia402.objects import (
    DEVICE_TYPE,
    DS402,
    ENCODER_INCREMENTS,
    ENCODER_REVOLUTIONS,
    MAX_POSITION,
    MAX_SPEED,
    MAX_TORQUE,
    MIN_POSITION,
    RATED_CURRENT,
    RATED_TORQUE,
    SUPPORTED_MODES,
    ObjectEntry,
)
from snakesim_can_backend.cia402.settings import Cia402Settings
from snakesim_can_backend.cia402.state_machine import OperationMode
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

REVOLUTION_RAD = 2 * math.pi  # rad
THOUSANDTHS = 1000  # torques are thousandths of the rated torque
RELATIVE_TOLERANCE = 0.01  # relative: limits are whole numbers, and people round them
INT16 = (-(2**15), 2**15 - 1)
INT32 = (-(2**31), 2**31 - 1)
UINT16_MAX = 2**16 - 1
MODES = {
    JointMode.POSITION: OperationMode.CYCLIC_POSITION,
    JointMode.VELOCITY: OperationMode.CYCLIC_VELOCITY,
    JointMode.TORQUE: OperationMode.CYCLIC_TORQUE,
    JointMode.PASSIVE: OperationMode.CYCLIC_TORQUE,
}
MODE_NAMES = {
    OperationMode.CYCLIC_POSITION: "cyclic synchronous position (CSP)",
    OperationMode.CYCLIC_VELOCITY: "cyclic synchronous velocity (CSV)",
    OperationMode.CYCLIC_TORQUE: "cyclic synchronous torque (CST)",
}

# That a drive has reported; entries that it does not have are missing.
EntryValues = Mapping[ObjectEntry, int]


@dataclass(frozen=True)
class UnitScaling:
    """Units of a drive at its shaft."""

    counts_per_turn: float
    velocity_units_per_turn_s: float
    rated_torque_nm: float

    def to_position(self, angle_rad: float) -> int:
        """Return an angle in position units."""
        return _clip(angle_rad / REVOLUTION_RAD * self.counts_per_turn, INT32)

    def to_velocity(self, velocity_rad_s: float) -> int:
        """Return a velocity in velocity units."""
        return _clip(velocity_rad_s / REVOLUTION_RAD * self.velocity_units_per_turn_s, INT32)

    def to_torque(self, torque_nm: float) -> int:
        """Return a torque in thousandths of the rated torque."""
        return _clip(torque_nm / self.rated_torque_nm * THOUSANDTHS, INT16)

    def to_max_torque(self, limit_nm: float) -> int:
        """Return a torque limit in thousandths of the rated torque, rounded down."""
        thousandths = limit_nm / self.rated_torque_nm * THOUSANDTHS
        return min(max(math.floor(thousandths + 1e-6), 0), UINT16_MAX)

    def to_angle_rad(self, position: int) -> float:
        """Return the angle of a position in position units."""
        return position / self.counts_per_turn * REVOLUTION_RAD

    def to_velocity_rad_s(self, velocity: int) -> float:
        """Return the velocity of a value in velocity units."""
        return velocity / self.velocity_units_per_turn_s * REVOLUTION_RAD

    def to_torque_nm(self, thousandths: int) -> float:
        """Return the torque of a value in thousandths of the rated torque."""
        return thousandths / THOUSANDTHS * self.rated_torque_nm


def determine_scaling(
    values: EntryValues, settings: Cia402Settings, joint: Joint
) -> UnitScaling | str:
    """Determine the units of a drive from its reported values and the settings.

    Args:
        values: Values that the drive has reported, by entry.
        settings: Settings of the driver type; units in them replace those that the drive reports.
        joint: Joint of the drive, whose torque constant may be needed.

    Returns:
        The units, or a text with the reason why they are unknown, to be put after the drive's name.
    """
    counts = settings.counts_per_turn or _read_counts(values)
    if not counts:
        return (
            f"does not report its encoder resolution ({ENCODER_INCREMENTS.address}): set "
            f"`backends.cia402.counts_per_turn`"
        )
    rated_torque_nm = settings.rated_torque_nm or _read_rated_torque_nm(values, joint)
    if not rated_torque_nm:
        return (
            f"does not report its rated torque ({RATED_TORQUE.address}), nor its rated current with a "
            f"`torque_constant_nm_per_a` in the robot file: set `backends.cia402.rated_torque_nm`"
        )
    return UnitScaling(counts, settings.velocity_units_per_turn_s or counts, rated_torque_nm)


def find_incompatibilities(
    values: EntryValues, scaling: UnitScaling, settings: Cia402Settings, joint: Joint
) -> Iterator[str]:
    """Yield a text for each mode, unit or limit of a drive that does not suit its joint.

    Each text is a predicate, such as "has a torque limit ...", to be put after the name of the drive.

    Args:
        values: Values that the drive has reported, by entry.
        scaling: Units of the drive.
        settings: Settings of the driver type.
        joint: Joint that the drive moves.
    """
    yield from _find_mode_problems(values, joint)
    yield from _find_unit_problems(values, settings, joint)
    motor_torque_nm = joint.limits.torque_nm / joint.drive.gear  # at the shaft of the drive
    max_torque_nm = scaling.to_torque_nm(values[MAX_TORQUE])
    if motor_torque_nm > max_torque_nm * (1 + RELATIVE_TOLERANCE):
        yield (
            f"has a torque limit ({MAX_TORQUE.address}) of {max_torque_nm:.3g} N·m, and its joint may command "
            f"{motor_torque_nm:.3g} N·m: raise the one, or lower `torque_nm`. A driver that was killed may have left a "
            f"lower limit: restart the drive"
        )
    if MAX_SPEED in values:
        speed_rad_s = joint.limits.speed_rad_s * joint.drive.gear
        max_speed_rad_s = values[MAX_SPEED] / settings.max_speed_units_per_turn_s * REVOLUTION_RAD
        if speed_rad_s > max_speed_rad_s * (1 + RELATIVE_TOLERANCE):
            yield (
                f"has a speed limit ({MAX_SPEED.address}) of {max_speed_rad_s:.4g} rad/s, and its joint may turn at "
                f"{speed_rad_s:.4g} rad/s: raise the one, or lower `speed_rad_s`"
            )
    yield from _find_position_limit_problems(values, scaling, joint)


def compute_shaft_range_rad(joint: Joint) -> tuple[float, float]:
    """Return the lowest and the highest angle of a drive's shaft within the limits of its joint."""
    drive = joint.drive
    ratio = drive.sign * drive.gear
    ends = [
        drive.zero_rad + ratio * angle for angle in (joint.limits.lower_rad, joint.limits.upper_rad)
    ]
    return min(ends), max(ends)


def _find_mode_problems(values: EntryValues, joint: Joint) -> Iterator[str]:
    profile = values[DEVICE_TYPE] & 0xFFFF
    if profile != DS402:
        yield f"has the device profile {profile}, and this driver knows {DS402} ({DEVICE_TYPE.address})"
    required_modes = [OperationMode.CYCLIC_TORQUE]  # of passive joints
    required_modes += [MODES[JointMode[name.upper()]] for name in joint.drive.modes]
    for mode in sorted(set(required_modes)):
        if not values[SUPPORTED_MODES] >> (mode - 1) & 1:
            yield f"does not support mode {mode:d}, {MODE_NAMES[mode]} ({SUPPORTED_MODES.address})"


def _find_unit_problems(
    values: EntryValues, settings: Cia402Settings, joint: Joint
) -> Iterator[str]:
    """Yield units in the settings that differ from those that the drive reports."""
    counts = _read_counts(values)
    configured_counts = settings.counts_per_turn
    if (
        counts
        and configured_counts
        and abs(counts - configured_counts) > RELATIVE_TOLERANCE * configured_counts
    ):
        yield (
            f"has an encoder resolution ({ENCODER_INCREMENTS.address}) of {counts:g} a turn, and "
            f"`backends.cia402.counts_per_turn` = {configured_counts:g}: correct the one that is wrong"
        )
    rated_torque_nm = _read_rated_torque_nm(values, joint)
    configured_torque_nm = settings.rated_torque_nm
    if (
        RATED_TORQUE in values
        and rated_torque_nm
        and configured_torque_nm
        and abs(rated_torque_nm - configured_torque_nm) > RELATIVE_TOLERANCE * configured_torque_nm
    ):
        yield (
            f"has a rated torque ({RATED_TORQUE.address}) of {rated_torque_nm:.4g} N·m, and "
            f"`backends.cia402.rated_torque_nm` = {configured_torque_nm:g}: correct the one that is wrong"
        )


def _find_position_limit_problems(
    values: EntryValues, scaling: UnitScaling, joint: Joint
) -> Iterator[str]:
    """Yield position limits that stop the drive within the range of its joint. Equal ones mean that there are none."""
    if MIN_POSITION not in values or MAX_POSITION not in values:
        return
    if values[MIN_POSITION] >= values[MAX_POSITION]:
        return
    lower_rad, upper_rad = compute_shaft_range_rad(joint)
    tolerance_rad = RELATIVE_TOLERANCE * (upper_rad - lower_rad)
    min_rad = scaling.to_angle_rad(values[MIN_POSITION])
    max_rad = scaling.to_angle_rad(values[MAX_POSITION])
    if lower_rad < min_rad - tolerance_rad or upper_rad > max_rad + tolerance_rad:
        yield (
            f"has position limits (607Dh) of {min_rad:.4g} to {max_rad:.4g} rad, and its joint may turn it from "
            f"{lower_rad:.4g} to {upper_rad:.4g} rad: widen the ones, or narrow the joint's"
        )


def _read_counts(values: EntryValues) -> float:
    """Return the position units for one turn that a drive reports; 0 if it does not report them."""
    increments = values.get(ENCODER_INCREMENTS, 0)
    revolutions = values.get(ENCODER_REVOLUTIONS, 0) or 1
    return increments / revolutions


def _read_rated_torque_nm(values: EntryValues, joint: Joint) -> float:
    """Return the rated torque that a drive reports or that its rated current gives; 0 if both are unknown."""
    if values.get(RATED_TORQUE):
        return values[RATED_TORQUE] / 1000
    torque_constant_nm_per_a = joint.motor.torque_constant_nm_per_a or 0.0
    return values.get(RATED_CURRENT, 0) / 1000 * torque_constant_nm_per_a


def _clip(value: float, limits: tuple[int, int]) -> int:
    low, high = limits
    return min(max(round(value), low), high)
