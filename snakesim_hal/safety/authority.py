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
from snakesim_hal.safety.cables import CableTracker
from snakesim_hal.safety.derating import HealthMonitor
from snakesim_hal.safety.fault_log import FaultLog
from snakesim_hal.safety.isolation import JointIsolation
from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, JointMask
from snakesim_hal.safety.lease import CommandLease, decide_lease_request, free_lease, renew_lease
from snakesim_hal.safety.lifecycle import UnmetCondition
from snakesim_hal.safety.limit_names import find_active_limits
from snakesim_hal.safety.plausibility import (
    ImplausibleState,
    PlausibilityChecker,
    replace_non_finite_values,
)
from snakesim_hal.safety.stop_ramp import StopReaction, make_uniform_setpoints
from snakesim_hal.wire.messages import (
    Answer,
    EstopRequest,
    Fault,
    JointCommand,
    JointMode,
    JointState,
    LeaseRequest,
    LifecycleRequest,
    LifecycleState,
    Power,
    RobotDescription,
)

# Accepted commands that are stored: in lockstep a tick may need an older one.
RECENT_COMMAND_COUNT = 1024
MAX_REASON_LENGTH = 500  # characters, as `quantities.Reason` allows


@dataclass(frozen=True)
class TickOutput:
    """The setpoints of one tick, with the command that they come from."""

    setpoints: SafeSetpoints
    # Sequence number of the applied command; None if no command is applied.
    command_sequence: int | None
    limit_by_joint: dict[int, str]  # joint index -> name of the limit that changed its target


