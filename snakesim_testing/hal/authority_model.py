"""Predicts what a command authority must do, and checks what it does, for test_authority_machine.py."""

import math
from typing import Any

import pytest
from hypothesis.stateful import RuleBasedStateMachine

from snakesim_hal.safety.authority import CommandAuthority, TickOutput
from snakesim_hal.safety.fault_log import MAX_FAULTS
from snakesim_hal.wire.messages import Answer, JointCommand, JointMode, LifecycleState
from snakesim_testing.hal.small_robots import LEASE_NS, PERIOD_NS

JOINT_COUNT = 3
ALL_JOINTS = list(range(JOINT_COUNT))
# In the order in which the authority reports them for a joint.
HEALTH_FAULTS = ("overheated", "leak", "undervoltage")
PERIOD_S = PERIOD_NS * 1e-9

# Limits of every joint of the test robot, as in `ROBOT` of `small_robots`. Angles are limited to both sides of 0.
ANGLE_LIMIT_RAD = 1.5
SPEED_LIMIT_RAD_S = 5.0
ACCELERATION_LIMIT_RAD_S2 = 100.0
TORQUE_LIMIT_NM = 4.0
TORQUE_RATE_LIMIT_NM_S = 80.0
MAX_STEP_RAD = 0.3  # maximum distance of a position target from the measured angle

# Gains of the drives' own controllers.
STIFFNESS_NM_PER_RAD = 40.0
DAMPING_NM_S_PER_RAD = 1.0
VELOCITY_GAIN_NM_S_PER_RAD = 1.0

# Gain of the limiter, which brakes a joint near its end stops with a torque proportional to its excess speed.
BRAKE_GAIN_NM_S_PER_RAD = 1.0
REACTION_S = 4 * PERIOD_S  # a joint keeps its speed for this time before it brakes

# A measured angle is plausible if the joint can have moved there since the last plausible angle.
MAX_PLAUSIBLE_SPEED_RAD_S = 2 * SPEED_LIMIT_RAD_S
PLAUSIBLE_ERROR_RAD = 0.05
MIN_IMPLAUSIBLE_ANGLES = (
    5  # so many that agree with each other become plausible while the robot is not armed
)
ANY_MOTION_TIME_NS = 1_000_000_000  # after this time any angle is plausible

# Limits of the health of a joint module.
DERATE_FROM_C = 80.0
STOP_AT_C = 105.0
MIN_TORQUE_FRACTION = 0.2  # at STOP_AT_C
MIN_VOLTAGE_V = 18.0
LOW_VOLTAGE_TIME_NS = 50_000_000  # a lower voltage is a fault after this time
MAX_HEALTH_AGE_NS = 3_000_000_000

TINY = 1e-9
NAN = float("nan")
INF = float("inf")


def clamp(value: float, low: float, high: float) -> float:
    """Return the value, limited to the range from low to high."""
    return min(max(value, low), high)


def compute_max_stopping_speed_rad_s(distance_rad: float) -> float:
    """Return the highest speed from which a joint still stops within a distance; 0 if there is no distance left.

    The joint keeps its speed v for the reaction time t, and then brakes with the limit a of its acceleration:

        distance = v t + v² / (2 a), so v = a (sqrt(t² + 2 distance / a) - t)
    """
    if distance_rad <= 0:
        return 0.0
    total_time_s = math.sqrt(REACTION_S**2 + 2 * distance_rad / ACCELERATION_LIMIT_RAD_S2)
    return ACCELERATION_LIMIT_RAD_S2 * (total_time_s - REACTION_S)


