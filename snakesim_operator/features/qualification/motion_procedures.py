"""Carries out the steps in which nothing stops the drive, and returns what each has measured.

No procedure decides whether a value is good.
"""

import time

from snakesim_drivers.kit.drive_probe import ReadBack
from snakesim_hal.base.errors import RefusedError
from snakesim_operator.features.qualification.assistant import Assistant
from snakesim_operator.features.qualification.command_thread import MotionPlan, MotionSample
from snakesim_operator.features.qualification.protocol import steps
from snakesim_operator.features.qualification.protocol.checks import Check, Source
from snakesim_operator.features.qualification.rig import Rig

MOTION_RAD = 0.05  # of the tiny motion
BEYOND_LIMIT_RAD = 0.1
BLOCKED_TORQUE_FRACTION = 0.3  # of the joint's limit
BLOCKED_OFFSET_RAD = 0.15
SETTLING_S = 1.0
READ_TIMEOUT_S = 0.3
MOTION_S = 1.5


def check_identity(rig: Rig, _assistant: Assistant) -> list[Check]:
    """Read serial number and firmware from the host's description."""
    joint = rig.robot.joints[0]
    return [
        Check(name="serial number", value=joint.serial, source="host"),
        _check_firmware(rig),
        Check(
            name="state after the start",
            value=rig.read_lifecycle(),
            equals="disarmed",
            source="host",
            claims=("never-arms-itself",),
        ),
    ]


def _check_firmware(rig: Rig) -> Check:
    """Return the version that the drive reports, or else the one that the operator has typed."""
    reported = rig.robot.joints[0].firmware
    if reported or not rig.typed_firmware:
        return Check(name="firmware", value=reported, source="host")
    return Check(name="firmware", value=rig.typed_firmware, source="operator")


def check_configuration(rig: Rig, _assistant: Assistant) -> list[Check]:
    """Read settings from the drive with a second program, while the robot is disarmed."""
    with rig.quiet_bus():
        values = rig.probe.read_configuration(READ_TIMEOUT_S)
    if not values:
        return [Check(name="settings read back", value=None, source="drive status")]
    return [_make_read_back_check(value) for value in values]


def _make_read_back_check(value: ReadBack) -> Check:
    return Check(
        name=value.name,
        value=value.reported,
        unit=value.unit,
        minimum=value.required - value.tolerance,
        maximum=value.required + value.tolerance,
        source="drive status",
    )


def check_limits(rig: Rig, _assistant: Assistant) -> list[Check]:
    """Command an angle beyond the upper limit, and measure angle and speed."""
    joint = rig.robot.joints[0]
    start_rad = _arm_and_read_angle(rig)
    begun_ns = time.monotonic_ns()
    offset_rad = joint.angle_max_rad - (rig.commands.center_rad or 0.0) + BEYOND_LIMIT_RAD
    rig.commands.set_plan(MotionPlan(joint.torque_limit_nm, offset_rad))
    travel_s = abs(joint.angle_max_rad - start_rad) / joint.speed_limit_rad_s
    time.sleep(travel_s + SETTLING_S)
    samples = rig.commands.list_samples(begun_ns)
    rig.commands.set_plan(MotionPlan(joint.torque_limit_nm))  # back to where it was
    time.sleep(travel_s + SETTLING_S)
    _require_armed(rig)
    peak_rad = max((sample.angle_rad for sample in samples), default=None)
    speed_rad_s = max((abs(sample.velocity_rad_s) for sample in samples), default=None)
    note = ""
    if peak_rad is not None and peak_rad < joint.angle_max_rad - MOTION_RAD:
        note = f"it came only to {peak_rad:.3f} rad, so that the limit was not tested"
        peak_rad = None
    return [
        Check(
            name="highest angle",
            value=peak_rad,
            unit="rad",
            source="host",
            note=note,
            claims=("limits-held",),
            maximum=joint.angle_max_rad + steps.POSITION_TOLERANCE_RAD,
        ),
        Check(
            name="highest speed",
            value=speed_rad_s,
            unit="rad/s",
            source="host",
            claims=("limits-held",),
            maximum=joint.speed_limit_rad_s * steps.SPEED_TOLERANCE,
        ),
    ]


