"""Records motions that several tests share, because opening and waiting need most of the time on a real bus."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.rig import BackendRig, Floats, JointTargets, RigRecord

# Every ordered pair of modes once, and back to the first: an Eulerian circuit.
MODE_SEQUENCE = tuple(JointMode(int(code)) for code in "1012023031321")
MODE_SWITCHES = list(pairwise(MODE_SEQUENCE))
MODE_DURATION_S = 0.16  # of a mode before the next change


@dataclass
class PushRecording:
    """Records of joint 0 pushing against its upper end stop, and joint 1 against its lower one."""

    # The end of the push in torque mode. None if a joint has no torque mode.
    torque_mode: RigRecord | None
    requested_nm: float
    torque_limited: RigRecord
    limit_nm: float
    whole_record: RigRecord


def record_sway(rig: BackendRig) -> RigRecord:
    """Let all joints swing a little around the start pose, neighbors in opposite directions, and return the record."""
    rig.arm()
    first_tick = rig.tick
    for tick in range(rig.count_periods(1.0)):
        sway_rad = 0.3 * tolerances.STEP_RAD * math.sin(2 * math.pi * tick * rig.period_ns * 1e-9)
        targets: JointTargets = {
            i: (JointMode.POSITION, rig.home_rad[i] + sway_rad * (-1) ** i)
            for i in range(rig.joint_count)
        }
        rig.command_joints(targets)
    rig.assert_armed()
    return rig.record_since(first_tick)


def record_push(rig: BackendRig) -> PushRecording:
    """Let joints 0 and 1 push against their end stops, in opposite directions, and return the records.

    They push first in torque mode with a requested torque, then in velocity mode with a low torque limit. A joint
    without velocity mode gets a position beyond its end stop instead.
    """
    rig.arm()
    first_tick = rig.tick
    upper_stop_joint = rig.robot.joints[0]
    lower_stop_joint = rig.robot.joints[1]

    def make_targets(mode: JointMode, up: float, down: float) -> JointTargets:
        return {0: (mode, up), 1: (mode, down)}

    near_stops = make_targets(
        JointMode.POSITION,
        tolerances.NEAR_STOP_FRACTION * upper_stop_joint.angle_max_rad,
        tolerances.NEAR_STOP_FRACTION * lower_stop_joint.angle_min_rad,
    )
    rig.command_joints(near_stops, rig.count_periods(tolerances.SETTLING_TIME_S))
    requested_nm = tolerances.PUSH_TORQUE_FRACTION * upper_stop_joint.torque_limit_nm
    torque_mode_record = None
    if rig.supports_mode(0, JointMode.TORQUE) and rig.supports_mode(1, JointMode.TORQUE):
        rig.command_without_limiter(
            make_targets(JointMode.TORQUE, requested_nm, -requested_nm),
            rig.count_periods(tolerances.PUSH_DURATION_S),
        )
        torque_mode_record = rig.command_without_limiter(
            make_targets(JointMode.TORQUE, requested_nm, -requested_nm),
            tolerances.TRANSPORT_PERIODS,
        )
    limit_nm = tolerances.TORQUE_LIMIT_FRACTION * upper_stop_joint.torque_limit_nm
    speed_rad_s = min(
        tolerances.TORQUE_DEMAND_FRACTION
        * upper_stop_joint.torque_limit_nm
        / upper_stop_joint.velocity_gain_nm_s_per_rad,
        0.5 * upper_stop_joint.speed_limit_rad_s,
    )
    torque_limits_nm = [limit_nm] * rig.joint_count
    beyond_stops = make_targets(JointMode.VELOCITY, speed_rad_s, -speed_rad_s)
    if not (rig.supports_mode(0, JointMode.VELOCITY) and rig.supports_mode(1, JointMode.VELOCITY)):
        beyond_stops = make_targets(
            JointMode.POSITION,
            upper_stop_joint.angle_max_rad + tolerances.BEYOND_STOP_RAD,
            lower_stop_joint.angle_min_rad - tolerances.BEYOND_STOP_RAD,
        )
    rig.command_without_limiter(
        beyond_stops,
        rig.count_periods(tolerances.PUSH_DURATION_S),
        torque_limit_nm=torque_limits_nm,
    )
    limited_record = rig.command_without_limiter(
        beyond_stops, tolerances.TRANSPORT_PERIODS, torque_limit_nm=torque_limits_nm
    )
    rig.assert_armed()
    return PushRecording(
        torque_mode_record, requested_nm, limited_record, limit_nm, rig.record_since(first_tick)
    )


def record_mode_switches(rig: BackendRig) -> dict[tuple[JointMode, JointMode], Floats]:
    """Let joint 0 change between all pairs of modes, and return its torques by pair.

    The torques in N·m, (ticks,), start at the tick before the change. Pairs with a mode that the joint does not have
    are left out.
    """
    rig.arm()
    slow_rad_s = 0.3 * tolerances.MOTION_SPEED_RAD_S
    gentle_nm = 0.02 * rig.full_torque_nm[0]
    home_rad = rig.home_rad[0]

    def sign_towards_home() -> float:
        """Return the sign of the direction towards the start pose."""
        return -math.copysign(1.0, rig.newest_joints.angle_rad[0] - home_rad)

    make_target_by_mode: dict[JointMode, Callable[[], float]] = {
        JointMode.PASSIVE: lambda: 0.0,
        JointMode.POSITION: lambda: rig.newest_joints.angle_rad[0],
        JointMode.VELOCITY: lambda: sign_towards_home() * slow_rad_s,
        JointMode.TORQUE: lambda: sign_towards_home() * gentle_nm,
    }
    rig.command_joints({0: (MODE_SEQUENCE[0], home_rad)}, rig.count_periods(MODE_DURATION_S))
    torques_by_switch: dict[tuple[JointMode, JointMode], Floats] = {}
    for before, after in MODE_SWITCHES:
        if not (rig.supports_mode(0, before) and rig.supports_mode(0, after)):
            rig.command_joints(
                {0: (JointMode.POSITION, rig.newest_joints.angle_rad[0])},
                rig.count_periods(MODE_DURATION_S),
            )
            continue
        torque_before_nm = rig.newest_joints.torque_nm[0]
        record = rig.command_joints(
            {0: (after, make_target_by_mode[after]())}, rig.count_periods(MODE_DURATION_S)
        )
        torques_by_switch[before, after] = np.array([torque_before_nm, *record.torque_nm[:, 0]])
    rig.assert_armed()
    return torques_by_switch
