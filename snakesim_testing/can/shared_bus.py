"""Runs the CAN driver and emulated joint modules in one process on one kernel interface.

Every frame passes through the kernel. The modules have a clock of their own, which advances only while the driver
waits. It stops at the end of each period. Thus neither a slow machine nor a slow `ip` command changes a test.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import inf

import pytest

from snakesim_can_backend.bus.bus import SocketCanWire
from snakesim_can_backend.driver import modules as driver
from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.server import EmulatorServer
from snakesim_can_backend.protocol.definitions import FROM_HOST, CanFrame, ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.shared_physics import make_physics_model
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_testing.can.driver_loop import DriverLoop, arm_and_wave, make_can_config

ANSWER_LIMIT_S = 2.0  # wall time; the clock of the modules ends the wait earlier
MAX_REST_SPEED_RAD_S = 0.05


class SharedWire(SocketCanWire):
    """The driver's connection to the bus. The modules run whenever the driver waits for frames."""

    def __init__(self, channel: str, server: EmulatorServer) -> None:
        super().__init__(channel)
        self.server = server
        self.now_ns = 0
        self.until_ns = inf  # the clock of the modules stops here
        self.sent: list[CanFrame] = []

    def send(self, frame: CanFrame) -> bool:
        was_sent = super().send(frame)
        if was_sent:
            self.sent.append(frame)
        return was_sent

    def idle(self) -> float | None:
        if self.now_ns >= self.until_ns:
            return None
        pause_s = self.server.run_due(self.now_ns)
        assert pause_s is not None
        self.now_ns = int(min(self.now_ns + pause_s * 1e9, self.until_ns))
        return 0.0


@dataclass
class SharedBus(DriverLoop):
    """A driver loop whose modules run until the end of each period."""

    # The states of the modules at the end of each tick.
    true_states_by_tick: dict[int, set[ModuleState]] = field(
        default_factory=dict[int, set[ModuleState]]
    )

    def run(
        self, ticks: int, compute_setpoints: Callable[[int], SafeSetpoints] | None = None
    ) -> None:
        """Run control cycles that last one period for the driver and for the modules."""
        for _ in range(ticks):
            self.wire.until_ns = self.wire.now_ns + self.config.period_ns
            super().run(1, compute_setpoints)
            while self.wire.idle() is not None:
                pass
            self.true_states_by_tick[self.tick] = set(self.read_true_states())

    def count_minor_errors(self, kind: str) -> int:
        """Return how often the driver counted an error of this kind that is no fault."""
        return self.backend.modules.monitor.minor_error_counts.get(kind, 0)

    @property
    def wire(self) -> SharedWire:
        (wire,) = self.backend.modules.wires
        assert isinstance(wire, SharedWire)
        return wire

    @property
    def physics_model(self) -> PhysicsModel:
        return self.wire.server.chain.physics_model

    def read_true_states(self) -> list[ModuleState]:
        """Return the states of the modules, whether or not the driver has received them."""
        return [slot.module.state for slot in self.wire.server.chain.slots]

    def is_at_rest(self) -> bool:
        """Return whether no joint moves."""
        speed_rad_s = abs(self.physics_model.velocity_rad_s)
        return bool((speed_rad_s < MAX_REST_SPEED_RAD_S).all())


@contextmanager
def open_shared_bus(channel: str) -> Iterator[SharedBus]:
    """Open a driver and emulated modules on one kernel bus, with all joints armed and moving, until the end.

    Args:
        channel: Name of the CAN interface.
    """
    run_config = make_can_config(clock_mode="realtime")
    settings = CanSettings(channels=[channel], physics_model="inertia")
    physics_model = make_physics_model(run_config, settings, "can")
    chain = ModuleChain(run_config, settings, physics_model, is_stepped=False)
    module_wire = SocketCanWire(channel, FROM_HOST)
    server = EmulatorServer([module_wire], chain)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "open_wire", lambda name, bit_rate: SharedWire(name, server))
        patch.setattr(driver, "compute_response_timeout_s", lambda *_: ANSWER_LIMIT_S)
        patch.setattr(driver, "FIRST_STATE_PAUSE_S", ANSWER_LIMIT_S)
        try:
            backend = CanBackend(run_config, settings)
            try:
                yield arm_and_wave(SharedBus(backend, run_config))
            finally:
                backend.close()
        finally:
            module_wire.close()
