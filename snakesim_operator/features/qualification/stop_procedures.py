"""Carries out the steps that interrupt or stop a moving drive, and returns what each has measured.

No procedure decides whether a value is good.
"""

import time

import msgspec

from snakesim_hal.base.errors import RefusedError
from snakesim_hal.network.stop_port import find_stop_address, request_stop
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import EstopRequest
from snakesim_operator.features.qualification.assistant import Assistant
from snakesim_operator.features.qualification.command_thread import MotionPlan
from snakesim_operator.features.qualification.protocol import steps
from snakesim_operator.features.qualification.protocol.checks import Check, judge_check
from snakesim_operator.features.qualification.protocol.torque_timeline import (
    TorqueReading,
    TorqueTimeline,
)
from snakesim_operator.features.qualification.rig import Rig, make_requester

SWING_RAD = 0.03  # of the slow oscillation, in which drives are interrupted
SWING_S = 0.5  # before the interruption
MAX_ARMINGS = 3
DRIVE_FAULT_TIMEOUT_S = 3.0
LAST_READING_S = 0.03  # before the limit of an emergency stop, when a half-duplex bus is read once


def check_watchdog(rig: Rig, _assistant: Assistant) -> list[Check]:
    """End the host's setpoints while a second program polls the drive.

    The host is killed, or frozen if the drive has no watchdog: then it can switch the drive off afterwards.
    """
    _swing(rig)
    if rig.setup.bounds.has_watchdog:
        return _check_killed_host(rig)
    return _check_frozen_host_without_watchdog(rig)


def _check_killed_host(rig: Rig) -> list[Check]:
    """Kill the host, see whether the watchdog of the drive switches it off, and start a new host."""
    bounds = rig.setup.bounds
    killed_ns = rig.kill_host()
    readings = rig.watch_torque(steps.FROZEN_S)
    timeline = rig.make_timeline(readings)
    claim = "" if bounds.polling_feeds_watchdog else "stops-without-host"
    torque_off = _check_torque_off(timeline, killed_ns, bounds.torque_off_s, claim)
    checks = [_check_polling(readings), torque_off]
    if bounds.polling_feeds_watchdog:
        checks.append(_check_keeps_torque(torque_off))
    rig.stop_host()
    rig.start_host()
    state = rig.wait_for_lifecycle("disarmed", timeout_s=5.0)
    checks.append(
        Check(
            name="state of a new host",
            value=state,
            equals="disarmed",
            source="host",
            claims=("never-arms-itself",),
        )
    )
    return checks


def _check_frozen_host_without_watchdog(rig: Rig) -> list[Check]:
    """Freeze the host, and see whether the drive still has torque at the end."""
    rig.freeze_host()
    readings = rig.watch_torque(steps.FROZEN_S)
    timeline = rig.make_timeline(readings)
    enabled = timeline.count_enabled_again(time.monotonic_ns() - 1, time.monotonic_ns())
    if not timeline.lists_changes:
        enabled = int(readings[-1].is_enabled) if readings else None
    rig.resume_host()
    holds = Check(
        name=f"still holds after {steps.FROZEN_S:g} s",
        value=_yes_or_no(enabled),
        equals="yes",
        source=timeline.source,
        claims=("holds-without-host",),
    )
    return [_check_polling(readings), holds]


def _check_polling(readings: list[TorqueReading]) -> Check:
    return Check(
        name="answers to the second program",
        value=float(len(readings)),
        minimum=1.0,
        source="drive status",
    )


def _check_keeps_torque(torque_off: Check) -> Check:
    """Return whether a drive keeps its torque, by the check of whether it has lost it in time."""
    match judge_check(torque_off):
        case "refuted":
            keeps = "yes"
        case "confirmed":
            keeps = "no"
        case "unknown":
            keeps = ""
    return Check(
        name="keeps its torque while it is polled",
        value=keeps,
        equals="yes",
        source=torque_off.source,
        claims=("polling-feeds-watchdog",),
    )


def check_freeze(rig: Rig, _assistant: Assistant) -> list[Check]:
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
        _check_state(state, "fault", "stop-is-a-fault"),
        _check_faults(rig),
    ]


def check_unplug(rig: Rig, assistant: Assistant) -> list[Check]:
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
        note = "The time of the cut is not known"
        checks = [_add_claim(_add_note(check, note), claim) for check in checks]
    else:
        checks.append(_check_torque_off(timeline, plugged_ns, steps.WATCHED_S, claim))
    return [
        *checks,
        _check_state(state, "fault"),
        _check_stays_off(timeline, plugged_ns + grace_ns),
    ]


