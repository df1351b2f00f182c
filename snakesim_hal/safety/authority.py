"""Who may move the robot, and the setpoints of the motors: lifecycle, lease and limiter in one place, without any I/O.

The host passes in commands, requests, states and the time, and gets setpoints. `now_ns` is safety time: the
monotonic clock, or simulated time in lockstep.
"""

from collections import Counter, deque
from dataclasses import dataclass

import msgspec
import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety import lifecycle, limiter
from snakesim_hal.safety.cables import Cables
from snakesim_hal.safety.derating import Derating
from snakesim_hal.safety.fault_log import FaultLog
from snakesim_hal.safety.isolation import Isolation
from snakesim_hal.safety.joint_limits import Applied, JointLimits, Mask
from snakesim_hal.safety.lease import Lease, decide_lease_request, free_lease, renew_lease
from snakesim_hal.safety.lifecycle import UnmetCondition
from snakesim_hal.safety.limit_names import name_active_limits
from snakesim_hal.safety.plausibility import ImplausibleState, PlausibilityCheck, replace_unreadable
from snakesim_hal.safety.stop_ramp import StopReaction, uniform_setpoints
from snakesim_hal.wire.messages import (
    Answer,
    Description,
    EstopRequest,
    Fault,
    JointCommand,
    JointState,
    LeaseRequest,
    LifecycleRequest,
    LifecycleState,
    Mode,
    Power,
)

COMMANDS_KEPT = 1024  # in lockstep a tick may name an older command than the newest
MAX_REASON_LENGTH = 500  # characters, as `quantities.Reason` allows


@dataclass(frozen=True)
class TickDecision:
    """The setpoints of one tick."""

    setpoints: SafeSetpoints
    sequence: int | None  # of the command; None: the host's own stop mode
    limited: dict[int, str]  # joint index -> which limit changed its target


