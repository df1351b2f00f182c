"""Who may move the robot, and what the motors are told: lifecycle, lease and gate in one place, without any I/O.

The host passes in commands, requests, states and the time; it gets back set-points. `now_ns` is safety time: the
monotonic clock, or simulated time in lockstep.
"""

from collections import Counter, deque
from dataclasses import dataclass

import msgspec
import numpy as np

from snakesim_hal import gate, lifecycle
from snakesim_hal.backend import SetPoints
from snakesim_hal.gate import Applied, JointLimits, Measured
from snakesim_hal.lease import Lease, freed, renewed, rule
from snakesim_hal.messages import (
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
)

MAX_FAULTS_KEPT = 32
COMMANDS_KEPT = 1024


@dataclass(frozen=True)
class Decision:
    """What the motors get for one tick."""

    set_points: SetPoints
    sequence: int | None  # of the command behind it; None: the host's own safe action
    limited: dict[int, str]  # joint index -> which limit changed its target


class Authority:
    """Lifecycle, lease and gate of one robot."""

    def __init__(self, description: Description, *, first_epoch: int = 0) -> None:
        """first_epoch: unlike that of any host before, so that what was meant for another host is refused."""
        self.description = description
        self.limits = JointLimits.of(description)
        self.state: LifecycleState = "disarmed"
        self.why = "not armed yet"
        self.arming = 0
        self.lease = Lease(epoch=first_epoch)
        self.faults: list[Fault] = []  # since the last clear
        self.fault_log: list[Fault] = []  # since the start
        self.accepted = 0
        self.standby = 0
        self.rejected: Counter[str] = Counter()
        self.limited: Counter[str] = Counter()
        count = len(description.joints)
        self._applied = Applied(np.zeros(count, dtype=np.int64), np.zeros(count), self.limits.torque_nm)
        self._measured = Measured(np.zeros(count), np.zeros(count), np.zeros(count))
        self._state_trouble: str | None = "no joint state yet"
        self._command: JointCommand | None = None
        self._command_ns = 0  # when it came
        self._counting: JointCommand | None = None  # what the last decision since arming was made from
        self._recent: deque[JointCommand] = deque(maxlen=COMMANDS_KEPT)  # good ones since arming, oldest first
        self._last_sequence = -1
        self._hold_at = np.zeros(count)
        self._was_armed = False  # when the present fault came: only then is there a motion to stop

    # --- what comes in -------------------------------------------------------------------------------------

    def observe(self, joints: JointState) -> None:
        """Take the newest joint state. What is not finite is no measurement: the last good one stays."""
        count = len(self.description.joints)
        lists = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, joints.valid, joints.age_ns)
        if {len(values) for values in lists} != {count}:
            self._state_trouble = f"no joint state of {count} joints"
            return
        columns = np.array(lists[:3])
        finite = bool(np.isfinite(columns).all())
        if finite:
            self._measured = Measured(*columns)
        if finite and all(joints.valid) and max(joints.age_ns) <= self.description.lease_ns:
            self._state_trouble = None
            return
        fresh = np.array(joints.age_ns) <= self.description.lease_ns
        good = np.isfinite(columns).all(axis=0) & fresh & np.array(joints.valid)
        bad = [self.description.joints[i].name for i in np.flatnonzero(~good)]
        self._state_trouble = f"no valid and fresh state of {', '.join(bad)}"[:400]

    def offer(self, command: JointCommand, *, now_ns: int, tick: int, age_ns: int) -> str | None:
        """Take a command, or return why not. `age_ns`: time since the state that it answers was published."""
        refusal = gate.refuse(
            command,
            lease=self.lease,
            now_ns=now_ns,
            tick=tick,
            last_sequence=self._last_sequence,
            age_ns=age_ns,
            limits=self.limits,
        )
        if refusal is not None:
            self.rejected[refusal] += 1
            return refusal
        self._last_sequence = command.sequence
        if not self.answers_arming(command):  # nor does it keep the lease: what moves the robot must be commanded now
            self.standby += 1
            return "before_arming"
        self.lease = renewed(self.lease, now_ns, self.description.lease_ns)
        self._command, self._command_ns = command, now_ns
        if self.state == "armed":
            self.accepted += 1
            self._recent.append(command)
        else:
            self.standby += 1
        return None

    def answers_arming(self, command: JointCommand) -> bool:
        """Whether a command was sent in the knowledge that the robot is armed, if it is."""
        return self.state != "armed" or command.arming is None or command.arming == self.arming

    def reject(self, reason: str) -> None:
        """Count a sample that never became a command."""
        self.rejected[reason] += 1

    def on_lease(self, request: LeaseRequest, now_ns: int) -> Answer:
        """Decide a lease request; when the lease changes hands the robot stops in between."""
        ruling = rule(self.lease, request, now_ns, self.description.lease_ns)
        if self.state == "armed" and request.action == "renew":
            return self._answer(ruling.refusal)  # armed, only a good command renews: asking is not commanding
        self.lease = ruling.lease
        if ruling.changed_hands:
            self._forget_commands()
            if self.state == "armed":
                self._go("disarm", f"lease passed to {ruling.lease.holder or 'nobody'}")
        return self._answer(ruling.refusal)

    def on_lifecycle(self, request: LifecycleRequest, now_ns: int) -> Answer:
        """Arm, disarm or clear. Arming says no with every condition that is not met."""
        match request.action:
            case "arm":
                against = self.against_arming(now_ns)
                if request.robot != self.description.robot:
                    against.append(f"this robot is {self.description.robot!r}, the request names {request.robot!r}")
                if request.backend != self.description.backend:
                    against.append(
                        f"this backend is {self.description.backend!r}, the request names {request.backend!r}"
                    )
                if against:
                    return self._answer("; ".join(against))
                self._go("arm", f"armed, commanded by {self.lease.holder}")
                self.arming += 1
                self._command = self._counting = None
                self._recent.clear()
                self.lease = renewed(self.lease, now_ns, self.description.lease_ns)
            case "disarm":
                if not self._go("disarm", "disarmed on request"):
                    return self._answer(f"cannot disarm in state {self.state}; clear it first")
            case "clear":
                if not self._go("clear", "cleared; arm to move again"):
                    return self._answer(f"nothing to clear in state {self.state}")
                self.faults.clear()
            case _:  # finish
                if self.state == "armed":
                    self._go("disarm", "run finished")
        return self._answer(None)

    def on_estop(self, request: EstopRequest, tick: int) -> Answer:
        """Stop now, whoever asks."""
        self.note(Fault(tick=tick, what="estop", cause=f"emergency stop by {request.who}"))
        self._go("estop", f"emergency stop by {request.who}; clear it to go on")
        return self._answer(None)

    def fault(self, fault: Fault) -> None:
        """Latch a fault: the joints go to the safe action until someone clears it."""
        self.note(fault)
        if self.state != "estop":
            self._go("fault", fault.cause[:500] or fault.what)
        self._drop_lease()

    def note(self, fault: Fault) -> None:
        """Keep a fault that people should know of but that stops nothing by itself."""
        fault = msgspec.structs.replace(fault, cause=fault.cause[:500])
        for kept in (self.faults, self.fault_log):
            if len(kept) < MAX_FAULTS_KEPT:
                kept.append(fault)

    def holder_gone(self, cause: str) -> None:
        """The lease holder's process is known to be gone while disarmed: free the lease at once."""
        if self.state != "armed":
            self._drop_lease()
        if self.state == "disarmed":
            self.why = cause

    # --- what goes out -------------------------------------------------------------------------------------

    def against_arming(self, now_ns: int) -> list[str]:
        """Every condition for arming that is not met; empty when ready."""
        against: list[str] = []
        if self.state != "disarmed":
            against.append(f"state is {self.state}, must be disarmed")
        if self._state_trouble is not None:
            against.append(self._state_trouble)
        if not self.lease.live(now_ns):
            against.append("nobody holds the lease")
        elif self._command is None:
            against.append(f"no commands from {self.lease.holder} yet")
        elif now_ns - self._command_ns > self.description.lease_ns:  # the lease may be kept by asking, too
            against.append(f"no commands from {self.lease.holder} any more")
        else:
            against.extend(self._far_targets(self._command))
        return against

    def expire(self, now_ns: int, tick: int) -> None:
        """Let the lease run out: armed, that is a fault; disarmed, the lease is simply free again.

        A robot that is armed and does not know its joints any more is at fault too.
        """
        if self.state == "armed" and self._state_trouble is not None:
            self.fault(Fault(tick=tick, what="state_invalid", cause=self._state_trouble))
        if self.lease.live(now_ns):
            return
        holder, term_ms = self.lease.holder, self.description.lease_ns / 1e6
        if self.state == "armed":
            cause = f"lease of {holder} expired: no good command for {term_ms:.0f} ms"
            self.fault(Fault(tick=tick, what="lease_expired", cause=cause))
        else:
            self._drop_lease()

    def decide(self, up_to: int | None = None) -> Decision:
        """The set-points for the next period. Call `expire` first.

        up_to: newest tick whose command counts already, in lockstep; None: the command that came last.
        """
        command = self._command
        if up_to is not None:
            command = next((c for c in reversed(self._recent) if c.tick <= up_to), self._counting)
        if self.state != "armed":
            applied = self._safe()
            self._applied = applied
            return Decision(gate.as_set_points(applied), None, {})
        if command is None:  # armed a moment ago: hold the pose until the first command
            applied = self._holding(self._hold_at)
            self._applied = applied
            return Decision(gate.as_set_points(applied), None, {})
        applied, asked = gate.limit(command, measured=self._measured, last=self._applied, limits=self.limits)
        self._applied, self._counting = applied, command
        limited: dict[int, str] = {}
        if (applied.target != asked).any():
            limited = gate.why_limited(applied, asked, self.limits)
            self.limited.update(limited.values())
        return Decision(gate.as_set_points(applied), command.sequence, limited)

    # --- inside --------------------------------------------------------------------------------------------

    def _safe(self) -> Applied:
        if self.state != "fault" or not self._was_armed or self.description.safe_action == "passive":
            return self._uniform(Mode.PASSIVE, np.zeros_like(self._measured.angle_rad))
        if self.description.safe_action == "damp":
            return self._uniform(Mode.VELOCITY, np.zeros_like(self._measured.angle_rad))
        return self._holding(self._hold_at)

    def _holding(self, angle_rad: gate.Floats) -> Applied:
        return self._uniform(Mode.POSITION, np.clip(angle_rad, self.limits.angle_min_rad, self.limits.angle_max_rad))

    def _uniform(self, mode: Mode, target: gate.Floats) -> Applied:
        return Applied(np.full(len(target), int(mode), dtype=np.int64), target, self.limits.torque_nm)

    def _far_targets(self, command: JointCommand) -> list[str]:
        far: list[str] = []
        for i, joint in enumerate(self.description.joints):
            gap = command.target[i] - self._measured.angle_rad[i]
            if command.mode[i] not in (Mode.POSITION, Mode.PASSIVE):
                asked = command.mode[i].name.lower()
                far.append(f"{joint.name} is asked for {asked}; only staying is allowed at arming")
            if command.mode[i] == Mode.POSITION and abs(gap) > self.limits.max_step_rad:
                far.append(
                    f"{joint.name} is asked to go {gap:+.2f} rad from where it is; at most "
                    f"{self.limits.max_step_rad} rad at arming"
                )
        return far

    def _go(self, event: lifecycle.Event, why: str) -> bool:
        """Follow an event; False when it is not allowed in this state."""
        following = lifecycle.after(self.state, event)
        if following is None:
            return False
        if following != self.state:
            self._hold_at = self._measured.angle_rad
            self._was_armed = self.state == "armed"
        if self.state == "armed":
            self._command = None
        self.state = following
        self.why = why
        return True

    def _drop_lease(self) -> None:
        self.lease = freed(self.lease)
        self._forget_commands()

    def _forget_commands(self) -> None:
        self._command = None
        self._last_sequence = -1

    def _answer(self, refusal: str | None) -> Answer:
        return Answer(
            ok=refusal is None,
            reason=(refusal or self.why)[:500],
            epoch=self.lease.epoch,
            lifecycle=self.state,
        )
