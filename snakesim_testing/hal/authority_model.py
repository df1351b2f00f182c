"""What the authority ought to do, and the judgement of what it does, for test_authority_machine.py."""

import math
from typing import Any

import pytest
from hypothesis.stateful import RuleBasedStateMachine

from snakesim_hal.safety.authority import Authority, TickDecision
from snakesim_hal.safety.fault_log import MAX_FAULTS
from snakesim_hal.wire.messages import Answer, JointCommand, LifecycleState, Mode
from snakesim_testing.hal.small_robots import LEASE_NS, PERIOD_NS

JOINTS = 3
ALL = list(range(JOINTS))
WORDS = ("overheated", "leak", "undervoltage")  # in the order in which they are reported for a joint
PERIOD_S = PERIOD_NS * 1e-9
ANGLE, SPEED, ACCELERATION, TORQUE, TORQUE_RATE, FAR = 1.5, 5.0, 100.0, 4.0, 80.0, 0.3  # of the test robot
STIFFNESS, DAMPING, VELOCITY_GAIN = 40.0, 1.0, 1.0
REACH, SLACK = 2 * SPEED, 0.05  # rad/s and rad: what is believed of a joint
REACTION_S = 4 * PERIOD_S
DERATE_FROM, STOP_AT, MIN_V, MIN_SHARE = 80.0, 105.0, 18.0, 0.2
KNOWN_FOR_NS, LOW_FOR_NS = 3_000_000_000, 50_000_000
LONG_NS = 1_000_000_000  # a joint may be anywhere after that
TINY = 1e-9
NAN, INF = float("nan"), float("inf")


def within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def stoppable(distance: float) -> float:
    """Return the speed from which a joint stops within a distance, after it went on for the reaction time."""
    if distance <= 0:
        return 0.0
    return ACCELERATION * (math.sqrt(REACTION_S**2 + 2 * distance / ACCELERATION) - REACTION_S)


def torque_bounds(angle: float, velocity: float, torque_limit: float) -> tuple[float, float]:
    """Return the range of torques that keep a joint able to stop at its end stops.

    Args:
        angle: Angle of the joint in rad.
        velocity: Its velocity in rad/s.
        torque_limit: Torque limit in N·m.
    """
    # The limiter brakes with 1 N·m·s/rad, so speeds and torques have the same numbers here.
    low = -stoppable(ANGLE + angle) - velocity
    high = stoppable(ANGLE - angle) - velocity
    if angle >= ANGLE:  # at the upper stop: no torque pushes further
        low = min(low, min(high, 0.0))
        high = min(high, 0.0)
    if angle <= -ANGLE:
        high = max(high, max(low, 0.0))
        low = max(low, 0.0)
    return within(low, -torque_limit, torque_limit), within(high, -torque_limit, torque_limit)


class Health:
    """What one module reported last, and what follows from it."""

    def __init__(self) -> None:
        self.received_ns: int | None = None
        self.celsius, self.volts, self.leak = 20.0, 24.0, False
        self.hot = False
        self.low_since_ns: int | None = None

    def known(self, now_ns: int) -> bool:
        return self.received_ns is not None and now_ns - self.received_ns <= KNOWN_FOR_NS

    def wrong(self, now_ns: int) -> set[str]:
        low = self.low_since_ns is not None and now_ns - self.low_since_ns >= LOW_FOR_NS
        reported = {"leak": self.leak, "undervoltage": low} if self.known(now_ns) else {}
        return {word for word, there in {"overheated": self.hot, **reported}.items() if there}

    def share(self, now_ns: int) -> float:
        over = (self.celsius - DERATE_FROM) / (STOP_AT - DERATE_FROM)
        return 1.0 - (1.0 - MIN_SHARE) * within(over, 0.0, 1.0) if self.known(now_ns) else 1.0


