"""The command limiter refuses invalid commands with a reason, and names the limits that change others."""

from typing import Any, get_args

import msgspec
import numpy as np
import pytest

from snakesim_hal.safety.joint_limits import JointLimits
from snakesim_hal.safety.lease import CommandLease
from snakesim_hal.safety.limiter import RejectionReason, find_rejection_reason, make_safe_setpoints
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointCommand, JointMode, SensorDescription
from snakesim_testing.hal.limiter_rig import (
    JOINT_COUNT,
    LEASE,
    LIMITS,
    ROBOT,
    find_limit_names,
    limit_in_equal_states,
    limit_setpoints,
    make_last_setpoints,
    make_measured_state,
)
from snakesim_testing.hal.small_robots import LEASE_NS, make_description, make_joint_command


def find_reason(command: JointCommand, **changes: Any) -> RejectionReason | None:
    """Return why a command is refused, in usual circumstances with some changes."""
    values: dict[str, Any] = {
        "lease": LEASE,
        "now_ns": 900,
        "tick": 5,
        "last_sequence": 0,
        "age_ns": 0,
    } | changes
    limits = values.pop("limits", LIMITS)
    return find_rejection_reason(command, limits=limits, **values)


# --- refusals --------------------------------------------------------------------------------------------------

SERVO_LIMITS = JointLimits.from_description(
    make_description(
        drive__modes=["position"], joints={"joint_3": {"modes": ["position", "velocity"]}}
    )
)
NAN = float("nan")
INF = float("inf")
REFUSED_COMMANDS: dict[RejectionReason, list[tuple[dict[str, Any], dict[str, Any]]]] = {
    "no_lease": [({}, {"lease": CommandLease(epoch=1)}), ({}, {"now_ns": 1001})],
    "wrong_epoch": [({"lease_epoch": 0}, {}), ({"lease_epoch": 2}, {})],
    "replayed": [({"sequence": 1}, {"last_sequence": 1}), ({"sequence": 1}, {"last_sequence": 2})],
    "from_the_future": [({"tick": 6}, {})],
    "stale": [
        ({"valid_for_ns": 10}, {"age_ns": 11}),
        # No command may be valid for more than a lease term.
        ({"valid_for_ns": 2**62}, {"age_ns": LEASE_NS + 1}),
        ({"valid_for_ns": 2**62}, {"age_ns": 2**61}),
    ],
    "wrong_layout": [({"layout": "of another robot"}, {})],
    "wrong_length": [
        ({"target": [0.0] * (JOINT_COUNT - 1)}, {}),
        ({"target": [0.0] * (JOINT_COUNT + 1)}, {}),
        ({"target": []}, {}),
        ({"mode": [JointMode.POSITION] * (JOINT_COUNT + 1)}, {}),
        ({"mode": [], "target": []}, {}),
        ({"torque_limit_nm": [1.0]}, {}),
        ({"torque_limit_nm": []}, {}),
    ],
    "wrong_mode": [
        (
            {"mode": [JointMode.POSITION, JointMode.TORQUE, JointMode.POSITION]},
            {"limits": SERVO_LIMITS},
        ),
        ({"mode": [JointMode.VELOCITY] * JOINT_COUNT}, {"limits": SERVO_LIMITS}),
    ],
    "not_finite": [
        ({"target": [0.0, NAN, 0.0]}, {}),
        ({"target": [INF, 0.0, 0.0]}, {}),
        ({"target": [0.0, 0.0, -INF]}, {}),
        ({"target": [NAN] * JOINT_COUNT, "mode": [JointMode.PASSIVE] * JOINT_COUNT}, {}),
        ({"torque_limit_nm": [1.0, NAN, 1.0]}, {}),
        ({"torque_limit_nm": [1.0, INF, 1.0]}, {}),
    ],
}


