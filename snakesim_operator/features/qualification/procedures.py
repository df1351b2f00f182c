"""Carries out each step on the rig, and returns what it has measured. No procedure decides whether a value is good."""

import time
from collections.abc import Callable, Mapping

import msgspec

from snakesim_drivers.kit.drive_probe import ReadBack
from snakesim_hal.base.errors import RefusedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.network.stop_port import find_stop_address, request_stop
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import EstopRequest
from snakesim_operator.features.qualification.assistant import Assistant
from snakesim_operator.features.qualification.command_thread import MotionPlan, MotionSample
from snakesim_operator.features.qualification.protocol import steps
from snakesim_operator.features.qualification.protocol.checks import Check, judge_check
from snakesim_operator.features.qualification.protocol.steps import StepKey
from snakesim_operator.features.qualification.protocol.torque_timeline import TorqueReading, TorqueTimeline
from snakesim_operator.features.qualification.rig import Rig

Checks = list[Check]
MOTION_RAD = 0.05  # of the tiny motion
SWING_RAD = 0.03  # of the slow oscillation, in which drives are interrupted
BEYOND_LIMIT_RAD = 0.1
BLOCKED_TORQUE_FRACTION = 0.3  # of the joint's limit
BLOCKED_OFFSET_RAD = 0.15
SETTLING_S = 1.0
READ_TIMEOUT_S = 0.3
MOTION_S = 1.5
SWING_S = 0.5  # before the interruption
MAX_ARMINGS = 3
DRIVE_FAULT_TIMEOUT_S = 3.0


def check_identity(rig: Rig, _assistant: Assistant) -> Checks:
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


def check_configuration(rig: Rig, _assistant: Assistant) -> Checks:
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


def check_limits(rig: Rig, _assistant: Assistant) -> Checks:
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


def check_motion(rig: Rig, assistant: Assistant) -> Checks:
    """Move a few degrees forwards, and compare the drive's angle with the command and with what the operator saw."""
    joint = rig.robot.joints[0]
    start_rad = _arm_and_read_angle(rig)
    begun_ns = time.monotonic_ns()
    rig.commands.set_plan(MotionPlan(joint.torque_limit_nm, MOTION_RAD))
    time.sleep(MOTION_S)
    _require_armed(rig)
    samples = rig.commands.list_samples(begun_ns)
    moved_rad = samples[-1].angle_rad - start_rad if samples else None
    checks = [
        Check(
            name=f"moved, {MOTION_RAD:g} rad commanded",
            value=moved_rad,
            unit="rad",
            source="host",
            minimum=MOTION_RAD - steps.POSITION_TOLERANCE_RAD,
            maximum=MOTION_RAD + steps.POSITION_TOLERANCE_RAD,
            claims=("si-units",),
        ),
    ]
    answer = assistant.ask_turned_positive(begun_ns)
    checks.append(
        Check(
            name="the shaft turned the positive way",
            value=answer,
            equals="yes",
            source=assistant.source,
            claims=("si-units",),
        )
    )
    if rig.emulated_drive is not None:
        angles = [state.angle_rad for state in rig.emulated_drive.read_log() if state.monotonic_ns >= begun_ns]
        true_rad = angles[-1] - start_rad if angles else None
        checks.append(
            Check(
                name="true rotation of the shaft",
                value=true_rad,
                unit="rad",
                source="drive log",
                minimum=MOTION_RAD - steps.POSITION_TOLERANCE_RAD,
                maximum=MOTION_RAD + steps.POSITION_TOLERANCE_RAD,
                claims=("si-units",),
            )
        )
    return checks


def check_torque(rig: Rig, assistant: Assistant) -> Checks:
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
    torque_nm = max((abs(sample.torque_nm) for sample in rig.commands.list_samples(begun_ns)), default=0.0)
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


def check_watchdog(rig: Rig, _assistant: Assistant) -> Checks:
    """End the host's setpoints while a second program polls the drive.

    The host is killed, or frozen if the drive has no watchdog: then it can switch the drive off afterwards.
    """
    bounds = rig.setup.bounds
    _swing(rig)
    if bounds.has_watchdog:
        ended_ns = rig.kill_host()
        readings = rig.watch_torque(steps.FROZEN_S)
    else:
        ended_ns = rig.freeze_host()
        readings = rig.watch_torque(steps.FROZEN_S)
    timeline = rig.make_timeline(readings)
    checks = [
        Check(name="answers to the second program", value=float(len(readings)), minimum=1.0, source="drive status"),
    ]
    if bounds.has_watchdog:
        claim = "" if bounds.polling_feeds_watchdog else "stops-without-host"
        off = _check_torque_off(timeline, ended_ns, bounds.torque_off_s, claim)
        checks.append(off)
        if bounds.polling_feeds_watchdog:
            keeps = "" if off.value is None else "yes" if judge_check(off) == "refuted" else "no"
            checks.append(
                Check(
                    name="keeps its torque while it is polled",
                    value=keeps,
                    equals="yes",
                    source=timeline.source,
                    claims=("polling-feeds-watchdog",),
                )
            )
        rig.stop_host()
        rig.start_host()
        state = rig.wait_for_lifecycle("disarmed", timeout_s=5.0)
        checks.append(
            Check(
                name="state of a new host", value=state, equals="disarmed", source="host", claims=("never-arms-itself",)
            )
        )
    else:
        enabled = timeline.count_enabled_again(time.monotonic_ns() - 1, time.monotonic_ns())
        if not timeline.lists_changes:
            enabled = int(readings[-1].is_enabled) if readings else None
        checks.append(
            Check(
                name=f"still holds after {steps.FROZEN_S:g} s",
                value=_yes_or_no(enabled),
                equals="yes",
                source=timeline.source,
                claims=("holds-without-host",),
            )
        )
        rig.resume_host()
    return checks


