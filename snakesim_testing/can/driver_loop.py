"""Steps the CAN driver and emulated joint modules on a virtual bus, and controls the lifecycle as the HAL host does."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.server import InProcessEmulators
from snakesim_can_backend.protocol.definitions import ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.wire.messages import Fault, JointMode, LifecycleState
from snakesim_testing.hal.small_robots import make_run_config

JOINT_COUNT = 4
TORQUE_LIMIT_NM = 4.0
WAVE_AMPLITUDE_RAD = 0.3
WAVE_PERIOD_TICKS = 100  # 1 s


def make_can_config(joint_count: int = JOINT_COUNT, **dotted: Any) -> RunConfig:
    """Return the configuration of a run of the CAN backend at 100 Hz, without obstacles.

    Args:
        joint_count: Number of joints.
        **dotted: Further keys, with two underscores for each dot.
    """
    return make_run_config(
        **{"backend": "can", "robot__chain__modules": joint_count, "rate_hz": 100, **dotted}
    )


@dataclass
class DriverLoop:
    """Runs the control cycles of one driver, and keeps its samples and faults."""

    backend: CanBackend
    config: RunConfig
    lifecycle: LifecycleState = "disarmed"
    tick: int = 0
    samples: list[Samples] = field(default_factory=list[Samples])
    faults: list[Fault] = field(default_factory=list[Fault])
    # None: every joint holds its angle.
    setpoints: SafeSetpoints | None = None
    # The speed of the fastest joint, at every tick.
    true_speed_rad_s: list[float] = field(default_factory=list[float])

    def run(
        self, ticks: int, compute_setpoints: Callable[[int], SafeSetpoints] | None = None
    ) -> None:
        """Run control cycles. A fault takes the robot out of `armed`, as in the HAL host.

        Args:
            ticks: Number of control cycles.
            compute_setpoints: Returns the setpoints of a tick. None keeps the current setpoints.
        """
        for _ in range(ticks):
            samples = self.backend.sample(self.tick, self.tick * self.config.period_ns)
            self.samples.append(samples)
            self.true_speed_rad_s.append(float(np.abs(self.physics_model.velocity_rad_s).max()))
            if compute_setpoints is not None:
                self.setpoints = compute_setpoints(self.tick)
            self.backend.enact(self.setpoints or self.hold_angles(samples), self.lifecycle)
            self.backend.advance()
            new_faults = self.backend.faults()
            self.faults += new_faults
            if new_faults and self.lifecycle in ("armed", "disarmed"):
                self.lifecycle = "fault"
            self.tick += 1

    def arm(self, ticks: int = 8) -> None:
        """Arm the robot while its joints hold their angles, and check that every module is armed."""
        self.lifecycle = "armed"
        self.run(ticks)
        assert self.states() == [ModuleState.ARMED] * len(self.states()), self.faults

    def hold_angles(self, samples: Samples) -> SafeSetpoints:
        """Return setpoints that keep every joint at its measured angle."""
        return _make_position_setpoints(list(samples.joints.angle_rad))

    def wave_joints(self, tick: int) -> SafeSetpoints:
        """Return setpoints that swing every joint by 0.3 rad at 1 Hz."""
        angle_rad = WAVE_AMPLITUDE_RAD * np.sin(2 * np.pi * tick / WAVE_PERIOD_TICKS)
        joint_count = len(self.samples[-1].joints.angle_rad)
        return _make_position_setpoints([float(angle_rad)] * joint_count)

    def states(self) -> list[ModuleState]:
        """Return the state that each module reported last."""
        return [module.state for module in self.backend.modules.module_reports.modules]

    @property
    def physics_model(self) -> PhysicsModel:
        """The physics model that the motors of the emulated modules move."""
        return find_chain(self.backend).physics_model


def _make_position_setpoints(angles_rad: list[float]) -> SafeSetpoints:
    joint_count = len(angles_rad)
    return SafeSetpoints(
        [JointMode.POSITION] * joint_count, angles_rad, [TORQUE_LIMIT_NM] * joint_count
    )


def find_chain(backend: CanBackend) -> ModuleChain:
    """Return the emulated modules at the other end of a driver's virtual buses."""
    wire = backend.modules.wires[0]
    assert isinstance(wire, VirtualWire)
    assert isinstance(wire.peer, InProcessEmulators)
    return wire.peer.server.chain


@contextmanager
def open_driver_loop(run_config: RunConfig | None = None, **settings: Any) -> Iterator[DriverLoop]:
    """Open a CAN backend with emulated modules, and close it with the context.

    Args:
        run_config: Configuration of the run. None for that of `make_can_config`.
        **settings: Settings of the CAN backend.
    """
    run_config = run_config or make_can_config()
    backend = CanBackend(run_config, CanSettings(**{"physics_model": "inertia", **settings}))
    try:
        yield DriverLoop(backend, run_config)
    finally:
        backend.close()


LoopT = TypeVar("LoopT", bound=DriverLoop)


def arm_and_wave(loop: LoopT) -> LoopT:
    """Arm a robot, swing all its joints for 12 control cycles, and check that there is no fault."""
    loop.arm()
    loop.run(12, loop.wave_joints)
    assert not loop.faults
    return loop


def reset_and_arm_again(loop: DriverLoop) -> None:
    """Reset the fault and arm the robot, as an operator does, and check that no new fault appears."""
    fault_count = len(loop.faults)
    loop.lifecycle = "disarmed"
    loop.run(10)
    assert loop.states() == [ModuleState.DISARMED] * JOINT_COUNT
    loop.setpoints = None
    loop.arm()
    loop.run(10, loop.wave_joints)
    assert len(loop.faults) == fault_count, loop.faults[fault_count:]
