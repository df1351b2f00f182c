"""Commands one robot on behalf of an environment, through the limiter of the HAL or without any limits."""

from collections.abc import Iterable

from snakesim.environments.no_limiter import NoLimiter
from snakesim_hal.base.errors import RefusedError
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.safety.authority import Authority
from snakesim_hal.safety.joint_limits import Applied
from snakesim_hal.safety.lease import Lease
from snakesim_hal.wire.messages import (
    Description,
    JointCommand,
    JointState,
    LeaseRequest,
    LifecycleState,
    Mode,
    Power,
    make_arm_request,
)

REQUESTER = "an environment"
LEASE_PRIORITY = 100


class LimiterClient:
    """Sends commands to the safety core of one robot.

    Attributes:
        core: decides on the setpoints.
    """

    def __init__(self, description: Description, *, safe: bool) -> None:
        """Make a robot that is not armed.

        Args:
            description: the robot.
            safe: whether commands pass the limiter. Otherwise motors get them unchanged, and nothing stops the robot.
        """
        self._description = description
        self._full_torque_nm = [joint.torque_limit_nm for joint in description.joints]
        self._sequence = 0
        self._authority: Authority | None = None
        self._no_limiter: NoLimiter | None = None
        if safe:
            self._authority = Authority(description)
            self.core: Authority | NoLimiter = self._authority
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
        """Arm the robot at the present pose.

        Raises:
            RefusedError: the robot cannot be armed.
        """
        if self._authority is None:
            return
        self._authority.on_lease(LeaseRequest(action="acquire", holder=CONTROL, priority=LEASE_PRIORITY), 0)
        self._offer(self._authority, 0, 0, [Mode.POSITION] * len(self._full_torque_nm), list(joints.angle_rad))
        answer = self._authority.on_lifecycle(make_arm_request(self._description, REQUESTER), 0)
        if not answer.ok:
            raise RefusedError(f"not ready to arm: {answer.reason}", code="robot/not-ready")

    def command(self, tick: int, now_ns: int, modes: list[Mode], target: list[float]) -> None:
        """Send a command that answers the samples of a tick. A robot that is not armed gets none.

        Args:
            tick: number of the control cycle.
            now_ns: safety time.
            modes: mode of each joint.
            target: a target for each joint, tail to head; in rad, rad/s or N·m, depending on the mode.
        """
        if self._no_limiter is not None:
            self._no_limiter.command(modes, target)
        elif self._authority is not None and self._authority.state == "armed":
            self._offer(self._authority, tick, now_ns, modes, target)

    def resume(
        self,
        joints: JointState,
        power: Power | None,
        *,
        applied: tuple[Applied, Applied],
        commands: Iterable[tuple[int, list[float]]],
        mode: Mode,
    ) -> None:
        """Take over a robot that has been armed, and has been commanded without this object until now.

        Args:
            joints: the newest joint state, which was ordinary.
            power: the newest power sample, if there is one.
            applied: the last setpoints but one, and the last ones.
            commands: ticks and targets of the commands that may still be used, oldest first.
            mode: the mode of these commands.
        """
        if self._authority is None:
            return
        authority = _ResumedAuthority(self._description, joints, power, applied)
        self._authority = authority
        self.core = authority
        for tick, target in commands:
            self._offer(authority, tick, joints.timestamp_ns, [mode] * len(target), target)

    def _offer(self, authority: Authority, tick: int, now_ns: int, modes: list[Mode], target: list[float]) -> None:
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
            torque_limit_nm=self._full_torque_nm,
        )
        authority.offer_command(command, now_ns=now_ns, tick=tick, age_ns=0)


class _ResumedAuthority(Authority):
    """The authority of a robot that arrays have limited until now, in the state that it would have had.

    After an ordinary joint state, the plausibility check depends on that state alone, see `plausibility`.
    """

    def __init__(
        self,
        description: Description,
        joints: JointState,
        power: Power | None,
        applied: tuple[Applied, Applied],
    ) -> None:
        """Continue an arm session. The arguments are those of `LimiterClient.resume`."""
        super().__init__(description)
        # An armed robot with a lease, and without a stop that its motors have not received yet.
        self.state = "armed"
        self.reason = f"armed by {REQUESTER}"
        self.arm_session = 1
        self._stop_sent = True
        expires_ns = joints.timestamp_ns + description.lease_ns
        self.lease = Lease(holder=CONTROL, epoch=1, priority=LEASE_PRIORITY, expires_ns=expires_ns)
        # `joints` were measured under the last setpoints but one, and the state that follows under the last ones.
        applied_before, last_applied = applied
        self._applied = applied_before
        self.observe(joints)
        self._applied = last_applied
        if power is not None:
            self.observe_power(power, joints.timestamp_ns)