def check_freeze(rig: Rig, _assistant: Assistant) -> Checks:
    """Freeze the host for 1 s, and watch the drive until 1 s after it continues."""
    bounds = rig.setup.bounds
    _swing(rig)
    frozen_ns = rig.freeze_host()
    readings = rig.watch_torque(steps.FROZEN_S, should_poll=rig.probe.has_own_line)
    resumed_ns = rig.resume_host()
    start_ns = frozen_ns if bounds.has_watchdog else resumed_ns
    grace_ns = 0 if bounds.has_watchdog else round(bounds.torque_off_s * 1e9)
    readings += rig.watch_torque(steps.WATCHED_S)
    timeline = rig.make_timeline(readings)
    claim = "stops-without-host" if bounds.has_watchdog else ""
    state = rig.wait_for_lifecycle("fault", timeout_s=DRIVE_FAULT_TIMEOUT_S)
    return [
        _check_torque_off(timeline, start_ns, bounds.torque_off_s, claim),
        _check_stays_off(timeline, resumed_ns + grace_ns),
        Check(name="state of the robot", value=state, equals="fault", source="host", claims=("stop-is-a-fault",)),
        Check(name="faults", value=_join(rig.list_faults()), source="host"),
    ]


def check_unplug(rig: Rig, assistant: Assistant) -> Checks:
    """Unplug the bus while the joint moves, plug it in again, and watch the drive."""
    bounds = rig.setup.bounds
    _swing(rig)
    cut_ns = assistant.perform("unplug_bus")
    time.sleep(steps.FROZEN_S)
    checks = _check_operator_sees_no_torque(assistant) if bounds.has_watchdog else []
    state = rig.wait_for_lifecycle("fault", timeout_s=DRIVE_FAULT_TIMEOUT_S)
    plugged_ns = assistant.perform("plug_bus") or time.monotonic_ns()
    grace_ns = 0 if bounds.has_watchdog else round(steps.WATCHED_S * 1e9)
    readings = rig.watch_torque(steps.WATCHED_S + grace_ns * 1e-9)
    timeline = rig.make_timeline(readings)
    claim = f"bus-cut-{rig.setup.config.backend}"
    if bounds.has_watchdog and cut_ns is not None:
        checks.append(_check_torque_off(timeline, cut_ns, bounds.torque_off_s, claim))
    elif bounds.has_watchdog:
        checks = [_add_claim(check, claim) for check in checks]
    else:
        checks.append(_check_torque_off(timeline, plugged_ns, steps.WATCHED_S, claim))
    return [
        *checks,
        Check(name="state of the robot", value=state, equals="fault", source="host"),
        _check_stays_off(timeline, plugged_ns + grace_ns),
    ]


def check_supply(rig: Rig, assistant: Assistant) -> Checks:
    """Lower the supply while the joint moves."""
    _swing(rig)
    lowered_ns = assistant.perform("lower_supply")
    state = rig.wait_for_lifecycle("fault", timeout_s=DRIVE_FAULT_TIMEOUT_S)
    faults = _join(rig.list_faults())
    readings = rig.watch_torque(0.5)
    timeline = rig.make_timeline(readings)
    assistant.perform("restore_supply")
    checks = [
        Check(name="state of the robot", value=state, equals="fault", source="host"),
        Check(name="faults", value=faults, source="host"),
    ]
    if lowered_ns is None:
        return [*checks, _check_stays_off(timeline, time.monotonic_ns() - 1)]
    return [*checks, _check_torque_off(timeline, lowered_ns, steps.SUPPLY_LIMIT_S)]


def check_estop_key(rig: Rig, assistant: Assistant) -> Checks:
    """Stop by a key: a datagram to the host's stop port, which needs no Zenoh."""
    _swing(rig)
    assistant.pause("Stop the motor with the next key.")
    host, port = find_stop_address(rig.endpoint, listens=True)
    pressed_ns = time.monotonic_ns()
    request_stop(host, port, f"{get_user_name()[:40]}, drive qualify", 2.0)
    return _check_estop(rig, pressed_ns, "estop-without-zenoh")


def check_estop_network(rig: Rig, _assistant: Assistant) -> Checks:
    """Stop by a query over the robot's network."""
    _swing(rig)
    requested_ns = time.monotonic_ns()
    rig.session.send_request(keys.ESTOP, EstopRequest(requester=f"{get_user_name()[:40]}, drive qualify"), 2.0)
    return _check_estop(rig, requested_ns)


