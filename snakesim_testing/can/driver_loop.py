"""A driver and emulated joint modules on a virtual bus, stepped, with the lifecycle as the HAL host would have it."""

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

JOINTS = 4


def config(joint_count: int = JOINTS, **dotted: Any) -> RunConfig:
    """So many joints at 100 Hz, without an obstacle."""
    return make_run_config(
        **{"backend": "can", "robot__chain__modules": joint_count, "rate_hz": 100, **dotted}
    )


@dataclass
class DriverLoop:
    """Ticks of one run."""

    backend: CanBackend
    config: RunConfig
    lifecycle: LifecycleState = "disarmed"
    tick: int = 0
    samples: list[Samples] = field(default_factory=list[Samples])
    faults: list[Fault] = field(default_factory=list[Fault])
    wanted: SafeSetpoints | None = None
    # Of the fastest joint, at every tick.
    true_speed_rad_s: list[float] = field(default_factory=list[float])

    def run(self, ticks: int, wish: Callable[[int], SafeSetpoints] | None = None) -> None:
        """So many periods; a fault takes the robot out of `armed`, as the authority does."""
        for _ in range(ticks):
            samples = self.backend.sample(self.tick, self.tick * self.config.period_ns)
            self.samples.append(samples)
            self.true_speed_rad_s.append(float(np.abs(self.physics_model.velocity_rad_s).max()))
            if wish is not None:
                self.wanted = wish(self.tick)
            self.backend.enact(self.wanted or self.staying(samples), self.lifecycle)
            self.backend.advance()
            found = self.backend.faults()
            self.faults += found
            if found and self.lifecycle in ("armed", "disarmed"):
                self.lifecycle = "fault"
            self.tick += 1

    def arm(self, ticks: int = 8) -> None:
        """Arm, holding the pose, until every module is armed."""
        self.lifecycle = "armed"
        self.run(ticks)
        assert self.states() == [ModuleState.ARMED] * len(self.states()), self.faults

    def staying(self, samples: Samples) -> SafeSetpoints:
        """Every joint stays where it is."""
        angles = list(samples.joints.angle_rad)
        return SafeSetpoints([JointMode.POSITION] * len(angles), angles, [4.0] * len(angles))

    def waving(self, tick: int) -> SafeSetpoints:
        """Every joint swings by 0.3 rad at 1 Hz."""
        swing = 0.3 * np.sin(2 * np.pi * tick / 100)
        count = len(self.samples[-1].joints.angle_rad)
        return SafeSetpoints([JointMode.POSITION] * count, [float(swing)] * count, [4.0] * count)

    def states(self) -> list[ModuleState]:
        """The states that the modules reported last."""
        return [module.state for module in self.backend.modules.module_reports.modules]

    @property
    def physics_model(self) -> PhysicsModel:
        """What the emulators' motors move."""
        return chain_of(self.backend).physics_model


def chain_of(backend: CanBackend) -> ModuleChain:
    """The emulators at the other end of its virtual buses."""
    wire = backend.modules.wires[0]
    assert isinstance(wire, VirtualWire)
    assert isinstance(wire.peer, InProcessEmulators)
    return wire.peer.server.chain


@contextmanager
def loop(run: RunConfig | None = None, **settings: Any) -> Iterator[DriverLoop]:
    """Open, and close at the end."""
    run = run or config()
    backend = CanBackend(
        run, CanSettings(physics_model=settings.pop("physics_model", "inertia"), **settings)
    )
    try:
        yield DriverLoop(backend, run)
    finally:
        backend.close()


LoopT = TypeVar("LoopT", bound=DriverLoop)


def armed(run: LoopT) -> LoopT:
    """All joints swing, and nothing is wrong."""
    run.arm()
    run.run(12, run.waving)
    assert not run.faults
    return run


def cleared_and_armed_again(run: DriverLoop) -> None:
    """A person resets the fault and arms; nothing is left of it."""
    reported = len(run.faults)
    run.lifecycle = "disarmed"
    run.run(10)
    assert run.states() == [ModuleState.DISARMED] * 4
    run.wanted = None
    run.arm()
    run.run(10, run.waving)
    assert len(run.faults) == reported, run.faults[reported:]
