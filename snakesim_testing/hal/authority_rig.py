"""An authority with a clock, and the requests that its tests make."""

from typing import Any

from snakesim_hal.safety.authority import Authority, TickDecision
from snakesim_hal.safety.cables import Cables
from snakesim_hal.wire.messages import Answer, EstopRequest, LeaseRequest, LifecycleRequest, Mode
from snakesim_testing.hal.small_robots import PERIOD_NS, command, description, power, state

ROBOT = description()
JOINTS = len(ROBOT.joints)
ARM = LifecycleRequest(action="arm", robot="worm", backend="lag", config_hash=ROBOT.config_hash)
DISARM, CLEAR, FINISH = (LifecycleRequest(action=action) for action in ("disarm", "reset", "finish"))
ESTOP = EstopRequest(requester="a person")


class Rig:
    """An authority with a clock; every step is one a host would take."""

    def __init__(self, *, unchecked: str = "", cables: Cables | None = None, **robot: Any) -> None:
        self.robot = description(**robot)
        self.authority = Authority(self.robot, unchecked=unchecked, cables=cables)
        self.now_ns = 0
        self.tick = 0
        self.sequence = 0
        self.timestamp_ns = 0

    def observe(self, *values: Any, **other: Any) -> None:
        """A state so much later than the one before that the joints may have come from anywhere."""
        self.timestamp_ns += 10**9
        self.authority.observe(state(self.robot, *values, timestamp_ns=self.timestamp_ns, **other))

    def acquire(self, holder: str = "control", priority: int = 100) -> Answer:
        return self.authority.on_lease(LeaseRequest(action="acquire", holder=holder, priority=priority), self.now_ns)

    def send(self, target: Any = 0.0, mode: Any = Mode.POSITION, **other: Any) -> str | None:
        self.sequence += 1
        authority = self.authority
        values = {
            "sequence": self.sequence,
            "lease_epoch": authority.lease.epoch,
            "arm_session": authority.arm_session,
            **other,
        }
        values = {"tick": self.tick, **values}
        asked = command(self.robot, target, mode, **values)
        return self.authority.offer_command(asked, now_ns=self.now_ns, tick=self.tick, age_ns=0)

    def arm(self) -> Answer:
        return self.authority.on_lifecycle(ARM, self.now_ns)

    def pass_tick(self, periods: int = 1) -> TickDecision:
        self.now_ns += periods * PERIOD_NS
        self.tick += periods
        self.authority.check_deadlines(self.now_ns, self.tick)
        return self.authority.decide()

    def tick_with(self, *command: Any, **other: Any) -> TickDecision:
        """A command, and what is decided at the end of its tick."""
        self.send(*command, **other)
        return self.pass_tick()


def commanded(target: Any = 0.1, mode: Any = Mode.POSITION, **robot: Any) -> Rig:
    """Not armed yet: its joints are at 0.1 rad, and a holder of the lease commands it."""
    rig = Rig(**robot)
    rig.observe(0.1)
    assert rig.acquire().ok
    assert rig.send(target, mode) is None
    return rig


def armed(**robot: Any) -> Rig:
    rig = commanded(**robot)
    assert rig.arm().ok
    return rig


def modes(decision: TickDecision) -> set[Mode]:
    return set(decision.setpoints.mode)


def report_power(rig: Rig, motor_c: list[float], volts: float = 24.0, valid: list[bool] | None = None) -> None:
    rig.authority.observe_power(power(motor_c, volts, valid=valid or True), rig.now_ns)
