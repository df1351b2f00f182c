"""The command authority equals a simple model for all of its inputs, in any order.

Each change runs 20 sequences, and the campaign 200. Any number can be run with
`SNAKESIM_SEQUENCES=10000 python -m pytest -n 2 tests/unit/hal/safety/test_authority_machine.py`.
"""

import math
import os
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, precondition, rule, run_state_machine_as_test

from snakesim_hal.safety import authority as under_test
from snakesim_hal.safety.authority import CommandAuthority
from snakesim_hal.safety.lease import CommandLease
from snakesim_hal.wire.freshness import FRESH_NS
from snakesim_hal.wire.messages import (
    EstopRequest,
    Fault,
    JointCommand,
    JointMode,
    LeaseRequest,
    LifecycleRequest,
)
from snakesim_testing.hal.authority_model import (
    ALL_JOINTS,
    ANGLE_LIMIT_RAD,
    ANY_MOTION_TIME_NS,
    DERATE_FROM_C,
    HEALTH_FAULTS,
    INF,
    JOINT_COUNT,
    MAX_HEALTH_AGE_NS,
    MAX_STEP_RAD,
    MIN_VOLTAGE_V,
    NAN,
    PERIOD_S,
    STOP_AT_C,
    AuthorityModel,
    clamp,
)
from snakesim_testing.hal.small_robots import (
    LEASE_NS,
    PERIOD_NS,
    make_description,
    make_joint_command,
    make_joint_state,
    make_power,
)
from snakesim_testing.hypothesis_profiles import choose_trial_count

SEQUENCES = int(os.environ.get("SNAKESIM_SEQUENCES", choose_trial_count(200)))
PER_TEST = 200
STEPS = 50
RECENT_COMMANDS = 4  # fewer than in production, so that a few commands are a flood

HOLDERS = st.sampled_from(["control", "teleop", "mission"])
NUMBERS = st.floats(-2, 2) | st.floats(-6, 6) | st.sampled_from([0.0, 1e5, -1e5, 5e-324, 1.5, -1.5])
# In the order of the limiter's checks.
DEFECTS = ("epoch", "replayed", "future", "stale", "layout", "length", "finite")
REASONS = {
    "epoch": "wrong_epoch",
    "replayed": "replayed",
    "future": "from_the_future",
    "stale": "stale",
    "layout": "wrong_layout",
    "length": "wrong_length",
    "finite": "not_finite",
}
TIMES_NS = st.sampled_from(
    [0, 1, PERIOD_NS, LEASE_NS - 1, LEASE_NS, LEASE_NS + 1, MAX_HEALTH_AGE_NS + 1]
) | st.integers(0, 3 * LEASE_NS)


