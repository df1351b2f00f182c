"""One control cycle of a robot, without a clock, a thread or a network.

The HAL host, the environments and the contract suite all drive a robot through this object, so a backend sees the same
calls in the same order in each of them. Once in every tick, the caller

1. reads the sensors: `samples = cycle.sample(tick, timestamp_ns)`,
2. lets the safety core judge them: `cycle.observe(samples, now_ns)`,
3. offers the commands that have arrived: `cycle.safety.offer_command(...)`,
4. lets the safety core decide: `decision = cycle.decide(now_ns, tick)`,
5. hands the setpoints to the motors: `cycle.enact(decision)`,
6. lets one control period pass: `cycle.advance()`.

Every step may raise BackendError. The caller decides what follows from it.
"""

from typing import Generic, Protocol, TypeVar

from snakesim_hal.backend import Backend, Samples
from snakesim_hal.safety.authority import TickDecision
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, JointState, LifecycleState, Power


class SafetyCore(Protocol):
    """What decides on the setpoints: the authority, or a stand-in for an environment that has no limits."""

    @property
    def state(self) -> LifecycleState:
        """Return the lifecycle state."""
        ...

    def observe(self, joints: JointState, now_ns: int) -> None:
        """Take the newest joint state."""
        ...

    def observe_obstacles(self, obstacles: list[str]) -> None:
        """Take the reasons of the backend why the robot cannot be armed now."""
        ...

    def observe_power(self, power: Power, now_ns: int) -> None:
        """Take the newest power sample."""
        ...

    def check_deadlines(self, now_ns: int, tick: int) -> None:
        """Turn an expired lease, an implausible joint state and a power fault into faults."""
        ...

    def decide(self, up_to: int | None = None) -> TickDecision:
        """Return the setpoints of the next period."""
        ...

    def fault(self, fault: Fault) -> None:
        """Take a fault that the backend has reported."""
        ...


SafetyCoreT = TypeVar("SafetyCoreT", bound=SafetyCore)


class ControlCycle(Generic[SafetyCoreT]):
    """A backend behind a safety core, one tick at a time."""

    def __init__(self, backend: Backend, safety: SafetyCoreT) -> None:
        self.backend = backend
        self.safety = safety

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Read every sensor that is due at this tick."""
        return self.backend.sample(tick, timestamp_ns)

    def observe(self, samples: Samples, now_ns: int) -> None:
        """Let the safety core judge the samples.

        Args:
            samples: The samples of this tick.
            now_ns: Safety time, in which leases and ages count.
        """
        self.safety.observe(samples.joints, now_ns)
        self.safety.observe_obstacles(self.backend.list_arming_obstacles())
        power = samples.others.get(keys.POWER)
        if isinstance(power, Power):
            self.safety.observe_power(power, now_ns)

    def decide(self, now_ns: int, tick: int, newest_command_tick: int | None = None) -> TickDecision:
        """Return the setpoints of the next period.

        Args:
            now_ns: Safety time.
            tick: The present tick, which faults are stamped with.
            newest_command_tick: In lockstep, the newest tick whose command counts; None: the newest command counts.
        """
        self.safety.check_deadlines(now_ns, tick)
        return self.safety.decide(newest_command_tick)

    def enact(self, decision: TickDecision) -> None:
        """Hand the decided setpoints to the motors."""
        self.backend.enact(decision.setpoints, self.safety.state)

    def advance(self) -> list[Fault]:
        """Let one control period pass; return the faults that the backend reports, which the safety core has taken."""
        self.backend.advance()
        faults = self.backend.faults()
        for fault in faults:
            self.safety.fault(fault)
        return faults
