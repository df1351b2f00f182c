"""Commands one robot on behalf of an environment, through the limiter of the HAL or without any limits."""

from collections.abc import Iterable

from snakesim.environments.no_limiter import NoLimiter
from snakesim_hal.base.errors import RefusedError
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.safety.authority import CommandAuthority
from snakesim_hal.safety.joint_limits import AppliedSetpoints
from snakesim_hal.safety.lease import CommandLease
from snakesim_hal.wire.messages import (
    JointCommand,
    JointMode,
    JointState,
    LeaseRequest,
    LifecycleState,
    Power,
    RobotDescription,
    make_arm_request,
)

REQUESTER = "an environment"
LEASE_PRIORITY = 100


class LimiterClient:
    """Sends commands to the safety core of one robot.

    The safety core turns commands into setpoints. It is either a `CommandAuthority`, which is the safety core of the
    HAL with its command limiter, or a `NoLimiter`, which passes commands on unchanged.

    Attributes:
        core: Safety core of the robot.
    """

    def __init__(self, description: RobotDescription, *, safe: bool) -> None:
        """Create the safety core of a robot, which is not armed yet.

        Args:
            description: Description of the robot.
            safe: If True, commands pass the limiter of the HAL. If False, motors get the commands unchanged, and no
                fault stops the robot.
        """
        self._description = description
        self._max_torque_nm = [joint.torque_limit_nm for joint in description.joints]
        self._sequence = 0
        # One of the two is the safety core; the other is None. `core` is the same object.
        self._authority: CommandAuthority | None = None
        self._no_limiter: NoLimiter | None = None
        if safe:
            self._authority = CommandAuthority(description)
            self.core: CommandAuthority | NoLimiter = self._authority
        else:
            self._no_limiter = NoLimiter(description)
            self.core = self._no_limiter

    @property
    def state(self) -> LifecycleState:
        """The lifecycle state, as a host would publish it."""
        return self.core.state

    @property
    def reason(self) -> str:
        """Why the robot is in this state."""
        return self.core.reason

    @property
    def arm_session(self) -> int:
        """Number of the arm session; 1 for a robot without limits."""
        return 1 if self._authority is None else self._authority.arm_session

    @property
    def has_isolated_joints(self) -> bool:
        """Whether joints have failed, and are passive."""
        return self._authority is not None and bool(self._authority.isolated_joints)

    def arm(self, joints: JointState) -> None:
        """Acquire the lease, command the measured angles, and arm the robot. Without a limiter, do nothing.

        Args:
            joints: Joint states of tick 0.

        Raises:
            RefusedError: The robot cannot be armed.
        """
        if self._authority is None:
            return
        self._authority.handle_lease_request(
            LeaseRequest(action="acquire", holder=CONTROL, priority=LEASE_PRIORITY), 0
        )
        self._send_command(
            self._authority,
            0,
            0,
            [JointMode.POSITION] * len(self._max_torque_nm),
            list(joints.angle_rad),
        )
        answer = self._authority.handle_lifecycle_request(
            make_arm_request(self._description, REQUESTER), 0
        )
        if not answer.ok:
            raise RefusedError(f"not ready to arm: {answer.reason}", code="robot/not-ready")

    def command(self, tick: int, now_ns: int, modes: list[JointMode], target: list[float]) -> None:
        """Send a command that answers the samples of a tick. A robot that is not armed gets none.

        Args:
            tick: Number of the control cycle.
            now_ns: Current robot time, which is the time base of the safety core.
            modes: Control mode of each joint, tail to head.
            target: A target for each joint, tail to head, in rad, rad/s or N·m depending on the mode.
        """
        if self._no_limiter is not None:
            self._no_limiter.command(modes, target)
        elif self._authority is not None and self._authority.state == "armed":
            self._send_command(self._authority, tick, now_ns, modes, target)

    def resume(
        self,
        joints: JointState,
        power: Power | None,
        *,
        applied: tuple[AppliedSetpoints, AppliedSetpoints],
        commands: Iterable[tuple[int, list[float]]],
        mode: JointMode,
    ) -> None:
        """Take over the commands of a robot that is already armed, from the array limiter.

        The array limiter limits many robots at once, see `armed`. This client gets a new safety core, in the state that
        it would have if it had limited the robot since its start. The robot is not armed again. Without a limiter, this
        does nothing.

        Args:
            joints: Newest joint state that the array limiter has accepted.
            power: Newest power sample. None if there was none.
            applied: Setpoints of the last tick but one, and of the last tick.
            commands: Tick and targets of each command that may still take effect, oldest first.
            mode: Control mode of these commands.
        """
        if self._authority is None:
            return
        authority = _ResumedAuthority(self._description, joints, power, applied)
        self._authority = authority
        self.core = authority
        for tick, target in commands:
            self._send_command(authority, tick, joints.timestamp_ns, [mode] * len(target), target)

    def _send_command(
        self,
        authority: CommandAuthority,
        tick: int,
        now_ns: int,
        modes: list[JointMode],
        target: list[float],
    ) -> None:
        """Send a command that answers the samples of a tick."""
        self._sequence += 1
        command = JointCommand(
            # What it answers, and on whose behalf.
            tick=tick,
            sequence=self._sequence,
            arm_session=authority.arm_session,
            lease_epoch=authority.lease.epoch,
            layout=self._description.layout,
            valid_for_ns=self._description.lease_ns,
            # The setpoints.
            mode=modes,
            target=target,
            torque_limit_nm=self._max_torque_nm,
        )
        authority.process_command(command, now_ns=now_ns, tick=tick, age_ns=0)


class _ResumedAuthority(CommandAuthority):
    """The authority of a robot that the array limiter has limited until now, in the state that it would be in.

    After an ordinary joint state, the plausibility check depends on that state alone, see
    `snakesim_hal.safety.plausibility`.
    """

    def __init__(
        self,
        description: RobotDescription,
        joints: JointState,
        power: Power | None,
        applied: tuple[AppliedSetpoints, AppliedSetpoints],
    ) -> None:
        """Create an authority that is armed, holds a lease, and has seen the given samples.

        Args:
            description: Description of the robot.
            joints: Newest joint state that the array limiter has accepted.
            power: Newest power sample. None if there was none.
            applied: Setpoints of the last tick but one, and of the last tick.
        """
        super().__init__(description)
        # An armed robot with a lease, and without a stop that its motors have not received yet.
        self.state = "armed"
        self.reason = f"armed by {REQUESTER}"
        self.arm_session = 1
        self._is_stop_sent = True
        expires_ns = joints.timestamp_ns + description.lease_ns
        self.lease = CommandLease(
            holder=CONTROL, epoch=1, priority=LEASE_PRIORITY, expires_ns=expires_ns
        )
        # `joints` were measured under the last setpoints but one, and the state that follows under the last ones.
        previous_setpoints, last_setpoints = applied
        self._last_setpoints = previous_setpoints
        self.observe_joints(joints, joints.timestamp_ns)
        self._last_setpoints = last_setpoints
        if power is not None:
            self.observe_power(power, joints.timestamp_ns)
