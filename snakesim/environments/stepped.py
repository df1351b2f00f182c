"""A robot that is stepped tick by tick: a backend behind the HAL's limiter, without host, services or network.

Lifecycle, lease, limits and the latency of commands are those of a run in lockstep, and so is the digest. `armed` steps
many simulated robots at once with the same results; this is for any backend, and for injected faults.
"""

import msgspec

from snakesim.environments.limiter_client import LimiterClient
from snakesim_hal.backend import Backend, Samples
from snakesim_hal.base.errors import BackendError, ConfigError, RefusedError
from snakesim_hal.faults.allowed import InjectedFaults, create_host_faults
from snakesim_hal.host.control_cycle import ControlCycle
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.fault_plan import parse_planned_faults
from snakesim_hal.model.scenario import RunConfig, ServiceSchedule
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.programs.preflight import decode_backend_settings, load_backend_class
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.safety.authority import MAX_REASON_LENGTH
from snakesim_hal.wire.messages import (
    Fault,
    JointMode,
    JointState,
    LifecycleState,
    Message,
    RobotDescription,
)

# Faults of these need neither services nor processes.
SUPPORTED_FAULT_TARGETS = "joint", "bus", "simulator"


class SteppedRobot:
    """A simulated robot that is stepped alone. It is armed by the constructor."""

    def __init__(self, config: RunConfig, *, safe: bool) -> None:
        """Open the backend, read the first samples, and arm the robot.

        Args:
            config: Configuration of the run.
            safe: If True, targets pass the limiter. If False, motors get the targets unchanged, and no fault stops the
                robot.

        Raises:
            ConfigError: A planned fault needs a controller.
            RefusedError: The backend moves something real, or the robot cannot be armed.
        """
        _validate_planned_faults(config)
        config = _remove_cameras_and_lidars(config)
        backend = _open_simulated_backend(config)
        self.description: RobotDescription = backend.describe()
        self._faults: InjectedFaults | None = None
        if config.faults:
            session = LocalNetwork().create_session()
            backend, self._faults = create_host_faults(config, GuardedBackend(backend), session)
        self._backend = backend
        self._client = LimiterClient(self.description, safe=safe)
        self._cycle = ControlCycle(backend, self._client.core)

        self._period_ns = config.period_ns
        self._control_schedule = config.services.get(CONTROL, ServiceSchedule())
        self._black_box = BlackBox(self.description, memory_bytes=0)
        self._tick = 0
        # The newest sample of every sensor besides the joints, by key.
        self.newest_samples: dict[str, Message] = {}
        # Joint index -> which limit changed its target in the last tick.
        self.limit_by_joint: dict[int, str] = {}
        self._samples = self._read_samples()
        try:
            self._client.arm(self.joints)
        except RefusedError:
            self._backend.close()
            raise

    @property
    def joints(self) -> JointState:
        """The joint states of this tick."""
        return self._samples.joints

    @property
    def lifecycle(self) -> LifecycleState:
        """The lifecycle state, as a host would publish it."""
        return self._client.state

    @property
    def reason(self) -> str:
        """Why the robot is in this state."""
        return self._client.reason

    @property
    def digest(self) -> str:
        """The digest of all setpoints, as the `command_digest` of a run."""
        return self._black_box.command_digest

    def step(self, mode: JointMode, target: list[float]) -> None:
        """Run one tick: limit the command, step the backend, and read the sensors.

        The command answers the current samples, as in a host in lockstep. If the backend fails, the robot is stopped by
        a fault.

        Args:
            mode: Control mode of all joints.
            target: A target for each joint, tail to head, in rad, rad/s or N·m depending on the mode.
        """
        now_ns = self._tick * self._period_ns
        self._client.command(self._tick, now_ns, [mode] * len(target), target)
        decision = self._cycle.compute_setpoints(
            now_ns, self._tick, self._control_schedule.used_output_tick(self._tick + 1)
        )
        self.limit_by_joint = decision.limit_by_joint
        self._black_box.record_tick(self._tick, now_ns, self._samples, decision)
        try:
            self._cycle.enact(decision)
            self._cycle.advance()
            self._tick += 1
            self._samples = self._read_samples()
        except BackendError as error:
            fault = Fault(
                tick=self._tick,
                what="backend_failed",
                cause=str(error)[:MAX_REASON_LENGTH],
                scope="robot",
            )
            self._cycle.safety.latch_fault(fault)

    def close(self) -> None:
        """Close the backend."""
        self._backend.close()

    def _read_samples(self) -> Samples:
        """Read the sensors of this tick, and pass the samples to the safety core."""
        now_ns = self._tick * self._period_ns
        if self._faults is not None:
            self._faults.update(now_ns, self._client.arm_session, self.lifecycle)
        samples = self._cycle.sample(self._tick, now_ns)
        self.newest_samples.update(samples.by_key)
        self._cycle.process_samples(samples, now_ns)
        return samples


def _validate_planned_faults(config: RunConfig) -> None:
    """Raise ConfigError for a planned fault that needs a controller."""
    for injection in parse_planned_faults(config):
        if injection.target_type not in SUPPORTED_FAULT_TARGETS:
            raise ConfigError(
                f"fault {str(injection)!r} is one of a {injection.target_type}: without a controller there are "
                f"only faults of {', '.join(SUPPORTED_FAULT_TARGETS)}; take action='residual:...', or leave it out",
                code="injection/not-supported",
            )


def _open_simulated_backend(config: RunConfig) -> Backend:
    """Open the backend. Raises RefusedError, after closing it again, if it moves real hardware."""
    backend_type = load_backend_class(config.backend)
    backend = backend_type(config, decode_backend_settings(config, backend_type))
    if not backend.describe().emulated:
        backend.close()
        raise RefusedError(
            f"backend {config.backend!r} moves real hardware; environments are for simulated robots",
            code="robot/real-hardware",
        )
    return backend


def _remove_cameras_and_lidars(config: RunConfig) -> RunConfig:
    """Return the configuration without cameras and lidars, which nothing reads here.

    The noise of each sensor has a random stream of its own, so the noise of all other sensors stays the same.
    """
    sensors = msgspec.structs.replace(config.robot.sensors, depth=[], range=[])
    return msgspec.structs.replace(
        config, robot=msgspec.structs.replace(config.robot, sensors=sensors)
    )
