"""The authority under everything that can happen to it, in any order, against a plain model of what may be.

20 sequences with each change and 200 in the campaign; as many as one likes with
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
KEPT = 4  # commands: fewer than in earnest, so that a few are a flood

HOLDERS = st.sampled_from(["control", "teleop", "mission"])
NUMBERS = st.floats(-2, 2) | st.floats(-6, 6) | st.sampled_from([0.0, 1e5, -1e5, 5e-324, 1.5, -1.5])
# In the order of the limiter's checks.
DEFECTS = "epoch", "replayed", "future", "stale", "layout", "length", "finite"
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


def per_joint(values: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(values, min_size=JOINT_COUNT, max_size=JOINT_COUNT)


def often(usual: Any, *others: Any) -> st.SearchStrategy[Any]:
    return st.sampled_from([usual] * (3 * len(others)) + list(others))


def spoil(values: list[float], joint: int, failure: str | None) -> None:
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


class Everything(AuthorityModel):
    """Every input of the authority as a rule. What the rules know of it by themselves is the model."""

    @initialize(
        action=st.sampled_from(["passive", "damp", "hold"]),
        first_epoch=st.sampled_from([0, 1_800_000_000_000]),
        lag=st.sampled_from([None, None, 0, 1, 2]),
        max_isolated=st.sampled_from([0, 0, 1, 2]),
        at_once=often(True, False),
    )
    def begin(
        self, action: str, first_epoch: int, lag: int | None, max_isolated: int, at_once: bool
    ) -> None:
        self.robot = make_description(
            safety__action=action, safety__max_isolated_joints=max_isolated
        )
        self.max_isolated = max_isolated
        self.action = action
        self.lag = lag  # in lockstep; None: the newest command counts
        kept, under_test.RECENT_COMMAND_COUNT = under_test.RECENT_COMMAND_COUNT, KEPT
        self.authority = CommandAuthority(self.robot, first_epoch=first_epoch)
        under_test.RECENT_COMMAND_COUNT = kept
        self.epoch = first_epoch
        if at_once:
            self.set_up_and_arm(0.1)

    # --- what comes in -----------------------------------------------------------------------------------------

    @rule(
        angle=per_joint(st.floats(-1.7, 1.7)),
        velocity=per_joint(st.floats(-6, 6)),
        torque=per_joint(st.floats(-5, 5)),
        failure=often(None, "valid", "age", "nan", "inf", "short", "long", "no_valid", "no_age"),
        joint=st.integers(0, JOINT_COUNT - 1),
        column=st.sampled_from([0, 0, 1, 2]),
        later_ns=often(ANY_MOTION_TIME_NS, PERIOD_NS, 0),
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
        """A joint state, perhaps with a failure. `column`: of the angles, velocities or torques."""
        valid, age_ns = [True] * JOINT_COUNT, [FRESH_NS] * JOINT_COUNT
        columns = [list(angle), list(velocity), list(torque)]
        self.timestamp_ns += later_ns
        match failure:
            case "valid":
                valid[joint] = False
            case "age":
                age_ns[joint] += 1
            case "no_valid":
                valid = []
            case "no_age":
                age_ns = []
            case _:
                spoil(columns[column], joint, failure)
        when = {"tick": self.tick, "timestamp_ns": self.timestamp_ns}
        seen = make_joint_state(self.robot, *columns, valid=valid, age_ns=age_ns, **when)
        self.authority.observe_joints(seen)
        self.seen_tick = self.tick
        if failure in ("short", "long", "no_valid", "no_age"):
            self.doubtful_joints = None
            return
        measured = (list(self.measured[0]), list(self.measured[1]), list(self.measured[2]))
        unknown, strayed, stuck = set[int](), set[int](), set[int]()
        for i in range(JOINT_COUNT):
            taken_s = (self.timestamp_ns - age_ns[i]) * 1e-9
            frozen = self.is_frozen(i, (columns[0][i], columns[1][i], columns[2][i]), taken_s)
            sound = failure is None or i != joint
            believed = sound and self.check_angle_plausible(i, angle[i], taken_s)
            if believed or not sound:
                self.implausible_angles[i] = []
            if believed:
                self.last_plausible_angles[i] = angle[i], taken_s
                measured[0][i], measured[1][i], measured[2][i] = angle[i], velocity[i], torque[i]
            if i in self.isolated:
                continue
            unknown |= {i} if not sound else set()
            strayed |= {i} if sound and not believed else set()
            stuck |= {i} if frozen else set()
        self.measured = measured
        self.doubtful_joints = unknown or strayed or stuck

    @rule(
        celsius=per_joint(often(20.0, 80.0, 81.0, 104.9, 105.0, 300.0)),
        volts=per_joint(often(24.0, 18.0, 17.9)),
        leak=st.none() | st.integers(0, 3 * JOINT_COUNT),
        silent=st.none() | st.integers(0, JOINT_COUNT - 1),
        failure=often(None, "nan", "short"),
    )
    def hear_of_power(
        self,
        celsius: list[float],
        volts: list[float],
        leak: int | None,
        silent: int | None,
        failure: str | None,
    ) -> None:
        leaks, valid = (
            [i == leak for i in range(JOINT_COUNT)],
            [i != silent for i in range(JOINT_COUNT)],
        )
        reported = (
            [NAN, *celsius[1:]]
            if failure == "nan"
            else celsius[1:]
            if failure == "short"
            else celsius
        )
        self.authority.observe_power(make_power(reported, volts, leaks, valid), self.now_ns)
        for i, health in enumerate(self.healths if failure != "short" else ()):
            if i == silent or not math.isfinite(reported[i]):
                continue
            health.received_ns, health.winding_c, health.voltage_v, health.leak = (
                self.now_ns,
                celsius[i],
                volts[i],
                leaks[i],
            )
            health.is_overheated = celsius[i] >= (
                DERATE_FROM_C if health.is_overheated else STOP_AT_C
            )
            if volts[i] >= MIN_VOLTAGE_V:
                health.low_since_ns = None
            elif health.low_since_ns is None:
                health.low_since_ns = self.now_ns

    def draw_conclusions(self) -> None:
        """At the end of a tick: what the modules said, and what they have not said for long."""
        before, self.health_faults = self.health_faults, set()
        for i, health in enumerate(self.healths):
            self.health_faults |= {(word, i) for word in health.find_faults(self.now_ns)}
        for word, i in sorted(
            self.health_faults - before, key=lambda found: (found[1], HEALTH_FAULTS.index(found[0]))
        ):
            self.isolate_or_fail({i} if word == "overheated" else None)
        quiet_before, self.silent = self.silent, set()
        for i, health in enumerate(self.healths):
            if health.received_ns is not None and not health.is_known(self.now_ns):
                self.silent.add(i)
        fresh = self.silent - quiet_before
        if fresh and not (len(fresh) == 1 and fresh <= self.isolated):
            self.count_fault()
        self.torque_fractions = [
            health.compute_torque_fraction(self.now_ns) for health in self.healths
        ]

    @rule(
        who=HOLDERS,
        action=st.sampled_from(["acquire", "acquire", "renew", "release"]),
        priority=st.sampled_from([0, 100, 101, 255]),
        epoch=often(0, -1, 1),
    )
    def ask_for_the_lease(self, who: str, action: Any, priority: int, epoch: int) -> None:
        epoch = max(self.epoch + epoch, 0)
        mine = self.is_lease_held and who == self.holder and epoch == self.epoch
        ok = mine if action != "acquire" else not self.is_lease_held or priority > self.priority
        request = LeaseRequest(action=action, holder=who, priority=priority, epoch=epoch)
        answer = self.authority.handle_lease_request(request, self.now_ns)
        if ok and action == "renew" and self.state != "armed":
            self.expires_ns = self.now_ns + LEASE_NS
        elif ok and action != "renew":
            self.release_lease()
            if self.state == "armed":
                self.change_state("disarmed")
            if action == "acquire":
                self.holder, self.priority, self.expires_ns = who, priority, self.now_ns + LEASE_NS
                self.epoch += 1
        self.check_answer(answer, ok)
        if not ok:
            assert answer.refusal == ("lease_held" if action == "acquire" else "not_holder")

    @rule(
        wanted=per_joint(NUMBERS),
        mode=per_joint(st.sampled_from(list(JointMode))),
        torque_limit=st.none() | per_joint(st.sampled_from([0.0, 1.0, 3.9, 4.0, 1e5])),
        near=st.booleans(),
        defects=st.sets(st.sampled_from(DEFECTS), max_size=2),
        broken=st.booleans(),
        arm_session=often(0, None, -1, 1),  # None: the command names none
        back=often(0, 1, 2),
        times=often(1, 6),
    )
    def send_commands(
        self,
        wanted: list[float],
        mode: list[JointMode],
        torque_limit: list[float] | None,
        near: bool,
        defects: set[str],
        broken: bool,
        arm_session: int | None,
        back: int,
        times: int,
    ) -> None:
        """One command, or a flood of them; `back`: ticks between the state that it answers and now."""
        defects = defects if broken else set()
        if near:
            wanted, mode = list(self.measured[0]), [JointMode.POSITION] * JOINT_COUNT
        if "length" in defects:
            wanted = wanted[1:]
        if "finite" in defects:
            wanted = [[NAN, INF, -INF][self.sequence % 3], *wanted[1:]]
        meant = 0 if arm_session is None else max(self.arm_session + arm_session, 0)
        for _ in range(times):
            self.sequence += 1
            asked = make_joint_command(
                self.robot,
                wanted,
                mode,
                tick=self.tick + 1 if "future" in defects else max(self.tick - back, 0),
                sequence=max(self.last_sequence, 0) if "replayed" in defects else self.sequence,
                lease_epoch=self.epoch + 1 if "epoch" in defects else self.epoch,
                layout="of another robot" if "layout" in defects else self.robot.layout,
                torque_limit_nm=torque_limit,
                arm_session=meant,
            )
            self.offer(asked, LEASE_NS + 1 if "stale" in defects else LEASE_NS, defects)

    def offer(self, asked: JointCommand, age_ns: int, defects: set[str]) -> None:
        if "replayed" in defects and self.last_sequence < 0:  # nothing yet that could be replayed
            defects = defects - {"replayed"}
        expected = next((REASONS[defect] for defect in DEFECTS if defect in defects), None)
        if not self.is_lease_held:
            expected = "no_lease"
        counted = self.authority.rejected_counts[expected] if expected else 0
        refusal = self.authority.process_command(
            asked, now_ns=self.now_ns, tick=self.tick, age_ns=age_ns
        )
        self.offered += 1
        if expected is not None:
            assert refusal == expected
            assert self.authority.rejected_counts[expected] == counted + 1
            self.rejected += 1
            return
        if self.state == "armed" and asked.arm_session != self.arm_session:
            assert refusal == "before_arming"
            self.rejected += asked.tick > self.armed_tick
            return
        self.last_sequence = asked.sequence
        assert refusal is None
        self.expires_ns = self.now_ns + LEASE_NS
        self.newest_command = self.now_ns, asked
        if self.state == "armed":
            self.commands_since_arming.append(asked)

    @rule(reason=st.sampled_from(["malformed", "unknown_version"]))
    def send_what_is_no_command(self, reason: str) -> None:
        counted = self.authority.rejected_counts[reason]
        self.authority.count_rejection(reason)
        assert self.authority.rejected_counts[reason] == counted + 1
        self.offered += 1
        self.rejected += 1

    @rule(
        robot=often("worm", "other", None),
        backend=often("lag", "can", None),
        config_hash=often("0" * 16, "1" * 16, None),
    )
    def arm(self, robot: str | None, backend: str | None, config_hash: str | None) -> None:
        ready = (
            self.state == "disarmed"
            and self.has_valid_joint_state
            and self.is_lease_held
            and self.newest_command is not None
        )
        wrong = {
            (word, i)
            for word, i in self.health_faults
            if word == "leak" or (word == "overheated" and i not in self.isolated)
        }
        weak = any(
            health.low_since_ns is not None and health.is_known(self.now_ns)
            for health in self.healths
        )
        ready = ready and not wrong and not weak and (self.is_stop_sent or self.arm_session == 0)
        if ready and self.newest_command is not None:
            received_ns, asked = self.newest_command
            ready = self.now_ns - received_ns <= LEASE_NS and all(
                i in self.isolated
                or mode == JointMode.PASSIVE
                or (mode == JointMode.POSITION and abs(target - angle) <= MAX_STEP_RAD)
                for i, mode, target, angle in zip(
                    ALL_JOINTS, asked.mode, asked.target, self.measured[0], strict=True
                )
            )
        assert (not self.authority.list_unmet_conditions(self.now_ns)) == ready
        reported = {
            "wrong_robot": robot == "worm",
            "wrong_backend": backend == "lag",
            "wrong_config": config_hash == "0" * 16,
        }
        reported |= {"wrong_state": self.state == "disarmed", "not_ready": ready}
        ready = all(reported.values())
        request = LifecycleRequest(
            action="arm", robot=robot, backend=backend, config_hash=config_hash
        )
        answer = self.authority.handle_lifecycle_request(request, self.now_ns)
        if ready:
            self.change_state("armed")
            self.arm_session += 1
            self.armed_tick = self.seen_tick
            self.newest_command = None
            self.commands_since_arming, self.active_command = [], None
            self.expires_ns = self.now_ns + LEASE_NS
        self.check_answer(answer, ready)
        assert answer.refusal == next((word for word, right in reported.items() if not right), None)

    @rule(action=st.sampled_from(["disarm", "finish", "reset"]))
    def ask_for_less(self, action: Any) -> None:
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
                self.isolated, self.doubtful_joints = set(), None
        self.check_answer(answer, ok)
        if not ok:
            assert answer.refusal == "wrong_state"

    @rule(who=st.text(min_size=1, max_size=64))
    def estop(self, who: str) -> None:
        answer = self.authority.handle_estop_request(EstopRequest(requester=who), self.tick)
        self.change_state("estop")
        self.count_fault()
        self.check_answer(answer, True)
        assert self.authority.faults[-1] == Fault(
            tick=self.tick, what="estop", cause=f"emergency stop by {who}"
        )

    @rule(
        cause=st.sampled_from(["joint_2 is hot", "", "x" * 10_000]),
        scope=often("robot", "joint", "none"),
        joint=st.none() | st.integers(0, JOINT_COUNT),
    )
    def backend_fault(self, cause: str, scope: Any, joint: int | None) -> None:
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
        """A fault that is only recorded, so that it is not taken for the reason of a stop."""
        fault = Fault(tick=self.tick, what="service_lost", cause="guidance is gone", scope="robot")
        if precedes_stop:
            self.authority.log_fault(fault, precedes_stop=True)
        else:
            self.authority.log_fault(fault)
        self.count_fault()
        assert self.authority.faults[-1].scope == ("robot" if precedes_stop else "none")

    @rule()
    def holder_gone(self) -> None:
        self.authority.handle_lease_holder_exit("the holder is gone")
        if self.state != "armed":
            self.release_lease()

    # --- what a run does when all is well: chance alone would hardly ever arm -----------------------------------

    def stay(self) -> None:
        """A good command to stay where the joints are."""
        near = [clamp(angle, -ANGLE_LIMIT_RAD, ANGLE_LIMIT_RAD) for angle in self.measured[0]]
        still = [JointMode.POSITION] * JOINT_COUNT
        self.send_commands(near, still, None, False, set(), False, 0, 0, 1)

    @precondition(lambda self: self.state != "armed")
    @rule(angle=st.floats(-1.6, 1.6))
    def set_up_and_arm(self, angle: float) -> None:
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
            self.ask_for_less("reset")
        if not self.is_lease_held:
            self.ask_for_the_lease("control", "acquire", 100, 0)
        self.end_a_tick(0)
        self.stay()
        self.now_ns += 1
        self.arm("worm", "lag", "0" * 16)

    @precondition(lambda self: self.state == "armed")
    @rule(
        wanted=per_joint(NUMBERS),
        mode=per_joint(st.sampled_from(list(JointMode))),
        torque_limit=st.none() | per_joint(st.sampled_from([0.0, 1.0, 3.9, 4.0, 1e5])),
        moves=per_joint(st.floats(-0.1, 0.1) | st.floats(-1, 1)),
        torque=per_joint(st.floats(-5, 5)),
        ticks=st.integers(1, 8),
        later_ns=often(PERIOD_NS, ANY_MOTION_TIME_NS),
    )
    def go_on_for_some_ticks(
        self,
        wanted: list[float],
        mode: list[JointMode],
        torque_limit: list[float] | None,
        moves: list[float],
        torque: list[float],
        ticks: int,
        later_ns: int,
    ) -> None:
        for _ in range(ticks):
            angle = [before + moved for before, moved in zip(self.measured[0], moves, strict=True)]
            self.observe(angle, [moved / PERIOD_S for moved in moves], torque, None, 0, 0, later_ns)
            self.send_commands(wanted, mode, torque_limit, False, set(), False, 0, 0, 1)
            self.end_a_tick(PERIOD_NS)

    @precondition(lambda self: self.state == "armed")
    @rule(passes_ns=TIMES_NS)
    def renew_while_armed(self, passes_ns: int) -> None:
        """While armed only commands renew the lease."""
        self.now_ns += passes_ns
        self.ask_for_the_lease(str(self.holder), "renew", 100, 0)

    @precondition(lambda self: self.state == "armed")
    @rule()
    def finish_while_armed(self) -> None:
        self.ask_for_less("finish")

    @precondition(lambda self: self.state == "armed")
    @rule()
    def disarm_and_arm_without_a_command(self) -> None:
        self.ask_for_less("disarm")
        self.end_a_tick(0)
        self.arm("worm", "lag", "0" * 16)

    @precondition(lambda self: self.state == "armed" and self.is_lease_held)
    @rule(later=st.integers(0, 1))
    def send_for_the_arm_session_before(self, later: int) -> None:
        """Only a command that answers a state after the arming counts as rejected."""
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

    # --- time, and what goes out -------------------------------------------------------------------------------

    @rule(passes_ns=TIMES_NS)
    def time_passes(self, passes_ns: int) -> None:
        """Between two ticks: requests and commands meet a lease that may be over already."""
        self.now_ns += passes_ns

    @rule(late_ns=often(PERIOD_NS, LEASE_NS, 0, LEASE_NS + 1) | TIMES_NS)
    def end_a_tick(self, late_ns: int) -> None:
        """What a host does at the end of a tick."""
        self.now_ns += late_ns
        self.tick += 1
        if self.state == "armed" and not self.has_valid_joint_state:
            self.isolate_or_fail(self.doubtful_joints)
        self.draw_conclusions()
        if self.holder is not None and not self.is_lease_held:
            if self.state == "armed":
                self.fail()
            else:
                self.release_lease()
        self.authority.latch_faults_and_expire_lease(self.now_ns, self.tick)
        up_to = None if self.lag is None else self.tick - self.lag
        limited = self.authority.limited_counts.total()
        decision = self.authority.compute_setpoints(up_to)
        self.check_isolated(decision)
        assert self.authority.limited_counts.total() == limited + len(decision.limit_by_joint)
        if self.state != "armed":
            self.is_stop_sent = True
            self.check_safe(decision)
        else:
            assert self.is_lease_held
            assert self.doubtful_joints is not None
            assert self.doubtful_joints <= self.isolated
            for sent in self.commands_since_arming[-KEPT:]:
                self.active_command = (
                    sent if up_to is None or sent.tick <= up_to else self.active_command
                )
            assert decision.command_sequence == (
                None if self.active_command is None else self.active_command.sequence
            )
            if self.active_command is None:  # nothing was commanded since the robot was armed
                self.check_held(decision, self.hold_angles_rad)
            else:
                self.check_commanded(decision, self.active_command)
        self.last_output = decision

    @invariant()
    def it_matches_the_model(self) -> None:
        if not hasattr(self, "authority"):
            return
        found = self.authority
        assert found.state == self.state, f"{found.state}, not {self.state}: {found.reason}"
        assert found.arm_session == self.arm_session
        expected = (
            CommandLease(self.holder, self.epoch, self.priority, self.expires_ns)
            if self.holder
            else CommandLease()
        )
        assert found.lease.epoch == self.epoch  # the model's only ever grows
        assert found.lease.holder == self.holder
        assert found.lease.is_held(self.now_ns) == self.is_lease_held
        assert not self.holder or found.lease == expected
        assert found.reason
        assert len(found.reason) <= 500
        assert len(found.faults) == self.faults
        assert all(len(fault.cause) <= 500 for fault in found.faults)
        assert found.rejected_counts.total() == self.rejected
        assert found.accepted_count == len(self.commands_since_arming) or found.arm_session > 1
        assert (
            found.accepted_count + found.standby_count + found.rejected_counts.total()
            == self.offered
        )


@pytest.mark.trials
@pytest.mark.timeout(600)  # a busy computer may take minutes, which is no failure
@pytest.mark.parametrize("batch", range(-(-SEQUENCES // PER_TEST)))
def test_whatever_happens_the_robot_does_only_what_it_may(batch: int) -> None:
    """In batches, because hypothesis keeps every sequence of a test in memory."""
    tried = settings(max_examples=min(SEQUENCES, PER_TEST), stateful_step_count=STEPS)
    run_state_machine_as_test(Everything, settings=tried)
