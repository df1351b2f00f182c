"""Who may move the robot, and the setpoints of the motors: lifecycle, lease and limiter in one place, without any I/O.

The host passes in commands, requests, states and the time, and gets setpoints. `now_ns` is safety time: the
monotonic clock, or simulated time in lockstep.
"""

from collections import Counter, deque
from dataclasses import dataclass

import msgspec
import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.safety import lifecycle, limiter
from snakesim_hal.safety.cables import Cables
from snakesim_hal.safety.derating import Derating
from snakesim_hal.safety.fault_log import FaultLog
from snakesim_hal.safety.isolation import Isolation, Mask
from snakesim_hal.safety.lease import Lease, freed, renewed, rule
from snakesim_hal.safety.limiter import Applied, JointLimits
from snakesim_hal.safety.plausibility import ImplausibleState, PlausibilityCheck, readable
from snakesim_hal.safety.stop_ramp import StopRamp
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

COMMANDS_KEPT = 1024


@dataclass(frozen=True)
class Decision:
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
        """first_epoch: different from that of any earlier host, so that commands for another host are rejected.

        awaits_reports: whether arming waits until every module has reported its supply.
        unchecked: why its joints count as not checked, so that only an explicit word arms it; empty: they were.
        cables: of joints without end stops; whoever passes them follows them.
        """
        self._cables = cables or Cables((), {}, {})
        self.description = description
        self.unchecked = unchecked
        self.limits = JointLimits.of(description)
        self.state: LifecycleState = "disarmed"
        self.why = "not armed yet"
        self.arm_session = 0
        self.lease = Lease(epoch=first_epoch)
        self.since_clear = FaultLog()
        self.since_start = FaultLog()
        self.accepted = 0
        self.standby = 0
        self.rejected: Counter[str] = Counter()
        self.limited: Counter[str] = Counter()
        count = len(description.joints)
        self._applied = Applied(np.zeros(count, dtype=np.int64), np.zeros(count), self.limits.torque_nm)
        self._watch = PlausibilityCheck(self.limits)
        self._measured = self._watch.measured
        self._state_tick = 0  # of the newest joint state
        self._armed_tick = -1  # of the state that was the newest at the last arming
        self._isolation = Isolation(description)
        self._implausible: ImplausibleState | None = self._unknown("no joint state yet")
        self._derating = Derating(description, awaits_reports=awaits_reports)
        self._command: JointCommand | None = None
        self._command_ns = 0  # when it was received
        self._counting: JointCommand | None = None  # command of the last decision since arming
        self._recent: deque[JointCommand] = deque(maxlen=COMMANDS_KEPT)  # accepted ones since arming, oldest first
        self._last_sequence = -1
        self._hold_at = np.zeros(count)
        self._halt: StopRamp | None = None  # set if the robot was armed when the present fault came
        self._stop_sent = True  # whether the motors have received setpoints since the robot stopped being armed

    # --- inputs --------------------------------------------------------------------------------------------

    def observe(self, joints: JointState, now_ns: int | None = None) -> None:
        """Take the newest joint state. Implausible values are rejected: the last good ones stay.

        now_ns: safety time; None: that of the state's stamp.
        """
        applied = self._applied if self.state == "armed" else None
        now_ns = joints.timestamp_ns if now_ns is None else now_ns
        self._state_tick = joints.tick
        self._implausible = self._watch.take(joints, now_ns=now_ns, applied=applied, aside=self._isolation.joints)
        self._measured = self._watch.measured

    def observe_power(self, power: Power, now_ns: int) -> None:
        """Take the newest power sample: supply, heat and leaks; `expire` acts on it."""
        self._derating.take(power, now_ns)

    def readable(self, joints: JointState) -> JointState:
        """A joint state for publishing: without NaN or infinity."""
        return readable(joints, self._measured)

    @property
    def derated(self) -> dict[str, float]:
        """Derated joints, and the share of their torque that is left."""
        return self._derating.derated()

    @property
    def faults(self) -> list[Fault]:
        """Faults since the last clear, as far as they are kept."""
        return self.since_clear.kept

    @property
    def isolated(self) -> list[str]:
        """Joints that failed, and are passive until a clear."""
        return self._isolation.names

    def offer(self, command: JointCommand, *, now_ns: int, tick: int, age_ns: int) -> str | None:
        """Take a command, or return why it is rejected. `age_ns`: age of the state that it answers."""
        refusal = limiter.refuse(
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
        if not self.answers_arm_session(command):  # nor does it renew the lease, which takes commands of this arming
            if command.tick <= self._armed_tick:  # sent before the robot was armed: not an error
                self.standby += 1
            else:
                self.rejected["before_arming"] += 1
            return "before_arming"
        self._last_sequence = command.sequence  # only now: a rejected command must not make the next good one a replay
        self.lease = renewed(self.lease, now_ns, self.description.lease_ns)
        self._command, self._command_ns = command, now_ns
        if self.state == "armed":
            self.accepted += 1
            self._recent.append(command)
        else:
            self.standby += 1
        return None

    def answers_arm_session(self, command: JointCommand) -> bool:
        """Whether a command names the present arming, if the robot is armed."""
        return self.state != "armed" or command.arm_session == self.arm_session

    def reject(self, reason: str) -> None:
        """Count a sample that could not be decoded."""
        self.rejected[reason] += 1

    def on_lease(self, request: LeaseRequest, now_ns: int) -> Answer:
        """Decide a lease request; when the lease changes hands the robot is disarmed."""
        ruling = rule(self.lease, request, now_ns, self.description.lease_ns)
        if self.state == "armed" and request.action == "renew":
            return self._answer(ruling.refusal, ruling.word)  # while armed only a command renews the lease
        self.lease = ruling.lease
        if ruling.changed_hands:
            self._forget_commands()
            if self.state == "armed":
                self._go("disarm", f"lease passed to {ruling.lease.holder or 'nobody'}")
        return self._answer(ruling.refusal, ruling.word)

    def on_lifecycle(self, request: LifecycleRequest, now_ns: int) -> Answer:
        """Arm, disarm or clear. A refused arming lists every condition that is not met."""
        match request.action:
            case "arm":
                against = self._refusals(now_ns) + lifecycle.address_mismatches(request, self.description)
                if self.unchecked and not request.unchecked:
                    against.append(("not_checked", f"{self.unchecked}; to arm it as it is, say --unchecked"))
                if against:
                    words = {word for word, _ in against}
                    return self._answer("; ".join(why for _, why in against), min(words, key=lifecycle.ORDER.index))
                as_it_is = ", unchecked" if self.unchecked else ""
                self._go("arm", f"armed by {request.who}{as_it_is}, commanded by {self.lease.holder}")
                self.arm_session += 1
                self._armed_tick = self._state_tick
                self._command = self._counting = None
                self._recent.clear()
                self.lease = renewed(self.lease, now_ns, self.description.lease_ns)
            case "disarm":
                if not self._go("disarm", f"disarmed by {request.who}"):
                    return self._answer(f"cannot disarm in state {self.state}; clear it first", "wrong_state")
            case "clear":
                if not self._go("clear", f"cleared by {request.who}; arm to move again"):
                    lost = ", ".join(self.isolated)
                    hint = f"; disarm first, then a clear ends the isolation of {lost}" if lost else ""
                    return self._answer(f"nothing to clear in state {self.state}{hint}", "wrong_state")
                self._take_back()
                self.since_clear = FaultLog()
            case _:  # finish
                if self.state == "armed":
                    self._go("disarm", f"finished by {request.who}")
        return self._answer(None)

    def on_estop(self, request: EstopRequest, tick: int) -> Answer:
        """Stop now, for any requester."""
        stopping = Fault(tick=tick, what="estop", cause=f"emergency stop by {request.who}")
        self._record(stopping, stops=self.state != "estop")
        self._go("estop", f"emergency stop by {request.who}; clear it to go on")
        return self._answer(None)

    def fault(self, fault: Fault, joints: Mask | None = None) -> None:
        """Latch a fault: the joints take the stop mode until a clear. One that reaches nothing is only noted.

        A fault that concerns only some joints isolates them instead, if the robot file allows that. joints: which;
        None: the one that the fault names.
        """
        if fault.reach == "none":
            self._record(fault, stops=False)
            return
        joints = self._isolation.mask(fault.joint) if joints is None else joints
        if fault.reach == "joint" and self._set_aside(fault, joints):
            return
        fault = msgspec.structs.replace(fault, reach="robot")
        stops = self.state not in ("fault", "estop")  # later faults are usually consequences of the first
        self._record(fault, stops=stops)
        if stops:
            self._go("fault", fault.cause[:500] or fault.what)
        self._drop_lease()

    def note(self, fault: Fault, *, precedes_stop: bool = False) -> None:
        """Record a fault for people that stops nothing by itself.

        precedes_stop: what it leads to stops the robot, as the loss of the process that holds the lease does.
        """
        reach = "robot" if precedes_stop else "none"
        self._record(msgspec.structs.replace(fault, reach=reach), stops=False)

    def holder_gone(self, cause: str) -> None:
        """The lease holder's process has ended: while disarmed, free the lease at once."""
        if self.state != "armed":
            self._drop_lease()
        if self.state == "disarmed":
            self.why = cause

    # --- outputs -------------------------------------------------------------------------------------------

    def against_arming(self, now_ns: int) -> list[str]:
        """Every condition for arming that is not met; empty when ready."""
        return [why for _, why in self._refusals(now_ns)]

    def expire(self, now_ns: int, tick: int) -> None:
        """Check the lease for expiry: while armed, that is a fault; while disarmed, the lease becomes free.

        An armed robot without plausible joint states goes to fault too, and so does one, armed or not, whose
        modules are too hot, leak or lack voltage.
        """
        if self.state == "armed" and self._implausible is not None:
            self.fault(msgspec.structs.replace(self._implausible.fault, tick=tick), self._implausible.joints)
        wrong, silent = self._derating.look(now_ns, tick)
        for fault in wrong:
            self.fault(fault)
        if silent is not None and not self._isolation.has(silent.joint):
            self.note(silent)
        if self.lease.live(now_ns):
            return
        holder, term_ms = self.lease.holder, self.description.lease_ns / 1e6
        if self.state == "armed":
            cause = f"lease of {holder} expired: no accepted command for {term_ms:.0f} ms"
            self.fault(Fault(tick=tick, what="lease_expired", cause=cause))
        else:
            self._drop_lease()

    def decide(self, up_to: int | None = None) -> Decision:
        """The setpoints for the next period. Call `expire` first.

        up_to: in lockstep, the newest tick whose command is used; None: the newest command.
        """
        command = self._command
        if up_to is not None:
            command = next((c for c in reversed(self._recent) if c.tick <= up_to), self._counting)
        sequence: int | None = None
        limited: dict[int, str] = {}
        if self.state != "armed":
            applied = self._safe()
            self._stop_sent = True
        elif command is None:  # just armed: hold the pose until the first command
            applied = self._uniform(Mode.POSITION, self.limits.inside(self._hold_at))
        else:
            measured, share = self._measured, self._derating.share
            applied = limiter.limit(command, measured=measured, last=self._applied, limits=self.limits, share=share)
            sequence, self._counting = command.sequence, command
            if applied.target.tolist() != command.target or min(share.tolist()) < 1.0:
                limited = limiter.why_limited(command, applied, measured=measured, limits=self.limits, share=share)
            limited |= self._isolation.overruled(command)
            self.limited.update(limited.values())
        self._applied = applied = self._isolation.without(applied)
        return Decision(limiter.as_setpoints(applied, self._isolation.indices), sequence, limited)

    # --- inside --------------------------------------------------------------------------------------------

    def _refusals(self, now_ns: int) -> list[tuple[str, str]]:
        found: list[tuple[str, str]] = []
        if self.state != "disarmed":
            first = "; first `snakesim clear`" if self.state in ("fault", "estop") else ""
            found.append(("wrong_state", f"state is {self.state}, must be disarmed{first}"))
        found += [("cable", why) for why in self._cables.against_arming()]
        return found + [("not_ready", why) for why in self._unready(now_ns)]

    def _unready(self, now_ns: int) -> list[str]:
        against = [] if self._implausible is None else [self._implausible.fault.cause]
        wrong = [fault for fault in self._derating.wrong if not self._is_aside(fault)]
        against += [fault.cause for fault in wrong if fault.what != "undervoltage"]
        against += self._derating.against_arming(now_ns)
        if self.arm_session and not self._stop_sent:
            against.append("the motors have not received the stop yet; ask again in a period")
        if not self.lease.live(now_ns):
            against.append("nothing commands the robot: the lease is free")
        elif self._command is None:
            against.append(f"no commands from {self.lease.holder} yet")
        elif now_ns - self._command_ns > self.description.lease_ns:  # the lease may also be renewed by requests
            against.append(f"no commands from {self.lease.holder} any more")
        else:
            at, aside = self._measured.angle_rad, self._isolation.joints
            against.extend(lifecycle.far_targets(self._command, at, self.description, aside))
        return against

    def _unknown(self, cause: str) -> ImplausibleState:
        fault = Fault(tick=0, what="state_invalid", cause=cause)
        return ImplausibleState(fault, np.ones(len(self.description.joints), dtype=np.bool_))

    def _is_aside(self, fault: Fault) -> bool:
        return fault.reach == "joint" and self._isolation.has(fault.joint)

    def _record(self, fault: Fault, *, stops: bool) -> None:
        """stops: it is why the robot is in `fault` or `estop` now."""
        fault = msgspec.structs.replace(fault, cause=fault.cause[:500])
        for log in (self.since_clear, self.since_start):
            log.add(fault, stops=stops)

    def _set_aside(self, fault: Fault, joints: Mask) -> bool:
        """Isolate failed joints, if allowed; later faults of isolated joints are ignored."""
        if self._isolation.covers(joints):
            return True
        if self.state != "armed" or not self._isolation.add(joints):
            return False
        self._record(fault, stops=False)
        self.why = f"armed, without {', '.join(self.isolated)}: {fault.cause}"[:500]
        return True

    def _take_back(self) -> None:
        """End the isolation of joints; first a new joint state must arrive."""
        if self.isolated:
            self._isolation.clear()
            self._implausible = self._unknown("no joint state since the clear")

    def _safe(self) -> Applied:
        zeros = np.zeros_like(self._measured.angle_rad)
        if self.state != "fault" or self._halt is None or self.description.stop_mode == "passive":
            return self._uniform(Mode.PASSIVE, zeros)
        damps = self.limits.damps
        if self.description.stop_mode == "damp" and damps.all():
            return self._uniform(Mode.VELOCITY, zeros)
        self._halt = self._halt.after_a_period(self.limits)
        if self.description.stop_mode == "damp":
            return self._damped(self._halt)
        return self._uniform(Mode.POSITION, self._halt.target_rad)

    def _damped(self, halt: StopRamp) -> Applied:
        """A joint that has no velocity mode is brought to rest by its position, and then let go."""
        damps, rests = self.limits.damps, halt.velocity_rad_s == 0.0
        modes = np.select([damps, rests], [int(Mode.VELOCITY), int(Mode.PASSIVE)], int(Mode.POSITION))
        target = np.where(modes == int(Mode.POSITION), halt.target_rad, 0.0)
        return Applied(modes.astype(np.int64), target, self.limits.torque_nm * self._derating.share)

    def _uniform(self, mode: Mode, target: limiter.Floats) -> Applied:
        limit_nm = self.limits.torque_nm * self._derating.share
        return Applied(np.full(len(target), int(mode), dtype=np.int64), target, limit_nm)

    def _go(self, event: lifecycle.Event, why: str) -> bool:
        """Make a transition; False when the event is not allowed in this state."""
        following = lifecycle.after(self.state, event)
        if following is None:
            return False
        if following != self.state:
            self._hold_at = self._measured.angle_rad
            was_armed = self.state == "armed"
            self._halt = StopRamp.begin(self._measured, self._applied, self.limits) if was_armed else None
            self._stop_sent &= following != "disarmed"
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

    def _answer(self, reason: str | None, refusal: str | None = None) -> Answer:
        return Answer(
            ok=reason is None,
            reason=(reason or self.why)[:500],
            refusal=refusal,
            epoch=self.lease.epoch,
            lifecycle=self.state,
        )