class CommandAuthority:
    """Lifecycle, lease and limiter of one robot."""

    def __init__(
        self,
        description: RobotDescription,
        *,
        first_epoch: int = 0,
        awaits_reports: bool = False,
        unchecked_reason: str = "",
        cables: CableTracker | None = None,
    ) -> None:
        """Start disarmed, without a holder of the lease.

        Args:
            description: Robot as its backend describes it: joints, their limits, and the duration of a lease.
            first_epoch: Epoch of the lease before its first holder. It must differ from that of any earlier host, so
                that commands for another host are rejected.
            awaits_reports: Whether arming waits until every joint module has reported its supply.
            unchecked_reason: Reason why the joints count as not checked, so that only a request with `unchecked` arms
                the robot. Empty if they were checked.
            cables: Tracker of the cables of joints without end stops, which the caller updates. None if there are no
                such joints.
        """
        self._cables = cables or CableTracker((), {}, {})
        self.description = description
        self.unchecked_reason = unchecked_reason
        self.limits = JointLimits.from_description(description)
        count = len(description.joints)

        # Lifecycle and lease.
        self.state: LifecycleState = "disarmed"
        self.reason = "not armed yet"
        self.arm_session = 0
        self.lease = CommandLease(epoch=first_epoch)
        self._newest_state_tick = 0
        # Tick of the joint state that was the newest at the last arming.
        self._last_arming_tick = -1
        # Whether the motors have received setpoints since the robot stopped being armed.
        self._is_stop_sent = True

        # Faults and counters.
        self.faults_since_reset = FaultLog()
        self.faults_since_start = FaultLog()
        self.accepted_count = 0
        self.standby_count = 0
        self.rejected_counts: Counter[str] = Counter()
        self.limited_counts: Counter[str] = Counter()

        # Checks of what is measured.
        self._plausibility_checker = PlausibilityChecker(self.limits)
        self._measured_state = self._plausibility_checker.measured
        self._implausible_state: ImplausibleState | None = self._make_unknown_state(
            "no joint state yet"
        )
        self._backend_obstacles: list[str] = []  # reasons of the backend against arming now
        self._isolation = JointIsolation(description)
        self._health_monitor = HealthMonitor(description, awaits_reports=awaits_reports)

        # Commands.
        self._newest_command: JointCommand | None = None
        self._newest_command_ns = 0  # safety time at which it was received
        self._last_used_command: JointCommand | None = None  # since arming
        # Commands accepted since arming, oldest first.
        self._recent_commands: deque[JointCommand] = deque(maxlen=RECENT_COMMAND_COUNT)
        self._last_sequence = -1

        # Setpoints.
        self._last_setpoints = AppliedSetpoints(
            np.zeros(count, dtype=np.int64), np.zeros(count), self.limits.torque_nm
        )
        self._angles_at_arming_rad = np.zeros(count)
        self._stop_reaction = StopReaction(self.limits, description.stop_mode)

    # --- inputs: measured values -----------------------------------------------------------------------------

    def observe_joints(self, joints: JointState, now_ns: int) -> None:
        """Check the newest joint state, and store its plausible values.

        An implausible value is rejected: the last good value of that joint stays.

        Args:
            joints: Newest joint state.
            now_ns: Safety time in ns.
        """
        applied = None
        if self.state == "armed":
            applied = self._last_setpoints
        self._newest_state_tick = joints.tick
        self._implausible_state = self._plausibility_checker.check(
            joints, now_ns=now_ns, applied=applied, isolated=self._isolation.joints
        )
        self._measured_state = self._plausibility_checker.measured

    def observe_power(self, power: Power, now_ns: int) -> None:
        """Store the newest power sample: supply, heat and leaks.

        `latch_faults_and_expire_lease` latches the faults that follow from the sample.
        """
        self._health_monitor.update(power, now_ns)

    def set_backend_obstacles(self, obstacles: list[str]) -> None:
        """Process why the backend cannot be armed now; empty if nothing is against it."""
        self._backend_obstacles = obstacles

    def replace_non_finite_values(self, joints: JointState) -> JointState:
        """Return a joint state without NaN or infinity, so that it can be published."""
        return replace_non_finite_values(joints, self._measured_state)

    @property
    def derated_joints(self) -> dict[str, float]:
        """Fraction of the torque limit that derating leaves, by the name of each derated joint."""
        return self._health_monitor.find_derated_joints()

    @property
    def faults(self) -> list[Fault]:
        """Faults since the last reset. A long list leaves out faults in its middle."""
        return self.faults_since_reset.faults

    @property
    def isolated_joints(self) -> list[str]:
        """Names of the joints that failed, and are passive until a reset."""
        return self._isolation.joint_names

    # --- inputs: commands and requests -----------------------------------------------------------------------

    def process_command(
        self, command: JointCommand, *, now_ns: int, tick: int, age_ns: int
    ) -> str | None:
        """Accept a command and renew the lease, or reject the command and count why.

        Args:
            command: Command as it was received.
            now_ns: Safety time in ns.
            tick: Newest tick that the host has published.
            age_ns: Age in ns of the joint state that the command answers.

        Returns:
            The reason of the rejection as a word, or None if the command is accepted.
        """
        rejection_reason = limiter.find_rejection_reason(
            command,
            lease=self.lease,
            now_ns=now_ns,
            tick=tick,
            last_sequence=self._last_sequence,
            age_ns=age_ns,
            limits=self.limits,
        )
        if rejection_reason is not None:
            self.rejected_counts[rejection_reason] += 1
            return rejection_reason
        if not self.matches_arm_session(command):
            # The lease is not renewed either: only commands of the current arm session renew it.
            self._count_command_of_other_session(command)
            return "before_arming"
        # The sequence number is stored only now: a rejected command must not make the next good one a replay.
        self._last_sequence = command.sequence
        self.lease = renew_lease(self.lease, now_ns, self.description.lease_ns)
        self._newest_command = command
        self._newest_command_ns = now_ns
        if self.state == "armed":
            self.accepted_count += 1
            self._recent_commands.append(command)
        else:
            self.standby_count += 1
        return None

    def matches_arm_session(self, command: JointCommand) -> bool:
        """Return whether a command names the current arm session. True for any command while the robot is not armed."""
        return self.state != "armed" or command.arm_session == self.arm_session

    def count_rejection(self, reason: str) -> None:
        """Count a sample that could not be decoded."""
        self.rejected_counts[reason] += 1

    def handle_lease_request(self, request: LeaseRequest, now_ns: int) -> Answer:
        """Grant or refuse a lease request. If the lease gets another holder or none, an armed robot is disarmed."""
        decision = decide_lease_request(self.lease, request, now_ns, self.description.lease_ns)
        if self.state == "armed" and request.action == "renew":
            # While armed only a command renews the lease.
            return self._make_answer(decision.refusal, decision.refusal_code)
        self.lease = decision.lease
        if decision.has_holder_changed:
            self._forget_commands()
            if self.state == "armed":
                self._transition(
                    "disarm", f"lease passed to {decision.lease.holder or 'no client'}"
                )
        return self._make_answer(decision.refusal, decision.refusal_code)

    def handle_lifecycle_request(self, request: LifecycleRequest, now_ns: int) -> Answer:
        """Arm, disarm or reset the robot, or disarm it at the end of the run.

        The answer to a refused arming lists every condition that is not met.
        """
        match request.action:
            case "arm":
                return self._handle_arm_request(request, now_ns)
            case "disarm":
                return self._handle_disarm_request(request)
            case "reset":
                return self._handle_reset_request(request)
            case "finish":
                if self.state == "armed":
                    self._transition("disarm", f"finished by {request.requester}")
                return self._make_answer(None)

    def handle_estop_request(self, request: EstopRequest, tick: int) -> Answer:
        """Enter the state `estop` at once. Every requester may do so."""
        estop_fault = Fault(tick=tick, what="estop", cause=f"emergency stop by {request.requester}")
        self._add_to_fault_logs(estop_fault, stops_robot=self.state != "estop")
        self._transition("estop", f"emergency stop by {request.requester}; reset it to continue")
        return self._make_answer(None)

    # --- inputs: faults --------------------------------------------------------------------------------------

    def latch_fault(self, fault: Fault, joints: JointMask | None = None) -> None:
        """Latch a fault: the robot is in the state `fault`, and its joints in the stop mode, until a reset.

        A fault with the scope "none" is only logged. A fault with the scope "joint" isolates its joints instead of
        stopping the robot, if the robot file allows that.

        Args:
            fault: Fault to latch.
            joints: (n_joints,) mask of the joints that failed. None means the joint that the fault names.
        """
        if fault.scope == "none":
            self._add_to_fault_logs(fault, stops_robot=False)
            return
        if joints is None:
            joints = self._isolation.make_joint_mask(fault.joint)
        if fault.scope == "joint" and self._try_isolate(fault, joints):
            return
        fault = msgspec.structs.replace(fault, scope="robot")
        # Only the first fault counts as the reason of the stop: later ones are usually its consequences.
        stops_robot = self.state not in ("fault", "estop")
        self._add_to_fault_logs(fault, stops_robot=stops_robot)
        if stops_robot:
            self._transition("fault", fault.cause[:MAX_REASON_LENGTH] or fault.what)
        self._free_lease()

    def log_fault(self, fault: Fault, *, precedes_stop: bool = False) -> None:
        """Log a fault without changing the state of the robot.

        Args:
            fault: Fault to log.
            precedes_stop: Whether a consequence of the fault will stop the robot. True when the process that holds the
                lease ends.
        """
        scope = "robot" if precedes_stop else "none"
        self._add_to_fault_logs(msgspec.structs.replace(fault, scope=scope), stops_robot=False)

    def handle_lease_holder_exit(self, cause: str) -> None:
        """Free the lease after its holder's process has ended. An armed robot keeps the lease until it expires.

        Args:
            cause: Text for the operator, which becomes the reason of the state `disarmed`.
        """
        if self.state != "armed":
            self._free_lease()
        if self.state == "disarmed":
            self.reason = cause

    # --- outputs ---------------------------------------------------------------------------------------------

    def list_unmet_conditions(self, now_ns: int) -> list[str]:
        """Return a text for each condition for arming that is not met. An empty list means that the robot is ready."""
        return [condition.reason for condition in self._find_unmet_conditions(now_ns)]

    def latch_faults_and_expire_lease(self, now_ns: int, tick: int) -> None:
        """Latch the faults that follow from the measured values and from the time, and free an expired lease.

        Three conditions are faults: an armed robot has no plausible joint state; a joint module is too hot, leaks, or
        has a low supply voltage, whether or not the robot is armed; and the lease of an armed robot has expired. If the
        robot is not armed, an expired lease is only released.

        Args:
            now_ns: Safety time in ns.
            tick: Current tick, which new faults name.
        """
        implausible_state = self._implausible_state
        if self.state == "armed" and implausible_state is not None:
            self.latch_fault(
                msgspec.structs.replace(implausible_state.fault, tick=tick),
                implausible_state.joints,
            )
        new_faults, silence_fault = self._health_monitor.evaluate(now_ns, tick)
        for fault in new_faults:
            self.latch_fault(fault)
        if silence_fault is not None and not self._isolation.is_isolated(silence_fault.joint):
            self.log_fault(silence_fault)  # missing reports stop nothing
        if self.lease.is_held(now_ns):
            return
        if self.state == "armed":
            lease_duration_ms = self.description.lease_ns / 1e6
            cause = f"lease of {self.lease.holder} expired: no accepted command for {lease_duration_ms:.0f} ms"
            self.latch_fault(Fault(tick=tick, what="lease_expired", cause=cause))
        else:
            self._free_lease()

    def compute_setpoints(self, max_tick: int | None = None) -> TickOutput:
        """Return the limited setpoints for the next control period. Call `latch_faults_and_expire_lease` first.

        An armed robot gets the setpoints of a command, or holds its pose until the first command. In every other state
        it gets those of its stop mode.

        Args:
            max_tick: In lockstep, the newest tick whose command may be used. None means the newest command.
        """
        command = self._select_command(max_tick)
        sequence: int | None = None
        limited: dict[int, str] = {}
        if self.state != "armed":
            applied = self._stop_reaction.make_setpoints(
                self.state, self._compute_derated_torque_nm()
            )
            self._is_stop_sent = True
        elif command is None:
            # Just armed: hold the pose until the first command.
            pose_rad = self.limits.clip_angles(self._angles_at_arming_rad)
            applied = make_uniform_setpoints(
                JointMode.POSITION, pose_rad, self._compute_derated_torque_nm()
            )
        else:
            applied = limiter.limit_command(
                command,
                measured=self._measured_state,
                last=self._last_setpoints,
                limits=self.limits,
                torque_fraction=self._health_monitor.torque_fraction,
            )
            sequence = command.sequence
            limited = self._find_and_count_active_limits(command, applied)
            self._last_used_command = command
        applied = self._isolation.make_passive(applied)
        self._last_setpoints = applied
        return TickOutput(
            limiter.make_safe_setpoints(applied, self._isolation.indices), sequence, limited
        )

    # --- commands and setpoints ------------------------------------------------------------------------------

    def _count_command_of_other_session(self, command: JointCommand) -> None:
        """Count a command of another arm session: as rejected only if it was sent after the last arming."""
        if command.tick <= self._last_arming_tick:
            self.standby_count += 1
        else:
            self.rejected_counts["before_arming"] += 1

    def _select_command(self, max_tick: int | None) -> JointCommand | None:
        """Return the command to apply in this tick; None if there is none.

        Args:
            max_tick: In lockstep, the newest tick that the command may answer. None means the newest command.
        """
        if max_tick is None:
            return self._newest_command
        for command in reversed(self._recent_commands):
            if command.tick <= max_tick:
                return command
        return self._last_used_command

    def _find_and_count_active_limits(
        self, command: JointCommand, applied: AppliedSetpoints
    ) -> dict[int, str]:
        """Return the name of the limit that changed the command of each limited joint, by joint index, and count it."""
        limit_by_joint: dict[int, str] = {}
        torque_fraction = self._health_monitor.torque_fraction
        # Most commands pass unchanged, so that the limits are named only when a target or a torque limit differs.
        if applied.target.tolist() != command.target or min(torque_fraction.tolist()) < 1.0:
            limit_by_joint = find_active_limits(
                command,
                applied,
                measured=self._measured_state,
                limits=self.limits,
                torque_fraction=torque_fraction,
            )
        limit_by_joint |= self._isolation.find_overruled_joints(command)
        if limit_by_joint:
            self.limited_counts.update(limit_by_joint.values())
        return limit_by_joint

    def _compute_derated_torque_nm(self) -> Floats:
        """Return the torque limits that derating leaves, (n_joints,)."""
        return self.limits.torque_nm * self._health_monitor.torque_fraction

    # --- lifecycle -------------------------------------------------------------------------------------------

    def _handle_arm_request(self, request: LifecycleRequest, now_ns: int) -> Answer:
        """Arm the robot and start an arm session, or refuse the request with all conditions that are not met."""
        unmet = self._find_unmet_conditions(now_ns)
        unmet += lifecycle.find_address_mismatches(request, self.description)
        if self.unchecked_reason and not request.unchecked:
            reason = f"{self.unchecked_reason}; to arm it as it is, add --unchecked"
            unmet.append(UnmetCondition("not_checked", reason))
        if unmet:
            reasons = "; ".join(condition.reason for condition in unmet)
            refusal_codes = {condition.refusal for condition in unmet}
            most_important = min(refusal_codes, key=lifecycle.REFUSAL_ORDER.index)
            return self._make_answer(reasons, most_important)
        unchecked_suffix = ", unchecked" if self.unchecked_reason else ""
        self._transition(
            "arm",
            f"armed by {request.requester}{unchecked_suffix}, commanded by {self.lease.holder}",
        )
        self.arm_session += 1
        self._last_arming_tick = self._newest_state_tick
        self._newest_command = None
        self._last_used_command = None
        self._recent_commands.clear()
        self.lease = renew_lease(self.lease, now_ns, self.description.lease_ns)
        return self._make_answer(None)

    def _handle_disarm_request(self, request: LifecycleRequest) -> Answer:
        if not self._transition("disarm", f"disarmed by {request.requester}"):
            return self._make_answer(
                f"cannot disarm in state {self.state}; reset it first", "wrong_state"
            )
        return self._make_answer(None)

    def _handle_reset_request(self, request: LifecycleRequest) -> Answer:
        if not self._transition("reset", f"reset by {request.requester}; arm to move again"):
            hint = ""
            if self.isolated_joints:
                hint = f"; disarm first, then a reset ends the isolation of {', '.join(self.isolated_joints)}"
            return self._make_answer(f"nothing to reset in state {self.state}{hint}", "wrong_state")
        self._end_isolation()
        self.faults_since_reset = FaultLog()
        return self._make_answer(None)

    def _transition(self, event: lifecycle.LifecycleEvent, reason: str) -> bool:
        """Change the lifecycle state, and start or cancel the stop ramp that belongs to it.

        Args:
            event: Event that causes the change.
            reason: Text for the operator.

        Returns:
            False if the event is not allowed in this state; then nothing is changed.
        """
        next_state = lifecycle.next_state(self.state, event)
        if next_state is None:
            return False
        was_armed = self.state == "armed"
        if next_state != self.state:
            self._angles_at_arming_rad = self._measured_state.angle_rad
            if was_armed:
                self._stop_reaction.start_ramp(self._measured_state, self._last_setpoints)
            else:
                self._stop_reaction.cancel_ramp()
            if next_state == "disarmed":
                self._is_stop_sent = False
        if was_armed:
            self._newest_command = None
        self.state = next_state
        self.reason = reason
        return True

    def _find_unmet_conditions(self, now_ns: int) -> list[UnmetCondition]:
        """Return every condition of the robot, its lease and its commands for arming that is not met."""
        unmet: list[UnmetCondition] = []
        if self.state != "disarmed":
            reset_first = (
                "; first `snakesim robot reset`" if self.state in ("fault", "estop") else ""
            )
            unmet.append(
                UnmetCondition(
                    "wrong_state", f"state is {self.state}, must be disarmed{reset_first}"
                )
            )
        unmet += [
            UnmetCondition("cable", reason) for reason in self._cables.list_arming_obstacles()
        ]
        not_ready = self._find_unready_robot(now_ns) + self._find_unready_commands(now_ns)
        unmet += [UnmetCondition("not_ready", reason) for reason in not_ready]
        return unmet

    def _find_unready_robot(self, now_ns: int) -> list[str]:
        """Return a text for each problem of the joint state, heat, supply, backend and last stop."""
        reasons: list[str] = []
        if self._implausible_state is not None:
            reasons.append(self._implausible_state.fault.cause)
        for fault in self._health_monitor.current_faults:
            # The supply has a separate reason, which explains what to do.
            if fault.what != "undervoltage" and not self._concerns_isolated_joint(fault):
                reasons.append(fault.cause)
        reasons += self._health_monitor.find_supply_problems(now_ns)
        reasons += self._backend_obstacles
        if self.arm_session and not self._is_stop_sent:
            reasons.append("the motors have not received the stop yet; ask again in a period")
        return reasons

    def _find_unready_commands(self, now_ns: int) -> list[str]:
        """Return a text for each problem of the lease and of the stream of commands."""
        if not self.lease.is_held(now_ns):
            return ["nothing commands the robot: the lease is free"]
        if self._newest_command is None:
            return [f"no commands from {self.lease.holder} yet"]
        # Requests may renew the lease, too, so that a held lease does not prove that commands still arrive.
        if now_ns - self._newest_command_ns > self.description.lease_ns:
            return [f"no commands from {self.lease.holder} any more"]
        return lifecycle.find_far_targets(
            self._newest_command,
            self._measured_state.angle_rad,
            self.description,
            self._isolation.joints,
        )

    # --- faults and isolation --------------------------------------------------------------------------------

    def _add_to_fault_logs(self, fault: Fault, *, stops_robot: bool) -> None:
        """Add a fault to both logs.

        Args:
            fault: Fault to add.
            stops_robot: Whether the robot enters `fault` or `estop` because of this fault.
        """
        fault = msgspec.structs.replace(fault, cause=fault.cause[:MAX_REASON_LENGTH])
        self.faults_since_reset.add(fault, stops_robot=stops_robot)
        self.faults_since_start.add(fault, stops_robot=stops_robot)

    def _try_isolate(self, fault: Fault, joints: JointMask) -> bool:
        """Isolate failed joints if the robot may continue without them.

        Args:
            fault: Fault of the joints, which is logged.
            joints: (n_joints,) mask of the joints.

        Returns:
            Whether the joints are isolated now. True without another log entry if they were isolated already.
        """
        if self._isolation.are_isolated(joints):
            return True
        if self.state != "armed" or not self._isolation.try_isolate(joints):
            return False
        self._add_to_fault_logs(fault, stops_robot=False)
        self.reason = f"armed, without {', '.join(self.isolated_joints)}: {fault.cause}"[
            :MAX_REASON_LENGTH
        ]
        return True

    def _end_isolation(self) -> None:
        """End all isolations. The robot cannot be armed before a new joint state has arrived."""
        if self.isolated_joints:
            self._isolation.reset()
            self._implausible_state = self._make_unknown_state("no joint state since the reset")

    def _concerns_isolated_joint(self, fault: Fault) -> bool:
        return fault.scope == "joint" and self._isolation.is_isolated(fault.joint)

    def _make_unknown_state(self, cause: str) -> ImplausibleState:
        fault = Fault(tick=0, what="state_invalid", cause=cause)
        return ImplausibleState(fault, np.ones(len(self.description.joints), dtype=np.bool_))

    # --- lease and answers -----------------------------------------------------------------------------------

    def _free_lease(self) -> None:
        self.lease = free_lease(self.lease)
        self._forget_commands()

    def _forget_commands(self) -> None:
        self._newest_command = None
        self._last_sequence = -1

    def _make_answer(self, reason: str | None, refusal: str | None = None) -> Answer:
        """Return the answer to a request.

        Args:
            reason: Text why the request is refused. None if it is granted.
            refusal: Reason of the refusal as one word.
        """
        return Answer(
            ok=reason is None,
            reason=(reason or self.reason)[:MAX_REASON_LENGTH],
            refusal=refusal,
            epoch=self.lease.epoch,
            lifecycle=self.state,
        )