def draw_per_joint(values: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    """Return a strategy for lists with one value for each joint."""
    return st.lists(values, min_size=JOINT_COUNT, max_size=JOINT_COUNT)


def draw_mostly(usual: Any, *others: Any) -> st.SearchStrategy[Any]:
    """Return a strategy that draws the usual value in three of four cases."""
    return st.sampled_from([usual] * (3 * len(others)) + list(others))


def add_failure(values: list[float], joint: int, failure: str | None) -> None:
    """Put a failure into one column of a joint state."""
    match failure:
        case "nan" | "inf":
            values[joint] = float(failure)
        case "short":
            values.pop()
        case "long":
            values.append(0.0)
        case _:
            pass


def add_state_failure(
    columns: list[list[float]],
    valid: list[bool],
    age_ns: list[int],
    joint: int,
    column: int,
    failure: str | None,
) -> None:
    """Put a failure into a joint state."""
    match failure:
        case "valid":
            valid[joint] = False
        case "age":
            age_ns[joint] += 1
        case "no_valid":
            valid.clear()
        case "no_age":
            age_ns.clear()
        case _:
            add_failure(columns[column], joint, failure)


class AuthorityMachine(AuthorityModel):
    """A state machine with a rule for every input of the authority. Each rule also updates the model."""

    @initialize(
        action=st.sampled_from(["passive", "damp", "hold"]),
        first_epoch=st.sampled_from([0, 1_800_000_000_000]),
        lag=st.sampled_from([None, None, 0, 1, 2]),
        max_isolated=st.sampled_from([0, 0, 1, 2]),
        at_once=draw_mostly(True, False),
    )
    def begin(
        self, action: str, first_epoch: int, lag: int | None, max_isolated: int, at_once: bool
    ) -> None:
        """Start an authority with a drawn configuration."""
        self.robot = make_description(
            safety__action=action, safety__max_isolated_joints=max_isolated
        )
        self.max_isolated = max_isolated
        self.action = action
        self.lag = lag  # in lockstep; None: the newest command is applied
        production_count = under_test.RECENT_COMMAND_COUNT
        under_test.RECENT_COMMAND_COUNT = RECENT_COMMANDS
        self.authority = CommandAuthority(self.robot, first_epoch=first_epoch)
        under_test.RECENT_COMMAND_COUNT = production_count
        self.epoch = first_epoch
        if at_once:
            self.set_up_and_arm(0.1)

    # --- inputs ------------------------------------------------------------------------------------------------

    @rule(
        angle=draw_per_joint(st.floats(-1.7, 1.7)),
        velocity=draw_per_joint(st.floats(-6, 6)),
        torque=draw_per_joint(st.floats(-5, 5)),
        failure=draw_mostly(
            None, "valid", "age", "nan", "inf", "short", "long", "no_valid", "no_age"
        ),
        joint=st.integers(0, JOINT_COUNT - 1),
        column=st.sampled_from([0, 0, 1, 2]),
        later_ns=draw_mostly(ANY_MOTION_TIME_NS, PERIOD_NS, 0),
    )
    def observe(
        self,
        angle: list[float],
        velocity: list[float],
        torque: list[float],
        failure: str | None,
        joint: int,
        column: int,
        later_ns: int,
    ) -> None:
        """Observe a joint state, perhaps with a failure in the angles, velocities or torques."""
        valid = [True] * JOINT_COUNT
        age_ns = [FRESH_NS] * JOINT_COUNT
        columns = [list(angle), list(velocity), list(torque)]
        self.timestamp_ns += later_ns
        add_state_failure(columns, valid, age_ns, joint, column, failure)
        joint_state = make_joint_state(
            self.robot,
            *columns,
            valid=valid,
            age_ns=age_ns,
            tick=self.tick,
            timestamp_ns=self.timestamp_ns,
        )
        self.authority.observe_joints(joint_state, self.timestamp_ns)
        self.seen_tick = self.tick
        if failure in ("short", "long", "no_valid", "no_age"):
            self.doubtful_joints = None
            return
        measured = (list(self.measured[0]), list(self.measured[1]), list(self.measured[2]))
        unknown: set[int] = set()
        implausible: set[int] = set()
        frozen_joints: set[int] = set()
        for i in range(JOINT_COUNT):
            measured_s = (self.timestamp_ns - age_ns[i]) * 1e-9
            is_frozen = self.is_frozen(i, (columns[0][i], columns[1][i], columns[2][i]), measured_s)
            is_valid = failure is None or i != joint
            is_plausible = is_valid and self.check_angle_plausible(i, angle[i], measured_s)
            if is_plausible or not is_valid:
                self.implausible_angles[i] = []
            if is_plausible:
                self.last_plausible_angles[i] = angle[i], measured_s
                measured[0][i] = angle[i]
                measured[1][i] = velocity[i]
                measured[2][i] = torque[i]
            if i in self.isolated:
                continue
            if not is_valid:
                unknown.add(i)
            elif not is_plausible:
                implausible.add(i)
            if is_frozen:
                frozen_joints.add(i)
        self.measured = measured
        self.doubtful_joints = unknown or implausible or frozen_joints

    @rule(
        celsius=draw_per_joint(draw_mostly(20.0, 80.0, 81.0, 104.9, 105.0, 300.0)),
        volts=draw_per_joint(draw_mostly(24.0, 18.0, 17.9)),
        leak=st.none() | st.integers(0, 3 * JOINT_COUNT),
        silent=st.none() | st.integers(0, JOINT_COUNT - 1),
        failure=draw_mostly(None, "nan", "short"),
    )
    def observe_power(
        self,
        celsius: list[float],
        volts: list[float],
        leak: int | None,
        silent: int | None,
        failure: str | None,
    ) -> None:
        """Observe a power sample, perhaps with a failure or a silent module."""
        leaks = [i == leak for i in range(JOINT_COUNT)]
        valid = [i != silent for i in range(JOINT_COUNT)]
        if failure == "nan":
            reported = [NAN, *celsius[1:]]
        elif failure == "short":
            reported = celsius[1:]
        else:
            reported = celsius
        self.authority.observe_power(make_power(reported, volts, leaks, valid), self.now_ns)
        for i, health in enumerate(self.healths if failure != "short" else ()):
            if i == silent or not math.isfinite(reported[i]):
                continue
            health.received_ns = self.now_ns
            health.winding_c = celsius[i]
            health.voltage_v = volts[i]
            health.leak = leaks[i]
            health.is_overheated = celsius[i] >= (
                DERATE_FROM_C if health.is_overheated else STOP_AT_C
            )
            if volts[i] >= MIN_VOLTAGE_V:
                health.low_since_ns = None
            elif health.low_since_ns is None:
                health.low_since_ns = self.now_ns

    def update_health(self) -> None:
        """Update the health faults and the silent modules of the model at the end of a tick."""
        faults_before = self.health_faults
        self.health_faults = set()
        for i, health in enumerate(self.healths):
            self.health_faults |= {
                (fault_kind, i) for fault_kind in health.find_faults(self.now_ns)
            }
        for fault_kind, i in sorted(
            self.health_faults - faults_before,
            key=lambda fault: (fault[1], HEALTH_FAULTS.index(fault[0])),
        ):
            self.isolate_or_fail({i} if fault_kind == "overheated" else None)
        silent_before = self.silent
        self.silent = set()
        for i, health in enumerate(self.healths):
            if health.received_ns is not None and not health.is_known(self.now_ns):
                self.silent.add(i)
        newly_silent = self.silent - silent_before
        if newly_silent and not (len(newly_silent) == 1 and newly_silent <= self.isolated):
            self.count_fault()
        self.torque_fractions = [
            health.compute_torque_fraction(self.now_ns) for health in self.healths
        ]

    @rule(
        requester=HOLDERS,
        action=st.sampled_from(["acquire", "acquire", "renew", "release"]),
        priority=st.sampled_from([0, 100, 101, 255]),
        epoch=draw_mostly(0, -1, 1),
    )
    def request_lease(self, requester: str, action: Any, priority: int, epoch: int) -> None:
        """Request the lease. `epoch` is the difference to the epoch of the present lease."""
        epoch = max(self.epoch + epoch, 0)
        is_own_lease = self.is_lease_held and requester == self.holder and epoch == self.epoch
        ok = (
            is_own_lease
            if action != "acquire"
            else not self.is_lease_held or priority > self.priority
        )
        request = LeaseRequest(action=action, holder=requester, priority=priority, epoch=epoch)
        answer = self.authority.handle_lease_request(request, self.now_ns)
        if ok and action == "renew" and self.state != "armed":
            self.expires_ns = self.now_ns + LEASE_NS
        elif ok and action != "renew":
            self.release_lease()
            if self.state == "armed":
                self.change_state("disarmed")
            if action == "acquire":
                self.holder = requester
                self.priority = priority
                self.expires_ns = self.now_ns + LEASE_NS
                self.epoch += 1
        self.check_answer(answer, ok)
        if not ok:
            assert answer.refusal == ("lease_held" if action == "acquire" else "not_holder")

    @rule(
        joint_targets=draw_per_joint(NUMBERS),
        modes=draw_per_joint(st.sampled_from(list(JointMode))),
        torque_limit_nm=st.none() | draw_per_joint(st.sampled_from([0.0, 1.0, 3.9, 4.0, 1e5])),
        stays_near=st.booleans(),
        defects=st.sets(st.sampled_from(DEFECTS), max_size=2),
        is_broken=st.booleans(),
        arm_session=draw_mostly(0, None, -1, 1),  # None: the command names no arm session
        ticks_back=draw_mostly(0, 1, 2),
        repeat_count=draw_mostly(1, 6),
    )
    def send_commands(
        self,
        joint_targets: list[float],
        modes: list[JointMode],
        torque_limit_nm: list[float] | None,
        stays_near: bool,
        defects: set[str],
        is_broken: bool,
        arm_session: int | None,
        ticks_back: int,
        repeat_count: int,
    ) -> None:
        """Send a command several times. It answers the state of `ticks_back` ticks ago."""
        defects = defects if is_broken else set()
        if stays_near:
            joint_targets = list(self.measured[0])
            modes = [JointMode.POSITION] * JOINT_COUNT
        if "length" in defects:
            joint_targets = joint_targets[1:]
        if "finite" in defects:
            joint_targets = [[NAN, INF, -INF][self.sequence % 3], *joint_targets[1:]]
        session = 0 if arm_session is None else max(self.arm_session + arm_session, 0)
        for _ in range(repeat_count):
            self.sequence += 1
            command = make_joint_command(
                self.robot,
                joint_targets,
                modes,
                tick=self.tick + 1 if "future" in defects else max(self.tick - ticks_back, 0),
                sequence=max(self.last_sequence, 0) if "replayed" in defects else self.sequence,
                lease_epoch=self.epoch + 1 if "epoch" in defects else self.epoch,
                layout="of another robot" if "layout" in defects else self.robot.layout,
                torque_limit_nm=torque_limit_nm,
                arm_session=session,
            )
            self.check_command(command, LEASE_NS + 1 if "stale" in defects else LEASE_NS, defects)

    def check_command(self, command: JointCommand, age_ns: int, defects: set[str]) -> None:
        """Process a command, and compare the answer with the model."""
        is_replay_possible = self.last_sequence >= 0
        if "replayed" in defects and not is_replay_possible:
            defects = defects - {"replayed"}
        expected = next((REASONS[defect] for defect in DEFECTS if defect in defects), None)
        if not self.is_lease_held:
            expected = "no_lease"
        count_before = self.authority.rejected_counts[expected] if expected else 0
        refusal = self.authority.process_command(
            command, now_ns=self.now_ns, tick=self.tick, age_ns=age_ns
        )
        self.offered += 1
        if expected is not None:
            assert refusal == expected
            assert self.authority.rejected_counts[expected] == count_before + 1
            self.rejected += 1
            return
        if self.state == "armed" and command.arm_session != self.arm_session:
            assert refusal == "before_arming"
            self.rejected += command.tick > self.armed_tick
            return
        self.last_sequence = command.sequence
        assert refusal is None
        self.expires_ns = self.now_ns + LEASE_NS
        self.newest_command = self.now_ns, command
        if self.state == "armed":
            self.commands_since_arming.append(command)

    @rule(reason=st.sampled_from(["malformed", "unknown_version"]))
    def reject_message(self, reason: str) -> None:
        """Count a message that is no valid command."""
        count_before = self.authority.rejected_counts[reason]
        self.authority.count_rejection(reason)
        assert self.authority.rejected_counts[reason] == count_before + 1
        self.offered += 1
        self.rejected += 1

    @rule(
        robot=draw_mostly("worm", "other", None),
        backend=draw_mostly("lag", "can", None),
        config_hash=draw_mostly("0" * 16, "1" * 16, None),
    )
    def arm(self, robot: str | None, backend: str | None, config_hash: str | None) -> None:
        """Request arming, which succeeds only if the model fulfills all conditions."""
        ready = (
            self.state == "disarmed"
            and self.has_valid_joint_state
            and self.is_lease_held
            and self.newest_command is not None
        )
        blocking_faults = {
            (fault_kind, i)
            for fault_kind, i in self.health_faults
            if fault_kind == "leak" or (fault_kind == "overheated" and i not in self.isolated)
        }
        is_supply_weak = any(
            health.low_since_ns is not None and health.is_known(self.now_ns)
            for health in self.healths
        )
        ready = (
            ready
            and not blocking_faults
            and not is_supply_weak
            and (self.is_stop_sent or self.arm_session == 0)
        )
        if ready and self.newest_command is not None:
            received_ns, command = self.newest_command
            ready = self.now_ns - received_ns <= LEASE_NS and all(
                i in self.isolated
                or mode == JointMode.PASSIVE
                or (mode == JointMode.POSITION and abs(target - angle) <= MAX_STEP_RAD)
                for i, mode, target, angle in zip(
                    ALL_JOINTS, command.mode, command.target, self.measured[0], strict=True
                )
            )
        assert (not self.authority.list_unmet_conditions(self.now_ns)) == ready
        requirements = {
            "wrong_robot": robot == "worm",
            "wrong_backend": backend == "lag",
            "wrong_config": config_hash == "0" * 16,
        }
        requirements |= {"wrong_state": self.state == "disarmed", "not_ready": ready}
        ready = all(requirements.values())
        request = LifecycleRequest(
            action="arm", robot=robot, backend=backend, config_hash=config_hash
        )
        answer = self.authority.handle_lifecycle_request(request, self.now_ns)
        if ready:
            self.change_state("armed")
            self.arm_session += 1
            self.armed_tick = self.seen_tick
            self.newest_command = None
            self.commands_since_arming = []
            self.active_command = None
            self.expires_ns = self.now_ns + LEASE_NS
        self.check_answer(answer, ready)
        assert answer.refusal == next(
            (refusal for refusal, is_met in requirements.items() if not is_met), None
        )

    @rule(action=st.sampled_from(["disarm", "finish", "reset"]))
    def request_less(self, action: Any) -> None:
        """Request a disarm, an end of motion, or a reset."""
        ok = action == "finish" or self.state in (
            ("armed", "disarmed") if action == "disarm" else ("fault", "estop")
        )
        if action == "reset" and self.state == "disarmed":
            ok = True
        answer = self.authority.handle_lifecycle_request(
            LifecycleRequest(action=action), self.now_ns
        )
        if ok and (action != "finish" or self.state == "armed"):
            self.change_state("disarmed")
        if ok and action == "reset":
            self.faults = 0
            if self.isolated:
                self.isolated = set()
                self.doubtful_joints = None
        self.check_answer(answer, ok)
        if not ok:
            assert answer.refusal == "wrong_state"

    @rule(requester=st.text(min_size=1, max_size=64))
    def request_estop(self, requester: str) -> None:
        """Request an emergency stop."""
        answer = self.authority.handle_estop_request(EstopRequest(requester=requester), self.tick)
        self.change_state("estop")
        self.count_fault()
        self.check_answer(answer, True)
        assert self.authority.faults[-1] == Fault(
            tick=self.tick, what="estop", cause=f"emergency stop by {requester}"
        )

    @rule(
        cause=st.sampled_from(["joint_2 is hot", "", "x" * 10_000]),
        scope=draw_mostly("robot", "joint", "none"),
        joint=st.none() | st.integers(0, JOINT_COUNT),
    )
    def latch_backend_fault(self, cause: str, scope: Any, joint: int | None) -> None:
        """Latch a fault that the backend reports."""
        name = None if joint is None else f"joint_{joint + 1}"
        self.authority.latch_fault(
            Fault(tick=self.tick, what="hot", cause=cause, joint=name, scope=scope)
        )
        if scope == "none":
            self.count_fault()
            return
        self.isolate_or_fail({joint} if scope == "joint" and joint in ALL_JOINTS else None)

    @rule(precedes_stop=st.booleans())
    def record_fault(self, precedes_stop: bool) -> None:
        """Record a fault without a stop, so that it is not the reason of a stop."""
        fault = Fault(tick=self.tick, what="service_lost", cause="guidance is gone", scope="robot")
        if precedes_stop:
            self.authority.log_fault(fault, precedes_stop=True)
        else:
            self.authority.log_fault(fault)
        self.count_fault()
        assert self.authority.faults[-1].scope == ("robot" if precedes_stop else "none")

    @rule()
    def end_lease_holder(self) -> None:
        """Report that the process of the lease holder has ended."""
        self.authority.handle_lease_holder_exit("the holder is gone")
        if self.state != "armed":
            self.release_lease()

    # --- sequences of normal operation, because random inputs alone would hardly ever arm ------------------------

    def send_command_to_stay(self) -> None:
        """Send a valid command to stay at the measured angles."""
        near = [clamp(angle, -ANGLE_LIMIT_RAD, ANGLE_LIMIT_RAD) for angle in self.measured[0]]
        still = [JointMode.POSITION] * JOINT_COUNT
        self.send_commands(near, still, None, False, set(), False, 0, 0, 1)

    @precondition(lambda self: self.state != "armed")
    @rule(angle=st.floats(-1.6, 1.6))
    def set_up_and_arm(self, angle: float) -> None:
        """Arm the robot with valid inputs."""
        self.observe(
            [angle] * JOINT_COUNT,
            [0.0] * JOINT_COUNT,
            [0.0] * JOINT_COUNT,
            None,
            0,
            0,
            ANY_MOTION_TIME_NS,
        )
        if self.state in ("fault", "estop"):
            self.request_less("reset")
        if not self.is_lease_held:
            self.request_lease("control", "acquire", 100, 0)
        self.end_tick(0)
        self.send_command_to_stay()
        self.now_ns += 1
        self.arm("worm", "lag", "0" * 16)

    @precondition(lambda self: self.state == "armed")
    @rule(
        joint_targets=draw_per_joint(NUMBERS),
        modes=draw_per_joint(st.sampled_from(list(JointMode))),
        torque_limit=st.none() | draw_per_joint(st.sampled_from([0.0, 1.0, 3.9, 4.0, 1e5])),
        moves=draw_per_joint(st.floats(-0.1, 0.1) | st.floats(-1, 1)),
        torque=draw_per_joint(st.floats(-5, 5)),
        ticks=st.integers(1, 8),
        later_ns=draw_mostly(PERIOD_NS, ANY_MOTION_TIME_NS),
    )
    def run_some_ticks(
        self,
        joint_targets: list[float],
        modes: list[JointMode],
        torque_limit: list[float] | None,
        moves: list[float],
        torque: list[float],
        ticks: int,
        later_ns: int,
    ) -> None:
        """Run ticks with moving joints and one command each."""
        for _ in range(ticks):
            angle = [before + move for before, move in zip(self.measured[0], moves, strict=True)]
            self.observe(angle, [move / PERIOD_S for move in moves], torque, None, 0, 0, later_ns)
            self.send_commands(joint_targets, modes, torque_limit, False, set(), False, 0, 0, 1)
            self.end_tick(PERIOD_NS)

    @precondition(lambda self: self.state == "armed")
    @rule(passes_ns=TIMES_NS)
    def renew_while_armed(self, passes_ns: int) -> None:
        """Request a renewal, which has no effect while armed: only commands renew the lease."""
        self.now_ns += passes_ns
        self.request_lease(str(self.holder), "renew", 100, 0)

    @precondition(lambda self: self.state == "armed")
    @rule()
    def finish_while_armed(self) -> None:
        """Request the end of motion while armed."""
        self.request_less("finish")

    @precondition(lambda self: self.state == "armed")
    @rule()
    def disarm_and_arm_without_a_command(self) -> None:
        """Disarm, and request arming without a new command."""
        self.request_less("disarm")
        self.end_tick(0)
        self.arm("worm", "lag", "0" * 16)

    @precondition(lambda self: self.state == "armed" and self.is_lease_held)
    @rule(later=st.integers(0, 1))
    def send_for_previous_arm_session(self, later: int) -> None:
        """Send a command of the previous arm session, which counts as rejected only if it answers a later state."""
        back = self.tick - self.armed_tick - later
        self.send_commands(
            [0.0] * JOINT_COUNT,
            [JointMode.POSITION] * JOINT_COUNT,
            None,
            False,
            set(),
            False,
            -1,
            max(back, 0),
            1,
        )

    # --- time and setpoints ------------------------------------------------------------------------------------

    @rule(passes_ns=TIMES_NS)
    def pass_time(self, passes_ns: int) -> None:
        """Let time pass between two ticks, in which the lease may expire."""
        self.now_ns += passes_ns

    @rule(late_ns=draw_mostly(PERIOD_NS, LEASE_NS, 0, LEASE_NS + 1) | TIMES_NS)
    def end_tick(self, late_ns: int) -> None:
        """Do what a host does at the end of a tick, and check the setpoints."""
        self.now_ns += late_ns
        self.tick += 1
        if self.state == "armed" and not self.has_valid_joint_state:
            self.isolate_or_fail(self.doubtful_joints)
        self.update_health()
        if self.holder is not None and not self.is_lease_held:
            if self.state == "armed":
                self.fail()
            else:
                self.release_lease()
        self.authority.latch_faults_and_expire_lease(self.now_ns, self.tick)
        up_to = None if self.lag is None else self.tick - self.lag
        limited_before = self.authority.limited_counts.total()
        decision = self.authority.compute_setpoints(up_to)
        self.check_isolated(decision)
        assert self.authority.limited_counts.total() == limited_before + len(
            decision.limit_by_joint
        )
        if self.state != "armed":
            self.is_stop_sent = True
            self.check_safe(decision)
        else:
            assert self.is_lease_held
            assert self.doubtful_joints is not None
            assert self.doubtful_joints <= self.isolated
            for command in self.commands_since_arming[-RECENT_COMMANDS:]:
                if up_to is None or command.tick <= up_to:
                    self.active_command = command
            assert decision.command_sequence == (
                None if self.active_command is None else self.active_command.sequence
            )
            if self.active_command is None:  # no command has arrived since the arming
                self.check_held(decision, self.hold_angles_rad)
            else:
                self.check_commanded(decision, self.active_command)
        self.last_output = decision

    @invariant()
    def authority_equals_model(self) -> None:
        """Compare the state of the authority with the model."""
        if not hasattr(self, "authority"):
            return
        authority = self.authority
        assert authority.state == self.state, (
            f"{authority.state}, not {self.state}: {authority.reason}"
        )
        assert authority.arm_session == self.arm_session
        expected = (
            CommandLease(self.holder, self.epoch, self.priority, self.expires_ns)
            if self.holder
            else CommandLease()
        )
        assert authority.lease.epoch == self.epoch  # the epoch of the model only grows
        assert authority.lease.holder == self.holder
        assert authority.lease.is_held(self.now_ns) == self.is_lease_held
        assert not self.holder or authority.lease == expected
        assert authority.reason
        assert len(authority.reason) <= 500
        assert len(authority.faults) == self.faults
        assert all(len(fault.cause) <= 500 for fault in authority.faults)
        assert authority.rejected_counts.total() == self.rejected
        assert (
            authority.accepted_count == len(self.commands_since_arming) or authority.arm_session > 1
        )
        assert (
            authority.accepted_count + authority.standby_count + authority.rejected_counts.total()
            == self.offered
        )


@pytest.mark.trials
@pytest.mark.timeout(600)  # a busy computer may need minutes, which is no failure
@pytest.mark.parametrize("batch", range(-(-SEQUENCES // PER_TEST)))
def test_authority_for_any_inputs_equals_the_model(batch: int) -> None:
    """Run in batches, because Hypothesis keeps every sequence of a test in memory."""
    machine_settings = settings(max_examples=min(SEQUENCES, PER_TEST), stateful_step_count=STEPS)
    run_state_machine_as_test(AuthorityMachine, settings=machine_settings)