def compute_torque_bounds_nm(
    angle_rad: float, velocity_rad_s: float, torque_limit_nm: float
) -> tuple[float, float]:
    """Return the lowest and the highest torque with which a joint can still stop at its end stops.

    A torque may accelerate the joint up to the speed from which it stops in time. Above that speed the bound has the
    opposite sign, and brakes the joint. At an end stop no torque may push further outwards.

    Args:
        angle_rad: Measured angle of the joint.
        velocity_rad_s: Its measured velocity.
        torque_limit_nm: Torque limit of its drive, which also limits both bounds.
    """
    max_speed_down_rad_s = compute_max_stopping_speed_rad_s(ANGLE_LIMIT_RAD + angle_rad)
    max_speed_up_rad_s = compute_max_stopping_speed_rad_s(ANGLE_LIMIT_RAD - angle_rad)
    low_nm = BRAKE_GAIN_NM_S_PER_RAD * (-max_speed_down_rad_s - velocity_rad_s)
    high_nm = BRAKE_GAIN_NM_S_PER_RAD * (max_speed_up_rad_s - velocity_rad_s)
    # At a stop, no torque outwards. The other bound moves with it where it would lie beyond it.
    is_at_upper_stop = angle_rad >= ANGLE_LIMIT_RAD
    if is_at_upper_stop:
        high_inwards_nm = min(high_nm, 0.0)
        low_nm = min(low_nm, high_inwards_nm)
        high_nm = high_inwards_nm
    is_at_lower_stop = angle_rad <= -ANGLE_LIMIT_RAD
    if is_at_lower_stop:
        low_inwards_nm = max(low_nm, 0.0)
        high_nm = max(high_nm, low_inwards_nm)
        low_nm = low_inwards_nm
    return (
        clamp(low_nm, -torque_limit_nm, torque_limit_nm),
        clamp(high_nm, -torque_limit_nm, torque_limit_nm),
    )


def compute_holding_position_rad(
    angle_rad: float, velocity_rad_s: float, torque_nm: float
) -> float:
    """Return the position target with which a drive would produce the torque that was measured.

    A drive in position mode produces torque = stiffness (target - angle) - damping velocity. A joint that enters
    position mode starts from this target, so its torque does not jump.
    """
    return angle_rad + (torque_nm + DAMPING_NM_S_PER_RAD * velocity_rad_s) / STIFFNESS_NM_PER_RAD


def compute_holding_velocity_rad_s(velocity_rad_s: float, torque_nm: float) -> float:
    """Return the velocity target with which a drive would produce the torque that was measured.

    A drive in velocity mode produces torque = gain (target - velocity).
    """
    return velocity_rad_s + torque_nm / VELOCITY_GAIN_NM_S_PER_RAD


class ModeledHealth:
    """The newest health report of one joint module, and the faults and the derating that follow from it."""

    def __init__(self) -> None:
        self.received_ns: int | None = None
        self.winding_c = 20.0
        self.voltage_v = 24.0
        self.leak = False
        self.is_overheated = False
        self.low_since_ns: int | None = None

    def is_known(self, now_ns: int) -> bool:
        """Return whether the newest report is not too old."""
        return self.received_ns is not None and now_ns - self.received_ns <= MAX_HEALTH_AGE_NS

    def find_faults(self, now_ns: int) -> set[str]:
        """Return the names of the faults. An overheated module stays overheated without new reports."""
        faults = set[str]()
        if self.is_overheated:
            faults.add("overheated")
        if self.is_known(now_ns):
            if self.leak:
                faults.add("leak")
            if self.low_since_ns is not None and now_ns - self.low_since_ns >= LOW_VOLTAGE_TIME_NS:
                faults.add("undervoltage")
        return faults

    def compute_torque_fraction(self, now_ns: int) -> float:
        """Return the fraction of its full torque that the module may use at its temperature."""
        if not self.is_known(now_ns):
            return 1.0
        relative_heat = (self.winding_c - DERATE_FROM_C) / (STOP_AT_C - DERATE_FROM_C)
        return 1.0 - (1.0 - MIN_TORQUE_FRACTION) * clamp(relative_heat, 0.0, 1.0)


