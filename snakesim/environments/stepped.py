"""A robot that is stepped tick by tick: a backend behind the HAL's limiter, without host, services or network.

Lifecycle, lease, limits and the latency of commands are those of a run in lockstep, and so is the digest.
"""

import msgspec

from snakesim_hal.backend import Backend, Samples, Setpoints
from snakesim_hal.base.errors import BackendError, ConfigError, RefusedError
from snakesim_hal.faults.allowed import Faults, faults_of_host
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.fault_plan import planned
from snakesim_hal.model.plugins import BACKENDS, find_plugin
from snakesim_hal.model.scenario import RunConfig, Service
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.programs.preflight import backend_settings
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.safety.authority import Authority, Decision
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Fault,
    JointCommand,
    JointState,
    LeaseRequest,
    LifecycleState,
    Message,
    Mode,
    Power,
    request_to_arm,
)

WHO = "an environment"
INJECTED = ("joint", "bus", "simulator")  # faults that need neither services nor processes


class SteppedRobot:
    """A simulated robot, armed."""

    def __init__(self, config: RunConfig, *, safe: bool) -> None:
        """safe: behind the limiter; otherwise the motors get every target as it is, and nothing stops the robot.

        Raises ConfigError; RefusedError for a backend that moves something real, and when it cannot be armed.
        """
        for injection in planned(config):
            if injection.target_type not in INJECTED:
                raise ConfigError(
                    f"fault {str(injection)!r} is one of a {injection.target_type}: without a controller there are "
                    f"only faults of {', '.join(INJECTED)}; take action='residual:...', or leave it out"
                )
        config = _without_looking_around(config)
        factory = find_plugin(BACKENDS, config.backend)
        self._backend: Backend = factory(config, backend_settings(config, factory))
        self.description = self._backend.describe()
        if not self.description.emulated:
            self._backend.close()
            raise RefusedError(f"backend {config.backend!r} moves real hardware; environments are for simulated robots")
        self._faults: Faults | None = None
        if config.faults:
            session = LocalNetwork().session()
            self._backend, self._faults = faults_of_host(config, GuardedBackend(self._backend), session)
        self._period_ns = config.period_ns
        self._service = config.services.get(CONTROL, Service())
        self._black_box = BlackBox(self.description, memory_bytes=0)
        self._authority = Authority(self.description) if safe else None
        self._failed = ""
        self._tick = self._sequence = 0
        self._full_nm = [joint.torque_limit_nm for joint in self.description.joints]
        self.newest: dict[str, Message] = {}  # of every sensor besides the joints that has had a sample, by key
        self.limited: dict[int, str] = {}  # joint -> which limit changed its target in the last tick
        self._samples = self._sample()
        if self._authority is not None:
            self._arm(self._authority)

    @property
    def joints(self) -> JointState:
        """Of this tick."""
        return self._samples.joints

    @property
    def lifecycle(self) -> LifecycleState:
        """As a host would publish it."""
        if self._authority is not None:
            return self._authority.state
        return "fault" if self._failed else "armed"

    @property
    def why(self) -> str:
        """Why it is in this state."""
        return self._failed or ("no limiter" if self._authority is None else self._authority.why)

    @property
    def digest(self) -> str:
        """As `command_digest` of a run."""
        return self._black_box.command_digest

    def step(self, mode: Mode, target: list[float]) -> None:
        """One tick. A command for the present samples goes to the limiter, as the host would do it in lockstep."""
        decision = self._decided([mode] * len(target), target)
        self.limited = decision.limited
        self._black_box.record(self._tick, self._tick * self._period_ns, self._samples, decision)
        try:
            self._backend.enact(decision.setpoints, self.lifecycle)
            self._backend.advance()
            for fault in self._backend.faults():
                self._fault(fault)
            self._tick += 1
            self._samples = self._sample()
        except BackendError as error:
            self._fault(Fault(tick=self._tick, what="backend_failed", cause=str(error)[:500], reach="robot"))

    def close(self) -> None:
        """Close the backend."""
        self._backend.close()

    def _decided(self, modes: list[Mode], target: list[float]) -> Decision:
        authority = self._authority
        if authority is None:
            return Decision(Setpoints(modes, target, self._full_nm), None, {})
        if authority.state == "armed":
            self._offer(authority, modes, target)
        authority.expire(self._tick * self._period_ns, self._tick)
        return authority.decide(self._service.used_output_tick(self._tick + 1))

    def _sample(self) -> Samples:
        now_ns = self._tick * self._period_ns
        if self._faults is not None:
            arm_session = 1 if self._authority is None else self._authority.arm_session
            self._faults.turn(now_ns, arm_session, self.lifecycle)
        samples = self._backend.sample(self._tick, now_ns)
        self.newest.update(samples.others)
        if self._authority is not None:
            self._authority.observe(samples.joints, now_ns)
            if isinstance(power := samples.others.get(keys.POWER), Power):
                self._authority.observe_power(power, now_ns)
        return samples

    def _arm(self, authority: Authority) -> None:
        authority.on_lease(LeaseRequest(action="acquire", holder=CONTROL, priority=100), 0)
        self._offer(authority, [Mode.POSITION] * len(self._full_nm), list(self.joints.angle_rad))
        answer = authority.on_lifecycle(request_to_arm(self.description, WHO), 0)
        if not answer.ok:
            self._backend.close()
            raise RefusedError(f"not ready to arm: {answer.reason}")

    def _offer(self, authority: Authority, modes: list[Mode], target: list[float]) -> None:
        self._sequence += 1
        command = JointCommand(
            tick=self._tick,
            arm_session=authority.arm_session,
            sequence=self._sequence,
            lease_epoch=authority.lease.epoch,
            layout=self.description.layout,
            valid_for_ns=self.description.lease_ns,
            mode=modes,
            target=target,
            torque_limit_nm=self._full_nm,
        )
        authority.offer(command, now_ns=self._tick * self._period_ns, tick=self._tick, age_ns=0)

    def _fault(self, fault: Fault) -> None:
        if self._authority is not None:
            self._authority.fault(fault)
        elif fault.reach == "robot":
            self._failed = fault.cause


def _without_looking_around(config: RunConfig) -> RunConfig:
    """Without cameras and lidars, which nobody reads here. Each has noise of its own, so all else stays as it is."""
    sensors = msgspec.structs.replace(config.robot.sensors, depth=[], range=[])
    return msgspec.structs.replace(config, robot=msgspec.structs.replace(config.robot, sensors=sensors))