class Model(RuleBasedStateMachine):
    """What is known of an authority without looking at it."""

    authority: Authority
    action: str
    max_isolated: int

    def __init__(self) -> None:
        """Start the model of an authority that is disarmed, without a lease, a command or a joint state.

        The model predicts every decision of the safety core from the same events, in another way. Tests compare the
        two.
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
        self.newest_command: tuple[int, JointCommand] | None = None  # when it came; only of this holder
        self.since_arming: list[JointCommand] = []
        self.counting: JointCommand | None = None  # of those, what the last tick was decided by
        self.last_sequence = -1
        self.measured: tuple[list[float], list[float], list[float]] = ([0.0] * JOINTS, [0.0] * JOINTS, [0.0] * JOINTS)
        self.doubt: set[int] | None = set(ALL)  # joints whose newest state is not believed; None: whatever their number
        self.aside: set[int] = set()  # joints that have failed
        self.offered = 0
        self.rejected = 0
        self.faults = 0  # kept since the last reset
        self.hold_at = [0.0] * JOINTS
        self.halt: list[list[float]] | None = None  # wanted angle, its velocity, target: of every joint
        self.timestamp_ns = 0
        self.good: list[tuple[float, float] | None] = [None] * JOINTS  # angle and when it was taken
        self.strays: list[list[tuple[float, float]]] = [[] for _ in range(JOINTS)]
        self.same: list[list[tuple[Any, float, float]]] = [[] for _ in range(JOINTS)]  # state, time, target
        self.healths = [Health() for _ in range(JOINTS)]
        self.wrong: set[tuple[str, int]] = set()  # at the last tick
        self.silent: set[int] = set()
        self.shares = [1.0] * JOINTS
        self.reported = True  # the last stop was sent to the motors
        self.last: TickDecision | None = None

    @property
    def live(self) -> bool:
        return self.holder is not None and self.now_ns <= self.expires_ns

    def leave_for(self, following: LifecycleState) -> None:
        if following != self.state:
            self.hold_at = self.measured[0]
            self.halt = [self.beginning_of_halt(i) for i in range(JOINTS)] if self.state == "armed" else None
            self.reported = self.reported and following != "disarmed"
        if self.state == "armed":
            self.newest_command = None
        self.state = following

    def mode_before(self, i: int) -> Mode:
        return Mode.PASSIVE if self.last is None else self.last.setpoints.mode[i]

    def target_before(self, i: int) -> float:
        return 0.0 if self.last is None else self.last.setpoints.target[i]

    def beginning_of_halt(self, i: int) -> list[float]:
        angle, velocity, torque = (column[i] for column in self.measured)
        target = angle + (torque + DAMPING * velocity) / STIFFNESS
        if self.mode_before(i) is Mode.POSITION:
            target = self.target_before(i)
        target = within(within(target, angle - FAR, angle + FAR), -ANGLE, ANGLE)
        return [within(angle, -ANGLE, ANGLE), within(velocity, -SPEED, SPEED), target]

    def halt_for_a_period(self, i: int) -> float:
        assert self.halt is not None
        wanted, velocity, target = self.halt[i]
        slower = math.copysign(max(abs(velocity) - ACCELERATION * PERIOD_S, 0.0), velocity)
        wanted = within(wanted + (velocity + slower) / 2 * PERIOD_S, -ANGLE, ANGLE)
        target = within(wanted, target - SPEED * PERIOD_S, target + SPEED * PERIOD_S)
        self.halt[i] = [wanted, slower, target]
        return target

    def believe(self, i: int, angle: float, taken_s: float) -> bool:
        """Whether an angle that is otherwise sound is believed; keeps those that are not."""

        def reachable(before: tuple[float, float]) -> bool:
            return abs(angle - before[0]) <= SLACK + REACH * max(taken_s - before[1], 0.0)

        good, strays = self.good[i], self.strays[i]
        if good is None or reachable(good):
            return True
        if strays and not reachable(strays[-1]):
            strays.clear()
        repeated = bool(strays) and taken_s <= strays[-1][1]
        strays.append((angle, taken_s))
        if repeated:
            strays.pop(0)
        return len(strays) >= 5 and self.state != "armed"

    def is_frozen(self, i: int, state_: Any, taken_s: float) -> bool:
        if self.state != "armed" or self.mode_before(i) is not Mode.POSITION:
            self.same[i] = []
            return False
        if self.same[i] and self.same[i][-1][0] != state_:
            self.same[i] = []
        self.same[i].append((state_, taken_s, self.target_before(i)))
        limit = self.last.setpoints.torque_limit_nm[i] if self.last else TORQUE
        targets = [target for _, _, target in self.same[i]]
        ways = [max(targets[: k + 1]) - min(targets[: k + 1]) for k in range(len(targets))]
        far = [taken for (_, taken, _), way in zip(self.same[i], ways, strict=True) if way > FAR / 4]
        return bool(far) and taken_s - min(far) > LEASE_NS * 1e-9 and abs(state_[2]) < 0.95 * limit

    def drop_lease(self) -> None:
        self.holder = self.newest_command = None
        self.last_sequence = -1

    def note_fault(self) -> None:
        """One fault more is kept, up to the limit."""
        self.faults = min(self.faults + 1, MAX_FAULTS)

    def fail(self) -> None:
        if self.state != "estop":
            self.leave_for("fault")
        self.drop_lease()
        self.note_fault()

    def lose(self, joints: set[int]) -> bool:
        """Whether the robot goes on without these joints, too."""
        if joints <= self.aside:
            return True
        if self.state != "armed" or len(self.aside | joints) > self.max_isolated:
            return False
        self.aside |= joints
        self.note_fault()
        return True

    def lose_or_fail(self, joints: set[int] | None) -> None:
        if joints is None or not self.lose(joints):
            self.fail()

    @property
    def known(self) -> bool:
        """The joint state is fresh and valid."""
        return self.doubt == set()

    def check(self, answer: Answer, ok: bool) -> None:
        assert answer.ok == ok and (answer.refusal is None) == ok, answer
        assert answer.reason
        assert answer.epoch == self.epoch
        assert answer.lifecycle == self.state

    def check_aside(self, decision: TickDecision) -> None:
        points = decision.setpoints
        assert points.isolated == self.aside
        assert len(self.aside) <= self.max_isolated
        assert self.authority.isolated_joints == [f"joint_{i + 1}" for i in sorted(self.aside)]
        for i in self.aside:
            assert points.mode[i] == Mode.PASSIVE
            assert points.target[i] == 0.0
            assert points.torque_limit_nm[i] == 0.0

    def of_the_rest(self, values: list[Any]) -> list[Any]:
        """What concerns the joints that are not set aside."""
        return [value for i, value in enumerate(values) if i not in self.aside]

    def torques(self) -> Any:
        return pytest.approx(self.of_the_rest([TORQUE * share for share in self.shares]))

    def check_safe(self, decision: TickDecision) -> None:
        assert decision.sequence is None
        assert not decision.limited
        action = self.action if self.state == "fault" and self.halt is not None else "passive"
        assert self.of_the_rest(decision.setpoints.torque_limit_nm) == self.torques()
        if action == "hold":
            assert set(self.of_the_rest(decision.setpoints.mode)) <= {Mode.POSITION}
            held = [self.halt_for_a_period(i) for i in range(JOINTS)]
            assert self.of_the_rest(decision.setpoints.target) == pytest.approx(self.of_the_rest(held))
            assert all(abs(target) <= ANGLE for target in decision.setpoints.target)
            return
        mode = Mode.VELOCITY if action == "damp" else Mode.PASSIVE
        assert set(self.of_the_rest(decision.setpoints.mode)) <= {mode}
        assert decision.setpoints.target == [0.0] * JOINTS

    def check_held(self, decision: TickDecision, angle_rad: list[float]) -> None:
        assert set(self.of_the_rest(decision.setpoints.mode)) <= {Mode.POSITION}
        assert not decision.limited
        held = [within(angle, -ANGLE, ANGLE) for angle in angle_rad]
        assert self.of_the_rest(decision.setpoints.target) == self.of_the_rest(held)
        assert self.of_the_rest(decision.setpoints.torque_limit_nm) == self.torques()

    def check_commanded(self, decision: TickDecision, sent: JointCommand) -> None:
        for i in self.aside:
            assert decision.limited.get(i) == (None if sent.mode[i] is Mode.PASSIVE else "isolated")
        assert self.of_the_rest(decision.setpoints.mode) == self.of_the_rest(sent.mode)
        for i in self.of_the_rest(ALL):
            applied = decision.setpoints.torque_limit_nm[i]
            before = TORQUE if self.last is None else self.last.setpoints.torque_limit_nm[i]
            allowed = TORQUE if sent.torque_limit_nm is None else sent.torque_limit_nm[i]
            cool = TORQUE * self.shares[i] + TINY
            assert 0.0 <= applied <= min(cool, allowed)
            assert applied <= before + TORQUE_RATE * PERIOD_S + TINY
            if sent.mode[i] is not Mode.PASSIVE:
                self.check_target(i, decision, sent.mode[i], sent.target[i], bound_by_heat=min(TORQUE, allowed) > cool)
            else:
                assert decision.setpoints.target[i] == 0.0
                assert i not in decision.limited

    def check_target(self, i: int, decision: TickDecision, mode: Mode, wanted: float, *, bound_by_heat: bool) -> None:
        """Check the target that the authority applied to one joint.

        It must be inside the limits, change no faster than allowed, and be as near to the command as both permit. A
        target that differs from the command must be reported as limited.

        Args:
            i: Index of the joint.
            decision: What the authority applied.
            mode: Mode of the command.
            wanted: Target of the command, in rad, rad/s or N·m, by its mode.
            bound_by_heat: Whether derating lowers the torque limit of the command.
        """
        angle, velocity, torque = (column[i] for column in self.measured)
        target = decision.setpoints.target[i]
        match mode:
            case Mode.POSITION:
                low = within(angle - FAR, -ANGLE, ANGLE)
                high = within(angle + FAR, -ANGLE, ANGLE)
                max_change = SPEED * PERIOD_S
                start = angle + (torque + DAMPING * velocity) / STIFFNESS
            case Mode.VELOCITY:
                low = max(-SPEED, -stoppable(ANGLE + angle))
                high = min(SPEED, stoppable(ANGLE - angle))
                max_change = ACCELERATION * PERIOD_S
                start = velocity + torque / VELOCITY_GAIN
            case _:
                low, high = torque_bounds(angle, velocity, decision.setpoints.torque_limit_nm[i])
                max_change = TORQUE_RATE * PERIOD_S
                start = torque
        if self.last is not None and self.last.setpoints.mode[i] is mode:
            start = self.last.setpoints.target[i]
        assert math.isfinite(target)
        assert low <= target <= high
        # The limits have priority over the rate of change.
        assert abs(target - start) <= max_change + TINY or target in (low, high)
        nearest_reachable = within(wanted, start - max_change, start + max_change)
        assert abs(target - within(nearest_reachable, low, high)) <= TINY
        assert (i in decision.limited) == (target != wanted or bound_by_heat)