def check_estop_relay(rig: Rig, assistant: Assistant) -> Checks:
    """Cut the motor supply while the joint moves, and restore it."""
    _swing(rig)
    assistant.perform("cut_relay")
    checks = _check_operator_sees_no_torque(assistant)
    assistant.perform("close_relay")
    return [*checks, *_check_restarted(rig)]


def check_restart(rig: Rig, assistant: Assistant) -> Checks:
    """Restart the drive while the joint moves."""
    _swing(rig)
    assistant.perform("restart_drive")
    return _check_restarted(rig)


PROCEDURES: Mapping[StepKey, Callable[[Rig, Assistant], Checks]] = {
    "identity": check_identity,
    "configuration": check_configuration,
    "limits": check_limits,
    "motion": check_motion,
    "torque": check_torque,
    "watchdog": check_watchdog,
    "freeze": check_freeze,
    "unplug": check_unplug,
    "supply": check_supply,
    "estop_key": check_estop_key,
    "estop_network": check_estop_network,
    "estop_relay": check_estop_relay,
    "restart": check_restart,
}


# --- shared ------------------------------------------------------------------------------------------------------


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
        raise RefusedError(f"the robot stopped by itself during the motion: {faults}", code="robot/not-armed")


def _swing(rig: Rig) -> None:
    """Arm, and let the joint oscillate slowly. Arm again if a busy computer has stopped the robot meanwhile.

    Raises:
        RefusedError: The robot does not stay armed.
    """
    plan = MotionPlan(rig.robot.joints[0].torque_limit_nm, amplitude_rad=SWING_RAD)
    for _ in range(MAX_ARMINGS):
        rig.arm(plan)
        time.sleep(SWING_S)
        if rig.read_lifecycle() == "armed":
            return
        rig.disarm()
    raise RefusedError(f"the robot stopped by itself {MAX_ARMINGS} times after arming", code="robot/not-armed")


def _check_torque_off(timeline: TorqueTimeline, start_ns: int, limit_s: float, claim: str = "") -> Check:
    off_s = timeline.find_torque_off_s(start_ns)
    note = ""
    if timeline.lists_changes and timeline.was_enabled_at(start_ns) is False:
        off_s = None
        note = "the drive had no torque before, so that nothing was tested"
    elif off_s is None and timeline.readings:
        newest = timeline.readings[-1]
        if newest.is_enabled:
            # A drive that still has torque refutes the criterion by the time that it was watched.
            off_s = max(time.monotonic_ns() - start_ns, 0) * 1e-9
            note = "it still has torque"
    return Check(
        name="torque off after",
        value=off_s,
        unit="s",
        maximum=limit_s,
        source=timeline.source,
        note=note,
        claims=(claim,) if claim else (),
    )


def _check_stays_off(timeline: TorqueTimeline, start_ns: int) -> Check:
    enabled = timeline.count_enabled_again(start_ns, time.monotonic_ns())
    return Check(
        name="enabled again without reset and arm",
        value=None if enabled is None else float(enabled),
        maximum=0.0,
        source=timeline.source,
        claims=("stays-off",),
    )


def _check_estop(rig: Rig, start_ns: int, claim: str = "") -> Checks:
    bounds = rig.setup.bounds
    readings: list[TorqueReading] = []
    remaining_s = bounds.estop_s - (time.monotonic_ns() - start_ns) * 1e-9
    if rig.probe.has_own_line:
        readings = rig.watch_torque(2.0, until=lambda enabled: not enabled)
    elif remaining_s > 0.03:
        readings = rig.watch_torque(remaining_s - 0.03)
    else:
        readings = rig.watch_torque(0.0)
    state = rig.wait_for_lifecycle("estop", timeout_s=2.0)
    claims = (claim,) if claim else ()
    return [
        _check_torque_off(rig.make_timeline(readings), start_ns, bounds.estop_s, "estop-off-at-once"),
        Check(name="state of the robot", value=state, equals="estop", source="host", claims=claims),
    ]


def _check_restarted(rig: Rig) -> Checks:
    state = rig.wait_for_lifecycle("fault", timeout_s=DRIVE_FAULT_TIMEOUT_S)
    faults = _join(rig.list_faults())
    begun_ns = time.monotonic_ns()
    timeline = rig.make_timeline(rig.watch_torque(steps.WATCHED_S))
    return [
        Check(name="state of the robot", value=state, equals="fault", source="host", claims=("stop-is-a-fault",)),
        Check(name="faults", value=faults, source="host"),
        _check_stays_off(timeline, begun_ns),
    ]


def _check_operator_sees_no_torque(assistant: Assistant) -> Checks:
    answer = assistant.ask_without_torque()
    return [Check(name="the motor is without torque", value=answer, equals="yes", source=assistant.source)]


def _add_claim(check: Check, claim: str) -> Check:
    return msgspec.structs.replace(check, claims=(*check.claims, claim))


def _join(names: list[str]) -> str:
    return ", ".join(dict.fromkeys(names))


def _yes_or_no(count: int | None) -> str:
    match count:
        case None:
            return ""
        case 0:
            return "no"
        case _:
            return "yes"