def test_limiter_valid_command_is_accepted() -> None:
    assert find_reason(make_joint_command(ROBOT)) is None
    assert find_reason(make_joint_command(ROBOT, torque_limit_nm=[0.0] * JOINT_COUNT)) is None
    assert find_reason(make_joint_command(ROBOT, tick=5), now_ns=1000) is None
    assert find_reason(make_joint_command(ROBOT, valid_for_ns=10), age_ns=10) is None
    assert find_reason(make_joint_command(ROBOT, valid_for_ns=0), age_ns=0) is None
    assert (
        find_reason(
            make_joint_command(
                ROBOT, mode=[JointMode.PASSIVE, JointMode.POSITION, JointMode.VELOCITY]
            ),
            limits=SERVO_LIMITS,
        )
        is None
    )


@pytest.mark.parametrize(
    ("reason", "case"),
    [(reason, case) for reason, cases in REFUSED_COMMANDS.items() for case in cases],
)
def test_limiter_invalid_command_is_refused_with_its_reason(
    reason: RejectionReason, case: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    changes, circumstances = case
    assert find_reason(make_joint_command(ROBOT, **changes), **circumstances) == reason


def test_limiter_every_rejection_reason_has_a_test() -> None:
    assert list(REFUSED_COMMANDS) == list(get_args(RejectionReason))


def test_limiter_reports_the_first_reason_in_its_order() -> None:
    defects: list[tuple[RejectionReason, dict[str, Any], dict[str, Any]]] = [
        ("not_finite", {"target": [NAN] * JOINT_COUNT}, {}),
        ("wrong_length", {"torque_limit_nm": [1.0]}, {}),
        ("wrong_layout", {"layout": "other"}, {}),
        ("stale", {"valid_for_ns": 10}, {"age_ns": 11}),
        ("from_the_future", {"tick": 6}, {}),
        ("replayed", {}, {"last_sequence": 1}),
        ("wrong_epoch", {"lease_epoch": 0}, {}),
        ("no_lease", {}, {"now_ns": 1001}),
    ]
    fields: dict[str, Any] = {}
    all_circumstances: dict[str, Any] = {}
    for reason, changes, circumstances in defects:
        fields |= changes
        all_circumstances |= circumstances
        assert find_reason(make_joint_command(ROBOT, **fields), **all_circumstances) == reason


# --- heat ------------------------------------------------------------------------------------------------------


TORQUE_FRACTIONS = np.array([1.0, 0.5, 0.25])  # allowed part of the 4 N·m of each joint


def limit_hot_joints(command: JointCommand) -> tuple[list[float], dict[int, str]]:
    """Limit a command to joints that are cool, warm and hot; return torque limits, and reasons by joint."""
    applied = limit_setpoints(
        command, make_measured_state(), make_last_setpoints(JointMode.TORQUE, 2.0), TORQUE_FRACTIONS
    )
    return applied.torque_limit_nm.tolist(), find_limit_names(
        command, applied, make_measured_state(), TORQUE_FRACTIONS
    )


@pytest.mark.parametrize(
    ("commanded_limit_nm", "applied_limit_nm", "reasons"),
    [
        (None, [4.0, 2.0, 1.0], {1: "thermal", 2: "thermal"}),
        (2.0, [2.0, 2.0, 1.0], {2: "thermal"}),
        # The limit in the command is below its target.
        (1.0, [1.0, 1.0, 1.0], {0: "torque", 1: "torque", 2: "torque"}),
    ],
)
def test_limiter_hot_joint_has_lower_torque_limit(
    commanded_limit_nm: float | None, applied_limit_nm: list[float], reasons: dict[int, str]
) -> None:
    limits_nm = None if commanded_limit_nm is None else [commanded_limit_nm] * JOINT_COUNT
    command = make_joint_command(ROBOT, 2.0, JointMode.TORQUE, torque_limit_nm=limits_nm)
    assert limit_hot_joints(command) == (applied_limit_nm, reasons)


def test_limiter_cool_joint_with_excessive_torque_is_limited_by_rating() -> None:
    _, reasons = limit_hot_joints(make_joint_command(ROBOT, 9.0, JointMode.TORQUE))
    assert reasons == {0: "torque", 1: "thermal", 2: "thermal"}


def test_limiter_changed_target_of_hot_joint_names_target_limit() -> None:
    _, reasons = limit_hot_joints(make_joint_command(ROBOT, 9.0, JointMode.POSITION))
    assert reasons == dict.fromkeys(range(JOINT_COUNT), "angle")


def test_limiter_passive_hot_joint_is_not_limited() -> None:
    _, reasons = limit_hot_joints(make_joint_command(ROBOT, 9.0, JointMode.PASSIVE))
    assert reasons == {}


# --- names of limits -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "requested", "limit_name"),
    [
        (JointMode.POSITION, 2.0, "angle"),
        (JointMode.POSITION, -2.0, "angle"),
        (JointMode.POSITION, 1.0, "angle_rate"),
        (JointMode.POSITION, 1.5, "angle_rate"),
        (JointMode.POSITION, -1.5, "angle_rate"),
        (JointMode.VELOCITY, 6.0, "speed"),
        (JointMode.VELOCITY, -4.0, "acceleration"),
        (JointMode.VELOCITY, 5.0, "acceleration"),
        (JointMode.TORQUE, 5.0, "torque"),
        (JointMode.TORQUE, 4.0, "torque_rate"),
        (JointMode.TORQUE, -3.0, "torque_rate"),
        (JointMode.POSITION, 0.01, None),
        (JointMode.VELOCITY, 0.5, None),
        (JointMode.TORQUE, 0.5, None),
        (JointMode.PASSIVE, 3.0, None),
    ],
)
def test_limiter_changed_target_is_named_by_its_limit(
    mode: JointMode, requested: float, limit_name: str | None
) -> None:
    command = make_joint_command(ROBOT, [0.0, requested, 0.0], mode)
    applied = limit_setpoints(command, make_measured_state(), make_last_setpoints(mode))
    assert find_limit_names(command, applied, make_measured_state()) == (
        {} if limit_name is None else {1: limit_name}
    )


