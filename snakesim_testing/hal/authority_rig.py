"""An authority with a clock, and the requests that its tests make."""

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
JOINTS = len(ROBOT.joints)
ARM = LifecycleRequest(action="arm", robot="worm", backend="lag", config_hash=ROBOT.config_hash)
DISARM, CLEAR, FINISH = (
    LifecycleRequest(action=action) for action in ("disarm", "reset", "finish")
)
ESTOP = EstopRequest(requester="a person")


class AuthorityRig:
    """An authority with a clock; every step is one a host would take."""

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
        """A state so much later than the one before that the joints may have come from anywhere."""
        self.timestamp_ns += 10**9
        self.authority.observe_joints(
            make_joint_state(self.robot, *values, timestamp_ns=self.timestamp_ns, **other)
        )

    def acquire(self, holder: str = "control", priority: int = 100) -> Answer:
        return self.authority.handle_lease_request(
            LeaseRequest(action="acquire", holder=holder, priority=priority), self.now_ns
        )

    def send(self, target: Any = 0.0, mode: Any = JointMode.POSITION, **other: Any) -> str | None:
        self.sequence += 1
        authority = self.authority
        values = {
            "sequence": self.sequence,
            "lease_epoch": authority.lease.epoch,
            "arm_session": authority.arm_session,
            **other,
        }
        values = {"tick": self.tick, **values}
        asked = make_joint_command(self.robot, target, mode, **values)
        return self.authority.process_command(asked, now_ns=self.now_ns, tick=self.tick, age_ns=0)

    def arm(self) -> Answer:
        return self.authority.handle_lifecycle_request(ARM, self.now_ns)

    def pass_tick(self, period_count: int = 1) -> TickOutput:
        self.now_ns += period_count * PERIOD_NS
        self.tick += period_count
        self.authority.latch_faults_and_expire_lease(self.now_ns, self.tick)
        return self.authority.compute_setpoints()

    def tick_with(self, *command: Any, **other: Any) -> TickOutput:
        """A command, and what is decided at the end of its tick."""
        self.send(*command, **other)
        return self.pass_tick()


def make_commanded_rig(
    target: Any = 0.1, mode: Any = JointMode.POSITION, **robot: Any
) -> AuthorityRig:
    """Not armed yet: its joints are at 0.1 rad, and a holder of the lease commands it."""
    rig = AuthorityRig(**robot)
    rig.observe(0.1)
    assert rig.acquire().ok
    assert rig.send(target, mode) is None
    return rig


def make_armed_rig(**robot: Any) -> AuthorityRig:
    rig = make_commanded_rig(**robot)
    assert rig.arm().ok
    return rig


def list_modes(decision: TickOutput) -> set[JointMode]:
    return set(decision.setpoints.mode)


def report_power(
    rig: AuthorityRig, motor_c: list[float], volts: float = 24.0, valid: list[bool] | None = None
) -> None:
    rig.authority.observe_power(make_power(motor_c, volts, valid=valid or True), rig.now_ns)
