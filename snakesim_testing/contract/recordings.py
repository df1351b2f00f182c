"""Motions that several tests share: opening and waiting take most of the time on a real bus."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from snakesim_hal.wire.messages import Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.rig import Floats, JointTargets, Record, Rig

# Every ordered pair of modes once, and back to the first: an Eulerian circuit.
CIRCUIT = tuple(Mode(int(code)) for code in "1012023031321")
PAIRS = list(pairwise(CIRCUIT))
HELD_S = 0.16  # of a mode before the next change


@dataclass
class Pushing:
    """Joint 0 against its upper stop, joint 1 against its lower one; each phase is the end of a push."""

    torque_mode: Record | None  # None: a joint has no torque mode
    asked_nm: float
    limited: Record
    limit_nm: float
    all: Record


def record_sway(rig: Rig) -> Record:
    """Let all joints sway a little around the start pose, neighbors in opposite directions, and return the record."""
    rig.arm()
    first_tick = rig.tick
    for tick in range(rig.count_periods(1.0)):
        angle = 0.3 * t.STEP_RAD * math.sin(2 * math.pi * tick * rig.period_ns * 1e-9)
        targets: JointTargets = {i: (Mode.POSITION, rig.home_rad[i] + angle * (-1) ** i) for i in range(rig.count)}
        rig.drive(targets)
    rig.assert_armed()
    return rig.record_since(first_tick)


def record_push(rig: Rig) -> Pushing:
    """Push two joints against their stops, in opposite directions.

    They push first in torque mode, then in velocity mode with a low torque limit. A joint without velocity mode gets a
    position beyond its stop instead.
    """
    rig.arm()
    first_tick = rig.tick
    upper, lower = rig.robot.joints[0], rig.robot.joints[1]

    def both(mode: Mode, up: float, down: float) -> JointTargets:
        return {0: (mode, up), 1: (mode, down)}

    near_stops = both(Mode.POSITION, t.NEAR_STOP * upper.angle_max_rad, t.NEAR_STOP * lower.angle_min_rad)
    rig.drive(near_stops, rig.count_periods(t.SETTLE_S))
    asked_nm = t.PUSH_SHARE * upper.torque_limit_nm
    torque_mode = None
    if rig.supports_mode(0, Mode.TORQUE) and rig.supports_mode(1, Mode.TORQUE):
        rig.press(both(Mode.TORQUE, asked_nm, -asked_nm), rig.count_periods(t.PUSH_S))
        torque_mode = rig.press(both(Mode.TORQUE, asked_nm, -asked_nm), t.TRANSPORT_PERIODS)
    limit_nm = t.LIMIT_SHARE * upper.torque_limit_nm
    speed = min(
        t.DEMAND_SHARE * upper.torque_limit_nm / upper.velocity_gain_nm_s_per_rad, 0.5 * upper.speed_limit_rad_s
    )
    limits = [limit_nm] * rig.count
    beyond_stops = both(Mode.VELOCITY, speed, -speed)
    if not (rig.supports_mode(0, Mode.VELOCITY) and rig.supports_mode(1, Mode.VELOCITY)):
        beyond_stops = both(Mode.POSITION, upper.angle_max_rad + t.BEYOND_RAD, lower.angle_min_rad - t.BEYOND_RAD)
    rig.press(beyond_stops, rig.count_periods(t.PUSH_S), torque_limit_nm=limits)
    limited = rig.press(beyond_stops, t.TRANSPORT_PERIODS, torque_limit_nm=limits)
    rig.assert_armed()
    return Pushing(torque_mode, asked_nm, limited, limit_nm, rig.record_since(first_tick))


def record_switching(rig: Rig) -> dict[tuple[Mode, Mode], Floats]:
    """Return the torques of joint 0 at every change of mode, (ticks,), from the tick before the change on."""
    rig.arm()
    slow = 0.3 * t.CRUISE_RAD_S
    gentle_nm = 0.02 * rig.full_torque_nm[0]
    home = rig.home_rad[0]

    def sign_towards_home() -> float:
        """Return the sign of the direction towards the start pose."""
        return -math.copysign(1.0, rig.newest_joints.angle_rad[0] - home)

    target: dict[Mode, Callable[[], float]] = {
        Mode.PASSIVE: lambda: 0.0,
        Mode.POSITION: lambda: rig.newest_joints.angle_rad[0],
        Mode.VELOCITY: lambda: sign_towards_home() * slow,
        Mode.TORQUE: lambda: sign_towards_home() * gentle_nm,
    }
    rig.drive({0: (CIRCUIT[0], home)}, rig.count_periods(HELD_S))
    torques: dict[tuple[Mode, Mode], Floats] = {}
    for before, after in PAIRS:
        if not (rig.supports_mode(0, before) and rig.supports_mode(0, after)):
            rig.drive({0: (Mode.POSITION, rig.newest_joints.angle_rad[0])}, rig.count_periods(HELD_S))
            continue
        torque_before_nm = rig.newest_joints.torque_nm[0]
        record = rig.drive({0: (after, target[after]())}, rig.count_periods(HELD_S))
        torques[before, after] = np.array([torque_before_nm, *record.torque_nm[:, 0]])
    rig.assert_armed()
    return torques