def check_supply(rig: Rig, assistant: Assistant) -> list[Check]:
    """Lower the supply while the joint moves."""
    _swing(rig)
    lowered_ns = assistant.perform("lower_supply")
    state = rig.wait_for_lifecycle("fault", timeout_s=DRIVE_FAULT_TIMEOUT_S)
    faults = _check_faults(rig)
    # The robot may still brake, if the host has stopped it and not the drive itself.
    braked_ns = time.monotonic_ns() + round(steps.SUPPLY_LIMIT_S * 1e9)
    readings = rig.watch_torque(steps.SUPPLY_LIMIT_S + steps.WATCHED_S)
    timeline = rig.make_timeline(readings)
    stays_off = _check_stays_off(timeline, braked_ns)
    assistant.perform("restore_supply")
    checks = [
        _check_state(state, "fault"),
        faults,
    ]
    if lowered_ns is None:
        return [*checks, _add_note(stays_off, "The time of the drop is not known")]
    return [*checks, _check_torque_off(timeline, lowered_ns, steps.SUPPLY_LIMIT_S)]


def check_estop_key(rig: Rig, assistant: Assistant) -> list[Check]:
    """Stop by a key: a datagram to the host's stop port, which needs no Zenoh."""
    _swing(rig)
    assistant.wait_for_enter("Press Enter to stop the motor:")
    host, port = find_stop_address(rig.endpoint, listens=True)
    pressed_ns = time.monotonic_ns()
    request_stop(host, port, make_requester(), 2.0)
    return _check_estop(rig, pressed_ns, "estop-without-zenoh")


def check_estop_network(rig: Rig, _assistant: Assistant) -> list[Check]:
    """Stop by a query over the robot's network."""
    _swing(rig)
    requested_ns = time.monotonic_ns()
    rig.session.send_request(keys.ESTOP, EstopRequest(requester=make_requester()), 2.0)
    return _check_estop(rig, requested_ns)


def check_estop_relay(rig: Rig, assistant: Assistant) -> list[Check]:
    """Cut the motor supply while the joint moves, and restore it."""
    _swing(rig)
    assistant.perform("cut_relay")
    checks = _check_operator_sees_no_torque(assistant)
    assistant.perform("close_relay")
    return [*checks, *_check_restarted(rig)]


def check_restart(rig: Rig, assistant: Assistant) -> list[Check]:
    """Restart the drive while the joint moves."""
    _swing(rig)
    assistant.perform("restart_drive")
    return _check_restarted(rig)


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
    raise RefusedError(
        f"the robot stopped by itself {MAX_ARMINGS} times after arming", code="robot/not-armed"
    )


def _check_state(state: str, expected: str, claim: str = "") -> Check:
    return Check(
        name="state of the robot",
        value=state,
        equals=expected,
        source="host",
        claims=(claim,) if claim else (),
    )


def _check_faults(rig: Rig) -> Check:
    return Check(name="faults", value=", ".join(dict.fromkeys(rig.list_faults())), source="host")


def _check_torque_off(
    timeline: TorqueTimeline, start_ns: int, limit_s: float, claim: str = ""
) -> Check:
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


def _check_estop(rig: Rig, start_ns: int, claim: str = "") -> list[Check]:
    bounds = rig.setup.bounds
    if rig.probe.has_own_line:
        readings = rig.watch_torque(2.0, until=lambda enabled: not enabled)
    else:
        remaining_s = bounds.estop_s - (time.monotonic_ns() - start_ns) * 1e-9
        readings = rig.watch_torque(max(remaining_s - LAST_READING_S, 0.0))
    state = rig.wait_for_lifecycle("estop", timeout_s=2.0)
    return [
        _check_torque_off(
            rig.make_timeline(readings), start_ns, bounds.estop_s, "estop-off-at-once"
        ),
        _check_state(state, "estop", claim),
    ]


def _check_restarted(rig: Rig) -> list[Check]:
    state = rig.wait_for_lifecycle("fault", timeout_s=DRIVE_FAULT_TIMEOUT_S)
    faults = _check_faults(rig)
    # The robot may still brake, if the host has stopped it before the drive has restarted.
    braking_s = rig.setup.bounds.torque_off_s
    braked_ns = time.monotonic_ns() + round(braking_s * 1e9)
    timeline = rig.make_timeline(rig.watch_torque(braking_s + steps.WATCHED_S))
    return [
        _check_state(state, "fault", "stop-is-a-fault"),
        faults,
        _check_stays_off(timeline, braked_ns),
    ]


def _check_operator_sees_no_torque(assistant: Assistant) -> list[Check]:
    answer = assistant.ask_without_torque()
    return [
        Check(
            name="the motor is without torque", value=answer, equals="yes", source=assistant.source
        )
    ]


def _add_claim(check: Check, claim: str) -> Check:
    return msgspec.structs.replace(check, claims=(*check.claims, claim))


def _add_note(check: Check, note: str) -> Check:
    return msgspec.structs.replace(check, note=note)


def _yes_or_no(count: int | None) -> str:
    match count:
        case None:
            return ""
        case 0:
            return "no"
        case _:
            return "yes"
