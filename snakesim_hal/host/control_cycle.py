"""One control cycle of a robot, without a clock, a thread or a network.

The HAL host, the environments and the contract suite all drive a robot through this object, so a backend sees the same
calls in the same order in each of them. Once in every tick, the caller

1. reads the sensors: `samples = cycle.sample(tick, timestamp_ns)`,
2. passes them to the safety core: `cycle.process_samples(samples, now_ns)`,
3. passes the commands that have arrived: `cycle.safety.process_command(...)`,
4. computes the setpoints: `output = cycle.compute_setpoints(now_ns, tick)`,
5. applies the setpoints to the motors: `cycle.enact(output)`,
6. lets one control period pass: `cycle.advance()`.

Every step may raise BackendError. The caller decides what follows from it.
"""

from typing import Generic, Protocol, TypeVar

from snakesim_hal.backend import Backend, Samples
from snakesim_hal.safety.authority import TickOutput
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, JointState, LifecycleState, Power


class SafetyCore(Protocol):
    """What decides on the setpoints: the authority, or a stand-in for an environment that has no limits."""

    @property
    def state(self) -> LifecycleState:
        """Return the lifecycle state."""
        ...

    def observe_joints(self, joints: JointState, now_ns: int) -> None:
        """Process the newest joint state."""
        ...

    def set_backend_obstacles(self, obstacles: list[str]) -> None:
        """Process the reasons of the backend why the robot cannot be armed now."""
        ...

    def observe_power(self, power: Power, now_ns: int) -> None:
        """Process the newest power sample."""
        ...

    def latch_faults_and_expire_lease(self, now_ns: int, tick: int) -> None:
        """Latch an expired lease, an implausible joint state and a power fault; free an expired lease."""
        ...

    def compute_setpoints(self, max_tick: int | None = None) -> TickOutput:
        """Return the setpoints of the next period."""
        ...

    def latch_fault(self, fault: Fault) -> None:
        """Latch a fault that the backend has reported."""
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

    def process_samples(self, samples: Samples, now_ns: int) -> None:
        """Pass the joint state, the power sample and the backend's obstacles to arming to the safety core.

        Args:
            samples: Samples of this tick.
            now_ns: Safety time in ns, in which leases and ages are measured.
        """
        self.safety.observe_joints(samples.joints, now_ns)
        self.safety.set_backend_obstacles(self.backend.list_arming_obstacles())
        power = samples.by_key.get(keys.POWER)
        if isinstance(power, Power):
            self.safety.observe_power(power, now_ns)

    def compute_setpoints(
        self, now_ns: int, tick: int, newest_command_tick: int | None = None
    ) -> TickOutput:
        """Latch new faults, and return the setpoints of the next period.

        Args:
            now_ns: Safety time in ns.
            tick: Current tick, which new faults name.
            newest_command_tick: In lockstep, the newest tick whose command may be used. None means the newest command.
        """
        self.safety.latch_faults_and_expire_lease(now_ns, tick)
        return self.safety.compute_setpoints(newest_command_tick)

    def enact(self, tick_output: TickOutput) -> None:
        """Hand the decided setpoints to the motors."""
        self.backend.enact(tick_output.setpoints, self.safety.state)

    def advance(self) -> list[Fault]:
        """Let one control period pass, latch the faults that the backend reports, and return them."""
        self.backend.advance()
        faults = self.backend.faults()
        for fault in faults:
            self.safety.latch_fault(fault)
        return faults