class AuthorityModel(RuleBasedStateMachine):
    """A model that predicts every decision of an authority, for comparison with the real one."""

    authority: CommandAuthority
    action: str
    max_isolated: int

    def __init__(self) -> None:
        """Start the model of an authority that is disarmed, without a lease, a command or a joint state.

        The model predicts every decision of the safety core from the same events, but computes it in another way.
        Tests compare the two.
        """
        super().__init__()
        self.now_ns = 0
        self.tick = 0
        self.sequence = 0
        self.state: LifecycleState = "disarmed"
        self.arm_session = 0
        self.seen_tick = 0  # of the newest joint state
        self.armed_tick = -1  # of the state that was the newest at the last arming
        self.holder: str | None = None
        self.epoch = 0
        self.priority = 0
        self.expires_ns = 0
        # The time at which it arrived, and the command of the present holder of the lease.
        self.newest_command: tuple[int, JointCommand] | None = None
        self.commands_since_arming: list[JointCommand] = []
        # The one of these commands that decided the last tick.
        self.active_command: JointCommand | None = None
        self.last_sequence = -1
        self.measured: tuple[list[float], list[float], list[float]] = (
            [0.0] * JOINT_COUNT,
            [0.0] * JOINT_COUNT,
            [0.0] * JOINT_COUNT,
        )
        # Joints whose newest state is not plausible. None: the state of all joints is unusable.
        self.doubtful_joints: set[int] | None = set(ALL_JOINTS)
        self.isolated: set[int] = set()  # joints that have failed
        self.offered = 0
        self.rejected = 0
        self.faults = 0  # kept since the last reset
        self.hold_angles_rad = [0.0] * JOINT_COUNT
        # The planned angle, the planned velocity and the position target of every joint while it brakes.
        self.braking_states: list[list[float]] | None = None
        self.timestamp_ns = 0
        # Each angle in rad with the time of its measurement in s.
        self.last_plausible_angles: list[tuple[float, float] | None] = [None] * JOINT_COUNT
        self.implausible_angles: list[list[tuple[float, float]]] = [[] for _ in range(JOINT_COUNT)]
        # The measured state, the time of its measurement in s, and the target at that time.
        self.unchanged_states: list[list[tuple[Any, float, float]]] = [
            [] for _ in range(JOINT_COUNT)
        ]
        self.healths = [ModeledHealth() for _ in range(JOINT_COUNT)]
        self.health_faults: set[tuple[str, int]] = set()  # at the last tick
        self.silent: set[int] = set()
        self.torque_fractions = [1.0] * JOINT_COUNT
        self.is_stop_sent = True  # the last stop was sent to the motors
        self.last_output: TickOutput | None = None

    @property
    def is_lease_held(self) -> bool:
        """Whether a holder has the lease, and it has not expired."""
        return self.holder is not None and self.now_ns <= self.expires_ns

    def change_state(self, following: LifecycleState) -> None:
        """Enter a lifecycle state. A robot that was armed begins to brake."""
        if following != self.state:
            self.hold_angles_rad = self.measured[0]
            self.braking_states = None
            if self.state == "armed":
                self.braking_states = [self.compute_braking_start(i) for i in range(JOINT_COUNT)]
            self.is_stop_sent = self.is_stop_sent and following != "disarmed"
        if self.state == "armed":
            self.newest_command = None
        self.state = following

    def mode_before(self, i: int) -> JointMode:
        """Return the mode of joint i in the last tick."""
        if self.last_output is None:
            return JointMode.PASSIVE
        return self.last_output.setpoints.mode[i]

    def target_before(self, i: int) -> float:
        """Return the target of joint i in the last tick."""
        if self.last_output is None:
            return 0.0
        return self.last_output.setpoints.target[i]

    def compute_braking_start(self, i: int) -> list[float]:
        """Return angle, velocity and position target from which joint i brakes when the robot stops being armed."""
        angle, velocity, torque = (column[i] for column in self.measured)
        target = compute_holding_position_rad(angle, velocity, torque)
        if self.mode_before(i) is JointMode.POSITION:
            target = self.target_before(i)
        near_angle = clamp(target, angle - MAX_STEP_RAD, angle + MAX_STEP_RAD)
        target = clamp(near_angle, -ANGLE_LIMIT_RAD, ANGLE_LIMIT_RAD)
        return [
            clamp(angle, -ANGLE_LIMIT_RAD, ANGLE_LIMIT_RAD),
            clamp(velocity, -SPEED_LIMIT_RAD_S, SPEED_LIMIT_RAD_S),
            target,
        ]

    def brake_for_a_period(self, i: int) -> float:
        """Brake joint i for one period with the acceleration limit, and return its next position target in rad."""
        assert self.braking_states is not None
        planned_angle, velocity, target = self.braking_states[i]
        slower_speed = max(abs(velocity) - ACCELERATION_LIMIT_RAD_S2 * PERIOD_S, 0.0)
        slower_velocity = math.copysign(slower_speed, velocity)
        planned_angle = clamp(
            planned_angle + (velocity + slower_velocity) / 2 * PERIOD_S,
            -ANGLE_LIMIT_RAD,
            ANGLE_LIMIT_RAD,
        )
        max_change = SPEED_LIMIT_RAD_S * PERIOD_S
        target = clamp(planned_angle, target - max_change, target + max_change)
        self.braking_states[i] = [planned_angle, slower_velocity, target]
        return target

    def check_angle_plausible(self, i: int, angle: float, taken_s: float) -> bool:
        """Return whether a finite, valid angle is plausible, and remember it if it is not.

        An angle is plausible if the joint can have moved there since the last plausible angle. While the robot is not
        armed, it also becomes plausible after enough implausible angles that agree with each other.

        Args:
            i: Index of the joint.
            angle: Measured angle in rad.
            taken_s: Time of the measurement in s.
        """

        def is_reachable_from(earlier: tuple[float, float]) -> bool:
            earlier_angle, earlier_s = earlier
            duration_s = max(taken_s - earlier_s, 0.0)
            max_change = PLAUSIBLE_ERROR_RAD + MAX_PLAUSIBLE_SPEED_RAD_S * duration_s
            return abs(angle - earlier_angle) <= max_change

        last_plausible = self.last_plausible_angles[i]
        if last_plausible is None or is_reachable_from(last_plausible):
            return True
        implausible = self.implausible_angles[i]
        if implausible and not is_reachable_from(implausible[-1]):
            implausible.clear()
        is_repeated = bool(implausible) and taken_s <= implausible[-1][1]
        implausible.append((angle, taken_s))
        if is_repeated:
            implausible.pop(0)
        return len(implausible) >= MIN_IMPLAUSIBLE_ANGLES and self.state != "armed"

    def is_frozen(self, i: int, state: Any, taken_s: float) -> bool:
        """Return whether a joint reports the same state for longer than a lease while its target moves away.

        Only an armed joint in position mode can be frozen, and none whose torque is at its limit: it may be blocked.

        Args:
            i: Index of the joint.
            state: Its newest angle, velocity and torque.
            taken_s: Time of the measurement in s.
        """
        if self.state != "armed" or self.mode_before(i) is not JointMode.POSITION:
            self.unchanged_states[i] = []
            return False
        if self.unchanged_states[i] and self.unchanged_states[i][-1][0] != state:
            self.unchanged_states[i] = []
        self.unchanged_states[i].append((state, taken_s, self.target_before(i)))
        limit_nm = TORQUE_LIMIT_NM
        if self.last_output:
            limit_nm = self.last_output.setpoints.torque_limit_nm[i]
        # Range of the targets from the first unchanged state to each of the others.
        targets = [target for _, _, target in self.unchanged_states[i]]
        target_ranges_rad = [
            max(targets[: k + 1]) - min(targets[: k + 1]) for k in range(len(targets))
        ]
        # Times at which a working joint would have moved.
        expected_motion_times_s = [
            state_time_s
            for (_, state_time_s, _), range_rad in zip(
                self.unchanged_states[i], target_ranges_rad, strict=True
            )
            if range_rad > MAX_STEP_RAD / 4
        ]
        if not expected_motion_times_s:
            return False
        is_overdue = taken_s - min(expected_motion_times_s) > LEASE_NS * 1e-9
        is_blocked = not abs(state[2]) < 0.95 * limit_nm
        return is_overdue and not is_blocked

    def release_lease(self) -> None:
        """Take the lease from its holder, and discard its command."""
        self.holder = self.newest_command = None
        self.last_sequence = -1

    def count_fault(self) -> None:
        """Count one more logged fault, up to the limit of the log."""
        self.faults = min(self.faults + 1, MAX_FAULTS)

    def fail(self) -> None:
        """Log a fault, release the lease, and enter `fault` unless the emergency stop is active."""
        if self.state != "estop":
            self.change_state("fault")
        self.release_lease()
        self.count_fault()

    def try_to_isolate(self, joints: set[int]) -> bool:
        """Isolate failed joints if that is allowed, and return whether the robot continues without them."""
        if joints <= self.isolated:
            return True
        if self.state != "armed" or len(self.isolated | joints) > self.max_isolated:
            return False
        self.isolated |= joints
        self.count_fault()
        return True

    def isolate_or_fail(self, joints: set[int] | None) -> None:
        """Isolate failed joints, or fail if that is not allowed. None: the failure does not concern single joints."""
        if joints is None or not self.try_to_isolate(joints):
            self.fail()

    @property
    def has_valid_joint_state(self) -> bool:
        """Whether the newest joint state is fresh and valid."""
        return self.doubtful_joints == set()

    def check_answer(self, answer: Answer, ok: bool) -> None:
        """Check that the authority accepted or refused a request, and that its answer is complete."""
        assert answer.ok == ok and (answer.refusal is None) == ok, answer
        assert answer.reason
        assert answer.epoch == self.epoch
        assert answer.lifecycle == self.state

    def check_isolated(self, decision: TickOutput) -> None:
        """Check that the authority isolates the right joints, and that these are passive."""
        setpoints = decision.setpoints
        assert setpoints.isolated == self.isolated
        assert len(self.isolated) <= self.max_isolated
        assert self.authority.isolated_joints == [f"joint_{i + 1}" for i in sorted(self.isolated)]
        for i in self.isolated:
            assert setpoints.mode[i] == JointMode.PASSIVE
            assert setpoints.target[i] == 0.0
            assert setpoints.torque_limit_nm[i] == 0.0

    def select_connected(self, values: list[Any]) -> list[Any]:
        """Return the values of the joints that are not isolated."""
        return [value for i, value in enumerate(values) if i not in self.isolated]

    def approximate_torque_limits(self) -> Any:
        """Return the derated torque limits of the connected joints, for an approximate comparison."""
        limits_nm = [TORQUE_LIMIT_NM * fraction for fraction in self.torque_fractions]
        return pytest.approx(self.select_connected(limits_nm))

    def check_safe(self, decision: TickOutput) -> None:
        """Check the setpoints of a tick without an active command: they are those of the stop mode, or passive.

        Args:
            decision: Output of the authority in this tick.
        """
        assert decision.command_sequence is None
        assert not decision.limit_by_joint
        action = "passive"
        if self.state == "fault" and self.braking_states is not None:
            action = self.action
        assert (
            self.select_connected(decision.setpoints.torque_limit_nm)
            == self.approximate_torque_limits()
        )
        if action == "hold":
            assert set(self.select_connected(decision.setpoints.mode)) <= {JointMode.POSITION}
            held = [self.brake_for_a_period(i) for i in range(JOINT_COUNT)]
            assert self.select_connected(decision.setpoints.target) == pytest.approx(
                self.select_connected(held)
            )
            assert all(abs(target) <= ANGLE_LIMIT_RAD for target in decision.setpoints.target)
            return
        mode = JointMode.VELOCITY if action == "damp" else JointMode.PASSIVE
        assert set(self.select_connected(decision.setpoints.mode)) <= {mode}
        assert decision.setpoints.target == [0.0] * JOINT_COUNT

    def check_held(self, decision: TickOutput, angle_rad: list[float]) -> None:
        """Check that all connected joints hold these angles, as far as their limits permit."""
        assert set(self.select_connected(decision.setpoints.mode)) <= {JointMode.POSITION}
        assert not decision.limit_by_joint
        held = [clamp(angle, -ANGLE_LIMIT_RAD, ANGLE_LIMIT_RAD) for angle in angle_rad]
        assert self.select_connected(decision.setpoints.target) == self.select_connected(held)
        assert (
            self.select_connected(decision.setpoints.torque_limit_nm)
            == self.approximate_torque_limits()
        )

    def check_commanded(self, decision: TickOutput, sent: JointCommand) -> None:
        """Check the setpoints of a tick in which a command is active: mode, torque limit and target of every joint.

        Isolated joints are passive with every command. A torque limit is at most that of the command and that of
        the drive at its present temperature, and rises no faster than the limit of the torque's rate of change.

        Args:
            decision: Output of the authority in this tick.
            sent: The active command.
        """
        for i in self.isolated:
            expected_limit = None if sent.mode[i] is JointMode.PASSIVE else "isolated"
            assert decision.limit_by_joint.get(i) == expected_limit
        assert self.select_connected(decision.setpoints.mode) == self.select_connected(sent.mode)
        for i in self.select_connected(ALL_JOINTS):
            applied_nm = decision.setpoints.torque_limit_nm[i]
            previous_nm = TORQUE_LIMIT_NM
            if self.last_output is not None:
                previous_nm = self.last_output.setpoints.torque_limit_nm[i]
            commanded_nm = TORQUE_LIMIT_NM
            if sent.torque_limit_nm is not None:
                commanded_nm = sent.torque_limit_nm[i]
            derated_nm = TORQUE_LIMIT_NM * self.torque_fractions[i] + TINY
            assert 0.0 <= applied_nm <= min(derated_nm, commanded_nm)
            assert applied_nm <= previous_nm + TORQUE_RATE_LIMIT_NM_S * PERIOD_S + TINY
            if sent.mode[i] is not JointMode.PASSIVE:
                is_derated = min(TORQUE_LIMIT_NM, commanded_nm) > derated_nm
                self.check_target(i, decision, sent.mode[i], sent.target[i], is_derated=is_derated)
            else:
                assert decision.setpoints.target[i] == 0.0
                assert i not in decision.limit_by_joint

    def check_target(
        self, i: int, decision: TickOutput, mode: JointMode, wanted: float, *, is_derated: bool
    ) -> None:
        """Check the target that the authority applied to one joint.

        It must be inside the limits, change no faster than allowed, and be as near to the command as both permit. A
        target that differs from the command must be reported as limited.

        Args:
            i: Index of the joint.
            decision: Output of the authority in this tick.
            mode: Mode of the command.
            wanted: Target of the command, in rad, rad/s or N·m, by its mode.
            is_derated: Whether the drive's temperature lowers the torque limit of the command.
        """
        angle, velocity, torque = (column[i] for column in self.measured)
        target = decision.setpoints.target[i]
        # `previous` is the target before: in a new mode it is the one with which the torque does not jump.
        match mode:
            case JointMode.POSITION:
                low = clamp(angle - MAX_STEP_RAD, -ANGLE_LIMIT_RAD, ANGLE_LIMIT_RAD)
                high = clamp(angle + MAX_STEP_RAD, -ANGLE_LIMIT_RAD, ANGLE_LIMIT_RAD)
                max_change = SPEED_LIMIT_RAD_S * PERIOD_S
                previous = compute_holding_position_rad(angle, velocity, torque)
            case JointMode.VELOCITY:
                low = max(
                    -SPEED_LIMIT_RAD_S, -compute_max_stopping_speed_rad_s(ANGLE_LIMIT_RAD + angle)
                )
                high = min(
                    SPEED_LIMIT_RAD_S, compute_max_stopping_speed_rad_s(ANGLE_LIMIT_RAD - angle)
                )
                max_change = ACCELERATION_LIMIT_RAD_S2 * PERIOD_S
                previous = compute_holding_velocity_rad_s(velocity, torque)
            case _:
                low, high = compute_torque_bounds_nm(
                    angle, velocity, decision.setpoints.torque_limit_nm[i]
                )
                max_change = TORQUE_RATE_LIMIT_NM_S * PERIOD_S
                previous = torque
        if self.last_output is not None and self.last_output.setpoints.mode[i] is mode:
            previous = self.last_output.setpoints.target[i]
        assert math.isfinite(target)
        assert low <= target <= high
        # The limits have priority over the rate of change.
        assert abs(target - previous) <= max_change + TINY or target in (low, high)
        nearest_reachable = clamp(wanted, previous - max_change, previous + max_change)
        assert abs(target - clamp(nearest_reachable, low, high)) <= TINY
        assert (i in decision.limit_by_joint) == (target != wanted or is_derated)
