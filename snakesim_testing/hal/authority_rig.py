"""Runs a command authority with a clock of its own, and sends it the requests that a HAL host receives."""

from typing import Any

from snakesim_hal.safety.authority import CommandAuthority, TickOutput
from snakesim_hal.safety.cables import CableTracker
from snakesim_hal.wire.messages import (
    Answer,
    EstopRequest,
    JointMode,
    LeaseRequest,
    LifecycleRequest,
)
from snakesim_testing.hal.small_robots import (
    PERIOD_NS,
    make_description,
    make_joint_command,
    make_joint_state,
    make_power,
)

ROBOT = make_description()
JOINT_COUNT = len(ROBOT.joints)
ARM = LifecycleRequest(action="arm", robot="worm", backend="lag", config_hash=ROBOT.config_hash)
DISARM = LifecycleRequest(action="disarm")
RESET = LifecycleRequest(action="reset")
FINISH = LifecycleRequest(action="finish")
ESTOP = EstopRequest(requester="a person")


class AuthorityRig:
    """A command authority, its clock, and the steps that a HAL host takes with it."""

    def __init__(
        self, *, unchecked: str = "", cables: CableTracker | None = None, **robot: Any
    ) -> None:
        self.robot = make_description(**robot)
        self.authority = CommandAuthority(self.robot, unchecked_reason=unchecked, cables=cables)
        self.now_ns = 0
        self.tick = 0
        self.sequence = 0
        self.timestamp_ns = 0

    def observe(self, *values: Any, **other: Any) -> None:
        """Let the authority observe a joint state 1 s later than the last one, so that any angle is plausible."""
        self.timestamp_ns += 10**9
        self.authority.observe_joints(
            make_joint_state(self.robot, *values, timestamp_ns=self.timestamp_ns, **other),
            self.timestamp_ns,
        )

    def acquire(self, holder: str = "control", priority: int = 100) -> Answer:
        """Request the command lease, and return the answer."""
        return self.authority.handle_lease_request(
            LeaseRequest(action="acquire", holder=holder, priority=priority), self.now_ns
        )

    def send(self, target: Any = 0.0, mode: Any = JointMode.POSITION, **other: Any) -> str | None:
        """Send a command, and return the reason if the authority rejects it.

        Args:
            target: Target of every joint, or a list with one target for each joint.
            mode: Mode of every joint, or a list of modes.
            **other: Further fields of the command.
        """
        self.sequence += 1
        fields = {
            "tick": self.tick,
            "sequence": self.sequence,
            "lease_epoch": self.authority.lease.epoch,
            "arm_session": self.authority.arm_session,
            **other,
        }
        command = make_joint_command(self.robot, target, mode, **fields)
        return self.authority.process_command(command, now_ns=self.now_ns, tick=self.tick, age_ns=0)

    def arm(self) -> Answer:
        """Request to arm the robot, and return the answer."""
        return self.authority.handle_lifecycle_request(ARM, self.now_ns)

    def pass_tick(self, period_count: int = 1) -> TickOutput:
        """Let one or more periods pass, and return what the authority decides at the end of the last tick."""
        self.now_ns += period_count * PERIOD_NS
        self.tick += period_count
        self.authority.latch_faults_and_expire_lease(self.now_ns, self.tick)
        return self.authority.compute_setpoints()

    def run_tick_with_command(self, *command: Any, **other: Any) -> TickOutput:
        """Send a command, and return what the authority decides at the end of its tick. See `send`."""
        self.send(*command, **other)
        return self.pass_tick()


def make_commanded_rig(
    target: Any = 0.1, mode: Any = JointMode.POSITION, **robot: Any
) -> AuthorityRig:
    """Return a disarmed rig whose joints are at 0.1 rad, and whose lease holder has sent a command."""
    rig = AuthorityRig(**robot)
    rig.observe(0.1)
    assert rig.acquire().ok
    assert rig.send(target, mode) is None
    return rig


def make_armed_rig(**robot: Any) -> AuthorityRig:
    """Return an armed rig whose lease holder has sent a command."""
    rig = make_commanded_rig(**robot)
    assert rig.arm().ok
    return rig


def list_modes(decision: TickOutput) -> set[JointMode]:
    """Return all modes in the setpoints of a tick."""
    return set(decision.setpoints.mode)


def report_power(
    rig: AuthorityRig, motor_c: list[float], volts: float = 24.0, valid: list[bool] | None = None
) -> None:
    """Let the authority receive the health of the joint modules: temperatures in °C, and the same voltage for all."""
    rig.authority.observe_power(make_power(motor_c, volts, valid=valid or True), rig.now_ns)