def test_limiter_setpoints_for_the_backend_are_plain_python() -> None:
    applied = limit_in_equal_states(make_joint_command(ROBOT, 0.01))
    setpoints = make_safe_setpoints(applied, frozenset({1}))
    assert setpoints.isolated == {1}
    assert setpoints.mode == [JointMode.POSITION] * JOINT_COUNT
    assert all(type(mode) is JointMode for mode in setpoints.mode)
    assert all(type(value) is float for value in setpoints.target + setpoints.torque_limit_nm)


@pytest.mark.parametrize(
    ("period_ms", "delay_ms", "max_age_ms"),
    [(10, 0, 30), (1, 0, 30), (20, 0, 60), (40, 0, 100), (10, 5, 35), (10, 40, 50)],
)
def test_limiter_max_state_age_follows_period_and_delay(
    period_ms: int, delay_ms: int, max_age_ms: int
) -> None:
    """Allow three periods or 30 ms, and the delay of the sensor, but never more than the lease."""
    period_ns = period_ms * 1_000_000
    sensor = SensorDescription(key=keys.JOINTS, rate_hz=100.0, delay_s=delay_ms * 1e-3)
    lease_ns = min(max(5 * period_ns, 50_000_000), 100_000_000)
    robot = msgspec.structs.replace(ROBOT, period_ns=period_ns, lease_ns=lease_ns, sensors=[sensor])
    assert JointLimits.from_description(robot).max_state_age_ns == max_age_ms * 1_000_000


def test_limiter_without_joint_sensor_assumes_oldest_allowed_state() -> None:
    robot = msgspec.structs.replace(ROBOT, sensors=[])
    assert (
        JointLimits.from_description(robot).max_state_age_ns
        == max(3 * ROBOT.period_ns, 30_000_000)
        < ROBOT.lease_ns
    )