class Authority:
    """Lifecycle, lease and limiter of one robot."""

    def __init__(
        self,
        description: Description,
        *,
        first_epoch: int = 0,
        awaits_reports: bool = False,
        unchecked: str = "",
        cables: Cables | None = None,
    ) -> None:
        """Start disarmed, without a holder of the lease.

        Args:
            description: the robot as its backend describes it: joints, their limits, and the lease term.
            first_epoch: epoch of the lease before its first holder. It must differ from that of any earlier host, so
                that commands for another host are rejected.
            awaits_reports: whether arming waits until every joint module has reported its supply.
            unchecked: why the joints count as not checked, so that only a request with `unchecked` arms the
                robot; empty if they were checked.
            cables: cables of joints without end stops. The caller updates them.
        """
        self._cables = cables or Cables((), {}, {})
        self.description = description
        self.unchecked = unchecked
        self.limits = JointLimits.from_description(description)
        count = len(description.joints)

        # Lifecycle and lease.
        self.state: LifecycleState = "disarmed"
        self.reason = "not armed yet"
        self.arm_session = 0
        self.lease = Lease(epoch=first_epoch)
        self._state_tick = 0  # of the newest joint state
        self._armed_tick = -1  # of the state that was the newest at the last arming
        self._stop_sent = True  # whether the motors have received setpoints since the robot stopped being armed

        # Faults and counters.
        self.faults_since_reset = FaultLog()
        self.faults_since_start = FaultLog()
        self.accepted_count = 0
        self.standby_count = 0
        self.rejected_counts: Counter[str] = Counter()
        self.limited_counts: Counter[str] = Counter()

        # Checks of what is measured.
        self._plausibility = PlausibilityCheck(self.limits)
        self._measured = self._plausibility.measured
        self._implausible: ImplausibleState | None = self._unknown_state("no joint state yet")
        self._backend_obstacles: list[str] = []  # why the backend cannot be armed now
        self._isolation = Isolation(description)
        self._derating = Derating(description, awaits_reports=awaits_reports)

        # Commands.
        self._command: JointCommand | None = None
        self._command_ns = 0  # when it was received
        self._decided_command: JointCommand | None = None  # of the last decision since arming
        self._recent: deque[JointCommand] = deque(maxlen=COMMANDS_KEPT)  # accepted ones since arming, oldest first
        self._last_sequence = -1

        # Setpoints.
        self._applied = Applied(np.zeros(count, dtype=np.int64), np.zeros(count), self.limits.torque_nm)
        self._angle_at_arming_rad = np.zeros(count)
        self._stop_reaction = StopReaction(self.limits, description.stop_mode)

    # --- inputs: measured values -----------------------------------------------------------------------------

    def observe(self, joints: JointState, now_ns: int | None = None) -> None:
        """Process the newest joint state. Implausible values are rejected: the last good ones stay.

        Args:
            joints: the joint state.
            now_ns: safety time; None means the timestamp of the state.
        """
        if now_ns is None:
            now_ns = joints.timestamp_ns
        applied = None
        if self.state == "armed":
            applied = self._applied
        self._state_tick = joints.tick
        self._implausible = self._plausibility.check(
            joints, now_ns=now_ns, applied=applied, isolated=self._isolation.joints
        )
        self._measured = self._plausibility.measured

    def observe_power(self, power: Power, now_ns: int) -> None:
        """Process the newest power sample: supply, heat and leaks. `check_deadlines` acts on it."""
        self._derating.update(power, now_ns)

    def observe_obstacles(self, obstacles: list[str]) -> None:
        """Process why the backend cannot be armed now; empty if nothing is against it."""
        self._backend_obstacles = obstacles

    def replace_unreadable(self, joints: JointState) -> JointState:
        """Return a joint state for publishing: without NaN or infinity."""
        return replace_unreadable(joints, self._measured)

    @property
    def derated_joints(self) -> dict[str, float]:
        """The names of derated joints, with the fraction of their torque that is left."""
        return self._derating.derated_joints()

    @property
    def faults(self) -> list[Fault]:
        """Faults since the last reset, as far as they are stored."""
        return self.faults_since_reset.stored

    @property
    def isolated_joints(self) -> list[str]:
        """The names of joints that failed, and are passive until a reset."""
        return self._isolation.names

    # --- inputs: commands and requests -----------------------------------------------------------------------

    def offer_command(self, command: JointCommand, *, now_ns: int, tick: int, age_ns: int) -> str | None:
        """Accept a command, or return why it is rejected.

        Args:
            command: the command as it was received.
            now_ns: safety time.
            tick: the newest tick that the host has published.
            age_ns: age of the state that the command answers.
        """
        refusal = limiter.find_refusal(
            command,
            lease=self.lease,
            now_ns=now_ns,
            tick=tick,
            last_sequence=self._last_sequence,
            age_ns=age_ns,
            limits=self.limits,
        )
        if refusal is not None:
            self.rejected_counts[refusal] += 1
            return refusal
        if not self.answers_arm_session(command):
            # It does not renew the lease either: that takes commands of the present arm session.
            self._count_command_before_arming(command)
            return "before_arming"
        # Only now: a rejected command must not make the next good one a replay.
        self._last_sequence = command.sequence
        self.lease = renew_lease(self.lease, now_ns, self.description.lease_ns)
        self._command = command
        self._command_ns = now_ns
        if self.state == "armed":
            self.accepted_count += 1
            self._recent.append(command)
        else:
            self.standby_count += 1
        return None

    def answers_arm_session(self, command: JointCommand) -> bool:
        """Return whether a command names the present arm session, or the robot is not armed."""
        return self.state != "armed" or command.arm_session == self.arm_session

    def count_rejection(self, reason: str) -> None:
        """Count a sample that could not be decoded."""
        self.rejected_counts[reason] += 1

    def on_lease(self, request: LeaseRequest, now_ns: int) -> Answer:
        """Decide a lease request. If the lease changes hands, an armed robot is disarmed."""
        decision = decide_lease_request(self.lease, request, now_ns, self.description.lease_ns)
        if self.state == "armed" and request.action == "renew":
            # While armed only a command renews the lease.
            return self._answer(decision.refusal, decision.refusal_word)
        self.lease = decision.lease
        if decision.changed_hands:
            self._forget_commands()
            if self.state == "armed":
                self._transition("disarm", f"lease passed to {decision.lease.holder or 'no client'}")
        return self._answer(decision.refusal, decision.refusal_word)

    def on_lifecycle(self, request: LifecycleRequest, now_ns: int) -> Answer:
        """Arm, disarm, reset or finish. A refused arming lists every condition that is not met."""
        match request.action:
            case "arm":
                return self._arm(request, now_ns)
            case "disarm":
                return self._disarm(request)
            case "reset":
                return self._reset(request)
            case "finish":
                if self.state == "armed":
                    self._transition("disarm", f"finished by {request.requester}")
                return self._answer(None)

    def on_estop(self, request: EstopRequest, tick: int) -> Answer:
        """Stop now, for any requester."""
        latch_fault = Fault(tick=tick, what="estop", cause=f"emergency stop by {request.requester}")
        self._record(latch_fault, stops=self.state != "estop")
        self._transition("estop", f"emergency stop by {request.requester}; reset it to continue")
        return self._answer(None)

    # --- inputs: faults --------------------------------------------------------------------------------------

    def fault(self, fault: Fault, joints: Mask | None = None) -> None:
        """Latch a fault: the joints take the stop mode until a reset.

        A fault with the reach "none" is only recorded. A fault of only some joints isolates them instead of stopping
        the robot, if the robot file allows that.

        Args:
            fault: what happened.
            joints: (n_joints,), the joints concerned; None means the joint that the fault names.
        """
        if fault.reach == "none":
            self._record(fault, stops=False)
            return
        if joints is None:
            joints = self._isolation.find_joint(fault.joint)
        if fault.reach == "joint" and self._isolate(fault, joints):
            return
        fault = msgspec.structs.replace(fault, reach="robot")
        stops = self.state not in ("fault", "estop")  # later faults are usually consequences of the first
        self._record(fault, stops=stops)
        if stops:
            self._transition("fault", fault.cause[:MAX_REASON_LENGTH] or fault.what)
        self._drop_lease()

    def record_fault(self, fault: Fault, *, precedes_stop: bool = False) -> None:
        """Record a fault for people that stops nothing by itself.

        Args:
            fault: what happened.
            precedes_stop: whether its consequence stops the robot, as when the process that holds the lease ends.
        """
        reach = "robot" if precedes_stop else "none"
        self._record(msgspec.structs.replace(fault, reach=reach), stops=False)

    def on_holder_gone(self, cause: str) -> None:
        """React to the end of the lease holder's process: unless the robot is armed, free the lease at once."""
        if self.state != "armed":
            self._drop_lease()
        if self.state == "disarmed":
            self.reason = cause

    # --- outputs ---------------------------------------------------------------------------------------------

    def list_unmet_conditions(self, now_ns: int) -> list[str]:
        """Return every condition for arming that is not met; empty if the robot is ready."""
        return [condition.reason for condition in self._find_unmet_conditions(now_ns)]

    def check_deadlines(self, now_ns: int, tick: int) -> None:
        """Latch the faults that follow from the measured values and from the time.

        These are: an armed robot without plausible joint states; a robot, armed or not, whose modules are too hot,
        leak or lack voltage; and an expired lease of an armed robot. If the robot is not armed, an expired lease
        only becomes free.
        """
        if self.state == "armed" and self._implausible is not None:
            self.fault(msgspec.structs.replace(self._implausible.fault, tick=tick), self._implausible.joints)
        new_faults, silent = self._derating.evaluate(now_ns, tick)
        for fault in new_faults:
            self.fault(fault)
        if silent is not None and not self._isolation.is_isolated(silent.joint):
            self.record_fault(silent)
        if self.lease.is_live(now_ns):
            return
        if self.state == "armed":
            term_ms = self.description.lease_ns / 1e6
            cause = f"lease of {self.lease.holder} expired: no accepted command for {term_ms:.0f} ms"
            self.fault(Fault(tick=tick, what="lease_expired", cause=cause))
        else:
            self._drop_lease()

    def decide(self, up_to: int | None = None) -> TickDecision:
        """Return the setpoints for the next period. Call `check_deadlines` first.

        Args:
            up_to: in lockstep, the newest tick whose command is used; None means the newest command.
        """
        command = self._find_command(up_to)
        sequence: int | None = None
        limited: dict[int, str] = {}
        if self.state != "armed":
            applied = self._stop_reaction.make_setpoints(self.state, self._derated_torque_nm())
            self._stop_sent = True
        elif command is None:
            # Just armed: hold the pose until the first command.
            pose_rad = self.limits.clip_angles(self._angle_at_arming_rad)
            applied = uniform_setpoints(Mode.POSITION, pose_rad, self._derated_torque_nm())
        else:
            applied = limiter.limit_command(
                command,
                measured=self._measured,
                last=self._applied,
                limits=self.limits,
                torque_fraction=self._derating.torque_fraction,
            )
            sequence = command.sequence
            limited = self._name_limits(command, applied)
            self._decided_command = command
        applied = self._isolation.make_passive(applied)
        self._applied = applied
        return TickDecision(limiter.make_safe_setpoints(applied, self._isolation.indices), sequence, limited)

    # --- commands and setpoints ------------------------------------------------------------------------------

    def _count_command_before_arming(self, command: JointCommand) -> None:
        """Count a command of another arm session: it is an error only if it was sent after the last arming."""
        if command.tick <= self._armed_tick:
            self.standby_count += 1
        else:
            self.rejected_counts["before_arming"] += 1

    def _find_command(self, up_to: int | None) -> JointCommand | None:
        """Return the newest command, or in lockstep the newest one that does not answer a later tick than `up_to`."""
        if up_to is None:
            return self._command
        for command in reversed(self._recent):
            if command.tick <= up_to:
                return command
        return self._decided_command

    def _name_limits(self, command: JointCommand, applied: Applied) -> dict[int, str]:
        """Return the index of each joint whose command was changed, with the name of the limit, and count them."""
        limited: dict[int, str] = {}
        torque_fraction = self._derating.torque_fraction
        if applied.target.tolist() != command.target or min(torque_fraction.tolist()) < 1.0:
            limited = name_active_limits(
                command, applied, measured=self._measured, limits=self.limits, torque_fraction=torque_fraction
            )
        limited |= self._isolation.name_overruled(command)
        self.limited_counts.update(limited.values())
        return limited

    def _derated_torque_nm(self) -> Floats:
        """Return the torque limits that derating leaves, (n_joints,)."""
        return self.limits.torque_nm * self._derating.torque_fraction

    # --- lifecycle -------------------------------------------------------------------------------------------

    def _arm(self, request: LifecycleRequest, now_ns: int) -> Answer:
        """Arm the robot and begin an arm session; or refuse the request with all conditions that are not met."""
        unmet = self._find_unmet_conditions(now_ns)
        unmet += lifecycle.find_address_mismatches(request, self.description)
        if self.unchecked and not request.unchecked:
            reason = f"{self.unchecked}; to arm it as it is, add --unchecked"
            unmet.append(UnmetCondition("not_checked", reason))
        if unmet:
            reasons = "; ".join(condition.reason for condition in unmet)
            refusals = {condition.refusal for condition in unmet}
            return self._answer(reasons, min(refusals, key=lifecycle.REFUSAL_ORDER.index))
        as_it_is = ", unchecked" if self.unchecked else ""
        self._transition("arm", f"armed by {request.requester}{as_it_is}, commanded by {self.lease.holder}")
        self.arm_session += 1
        self._armed_tick = self._state_tick
        self._command = None
        self._decided_command = None
        self._recent.clear()
        self.lease = renew_lease(self.lease, now_ns, self.description.lease_ns)
        return self._answer(None)

    def _disarm(self, request: LifecycleRequest) -> Answer:
        if not self._transition("disarm", f"disarmed by {request.requester}"):
            return self._answer(f"cannot disarm in state {self.state}; reset it first", "wrong_state")
        return self._answer(None)

    def _reset(self, request: LifecycleRequest) -> Answer:
        if not self._transition("reset", f"reset by {request.requester}; arm to move again"):
            hint = ""
            if self.isolated_joints:
                hint = f"; disarm first, then a reset ends the isolation of {', '.join(self.isolated_joints)}"
            return self._answer(f"nothing to reset in state {self.state}{hint}", "wrong_state")
        self._end_isolation()
        self.faults_since_reset = FaultLog()
        return self._answer(None)

    def _transition(self, event: lifecycle.Event, why: str) -> bool:
        """Change the lifecycle state. Returns False if the event is not allowed in this state."""
        following = lifecycle.next_state(self.state, event)
        if following is None:
            return False
        was_armed = self.state == "armed"
        if following != self.state:
            self._angle_at_arming_rad = self._measured.angle_rad
            if was_armed:
                self._stop_reaction.begin(self._measured, self._applied)
            else:
                self._stop_reaction.end()
            if following == "disarmed":
                self._stop_sent = False
        if was_armed:
            self._command = None
        self.state = following
        self.reason = why
        return True

    def _find_unmet_conditions(self, now_ns: int) -> list[UnmetCondition]:
        """Return every condition for arming that is not met, apart from those of the request."""
        unmet: list[UnmetCondition] = []
        if self.state != "disarmed":
            reset_first = "; first `snakesim robot reset`" if self.state in ("fault", "estop") else ""
            unmet.append(UnmetCondition("wrong_state", f"state is {self.state}, must be disarmed{reset_first}"))
        unmet += [UnmetCondition("cable", reason) for reason in self._cables.list_arming_obstacles()]
        not_ready = self._find_unready_robot(now_ns) + self._find_unready_commands(now_ns)
        unmet += [UnmetCondition("not_ready", reason) for reason in not_ready]
        return unmet

    def _find_unready_robot(self, now_ns: int) -> list[str]:
        """Return what is wrong with the joint state, heat, supply, and the last stop."""
        reasons: list[str] = []
        if self._implausible is not None:
            reasons.append(self._implausible.fault.cause)
        for fault in self._derating.present_faults:
            # The supply has a separate reason, which explains what to do.
            if fault.what != "undervoltage" and not self._is_of_isolated_joint(fault):
                reasons.append(fault.cause)
        reasons += self._derating.find_supply_problems(now_ns)
        reasons += self._backend_obstacles
        if self.arm_session and not self._stop_sent:
            reasons.append("the motors have not received the stop yet; ask again in a period")
        return reasons

    def _find_unready_commands(self, now_ns: int) -> list[str]:
        """Return what is wrong with the lease and with the stream of commands."""
        if not self.lease.is_live(now_ns):
            return ["nothing commands the robot: the lease is free"]
        if self._command is None:
            return [f"no commands from {self.lease.holder} yet"]
        if now_ns - self._command_ns > self.description.lease_ns:  # the lease may also be renewed by requests
            return [f"no commands from {self.lease.holder} any more"]
        return lifecycle.find_far_targets(
            self._command, self._measured.angle_rad, self.description, self._isolation.joints
        )

    # --- faults and isolation --------------------------------------------------------------------------------

    def _record(self, fault: Fault, *, stops: bool) -> None:
        """Log a fault. `stops` means that the robot is in `fault` or `estop` now because of it."""
        fault = msgspec.structs.replace(fault, cause=fault.cause[:MAX_REASON_LENGTH])
        self.faults_since_reset.add(fault, stops=stops)
        self.faults_since_start.add(fault, stops=stops)

    def _isolate(self, fault: Fault, joints: Mask) -> bool:
        """Isolate failed joints, and return whether that is allowed. Later faults of isolated joints are ignored."""
        if self._isolation.covers(joints):
            return True
        if self.state != "armed" or not self._isolation.isolate(joints):
            return False
        self._record(fault, stops=False)
        self.reason = f"armed, without {', '.join(self.isolated_joints)}: {fault.cause}"[:MAX_REASON_LENGTH]
        return True

    def _end_isolation(self) -> None:
        """End the isolation of joints. Before the next arming, a new joint state must arrive."""
        if self.isolated_joints:
            self._isolation.reset()
            self._implausible = self._unknown_state("no joint state since the reset")

    def _is_of_isolated_joint(self, fault: Fault) -> bool:
        return fault.reach == "joint" and self._isolation.is_isolated(fault.joint)

    def _unknown_state(self, cause: str) -> ImplausibleState:
        fault = Fault(tick=0, what="state_invalid", cause=cause)
        return ImplausibleState(fault, np.ones(len(self.description.joints), dtype=np.bool_))

    # --- lease and answers -----------------------------------------------------------------------------------

    def _drop_lease(self) -> None:
        self.lease = free_lease(self.lease)
        self._forget_commands()

    def _forget_commands(self) -> None:
        self._command = None
        self._last_sequence = -1

    def _answer(self, reason: str | None, refusal: str | None = None) -> Answer:
        """Answer a request. `reason` is None if it was granted; `refusal` is the reason as one word."""
        return Answer(
            ok=reason is None,
            reason=(reason or self.reason)[:MAX_REASON_LENGTH],
            refusal=refusal,
            epoch=self.lease.epoch,
            lifecycle=self.state,
        )