def check_motion(rig: Rig, assistant: Assistant) -> list[Check]:
    """Move a few degrees forwards, and compare the drive's angle with the command and with what the operator saw."""
    joint = rig.robot.joints[0]
    start_rad = _arm_and_read_angle(rig)
    begun_ns = time.monotonic_ns()
    rig.commands.set_plan(MotionPlan(joint.torque_limit_nm, MOTION_RAD))
    time.sleep(MOTION_S)
    _require_armed(rig)
    samples = rig.commands.list_samples(begun_ns)
    moved_rad = samples[-1].angle_rad - start_rad if samples else None
    answer = assistant.ask_turned_positive(begun_ns)
    checks = [
        _make_motion_check(f"moved, {MOTION_RAD:g} rad commanded", moved_rad, "host"),
        Check(
            name="the shaft turned the positive way",
            value=answer,
            equals="yes",
            source=assistant.source,
            claims=("si-units",),
        ),
    ]
    if rig.emulated_drive is not None:
        angles = [
            state.angle_rad
            for state in rig.emulated_drive.read_log()
            if state.monotonic_ns >= begun_ns
        ]
        true_rad = angles[-1] - start_rad if angles else None
        checks.append(_make_motion_check("true rotation of the shaft", true_rad, "drive log"))
    return checks


def _make_motion_check(name: str, moved_rad: float | None, source: Source) -> Check:
    return Check(
        name=name,
        value=moved_rad,
        unit="rad",
        source=source,
        minimum=MOTION_RAD - steps.POSITION_TOLERANCE_RAD,
        maximum=MOTION_RAD + steps.POSITION_TOLERANCE_RAD,
        claims=("si-units",),
    )


def check_torque(rig: Rig, assistant: Assistant) -> list[Check]:
    """Push against a block with a low torque limit, and measure the torque. A drive that cannot stays off."""
    joint = rig.robot.joints[0]
    limit_nm = BLOCKED_TORQUE_FRACTION * joint.torque_limit_nm
    if "torque" not in joint.measures:
        return [_make_torque_check(limit_nm, None, "the drive does not measure its torque")]
    rig.arm(MotionPlan(limit_nm))
    assistant.perform("block")
    begun_ns = time.monotonic_ns()
    rig.commands.set_plan(MotionPlan(limit_nm, BLOCKED_OFFSET_RAD))
    time.sleep(MOTION_S)
    _require_armed(rig)
    torque_nm = max(
        (abs(sample.torque_nm) for sample in rig.commands.list_samples(begun_ns)), default=0.0
    )
    if torque_nm < steps.MIN_TORQUE_FRACTION * limit_nm:
        note = f"it reached only {torque_nm:.3f} N·m, so that the limit was not tested"
        return [_make_torque_check(limit_nm, None, note)]
    return [_make_torque_check(limit_nm, torque_nm, "")]


def _make_torque_check(limit_nm: float, torque_nm: float | None, note: str) -> Check:
    return Check(
        name=f"highest torque, limit {limit_nm:.3g} N·m",
        value=torque_nm,
        unit="N·m",
        source="host",
        note=note,
        minimum=steps.MIN_TORQUE_FRACTION * limit_nm,
        maximum=steps.TORQUE_TOLERANCE * limit_nm + steps.TORQUE_NOISE_NM,
        claims=("limits-held",),
    )


def _arm_and_read_angle(rig: Rig) -> float:
    """Arm, hold, and return the measured angle."""
    armed_ns = time.monotonic_ns()
    rig.arm(MotionPlan(rig.robot.joints[0].torque_limit_nm))
    time.sleep(SETTLING_S)
    samples = rig.commands.list_samples(armed_ns)
    armed = [sample for sample in samples if sample.is_armed]
    return _read_last_angle(armed or samples)


def _read_last_angle(samples: list[MotionSample]) -> float:
    return samples[-1].angle_rad if samples else 0.0


def _require_armed(rig: Rig) -> None:
    """Raise RefusedError if the robot has stopped by itself, so that a motion was not carried out."""
    if rig.read_lifecycle() != "armed":
        faults = ", ".join(rig.list_faults())
        raise RefusedError(
            f"the robot stopped by itself during the motion: {faults}", code="robot/not-armed"
        )
