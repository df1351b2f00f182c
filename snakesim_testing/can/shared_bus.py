"""Driver and modules on one kernel interface and in one process, on a clock that passes while the driver waits.

Every frame goes through the kernel. Time is the modules': while the driver waits within a period, their clock goes on
to the period's end, and then it is paused. So it does not matter how slow this machine is, or how long `ip` takes.
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
from snakesim_testing.can.driver_loop import DriverLoop, armed, config

ANSWER_LIMIT_S = 2.0  # of this machine's time; the modules' ends the wait before


class SharedWire(SocketCanWire):
    """The driver's end. Whenever it waits, the modules at the other end live on."""

    def __init__(self, channel: str, server: EmulatorServer) -> None:
        super().__init__(channel)
        self.server = server
        self.now_ns = 0
        self.until_ns = inf  # the modules' clock stops here
        self.sent: list[CanFrame] = []

    def send(self, frame: CanFrame) -> bool:
        taken = super().send(frame)
        self.sent += [frame] * taken
        return taken

    def idle(self) -> float | None:
        if self.now_ns >= self.until_ns:
            return None
        pause_s = self.server.run_due(self.now_ns)
        assert pause_s is not None
        self.now_ns = int(min(self.now_ns + pause_s * 1e9, self.until_ns))
        return 0.0


@dataclass
class SharedBus(DriverLoop):
    """A loop whose modules have time until the end of each period."""

    # At ends of ticks.
    true_state_at: dict[int, set[ModuleState]] = field(default_factory=dict[int, set[ModuleState]])

    def run(self, ticks: int, wish: Callable[[int], SafeSetpoints] | None = None) -> None:
        """So many periods, each as long for the modules as for the driver."""
        for _ in range(ticks):
            self.wire.until_ns = self.wire.now_ns + self.config.period_ns
            super().run(1, wish)
            while self.wire.idle() is not None:
                pass
            self.true_state_at[self.tick] = set(self.true_states())

    def watch_seen(self, kind: str) -> int:
        """How often a error that is no fault was counted."""
        return self.backend.modules.monitor.minor_error_counts.get(kind, 0)

    @property
    def wire(self) -> SharedWire:
        (wire,) = self.backend.modules.wires
        assert isinstance(wire, SharedWire)
        return wire

    @property
    def physics_model(self) -> PhysicsModel:
        return self.wire.server.chain.physics_model

    def true_states(self) -> list[ModuleState]:
        """What the modules are, whether or not they can tell."""
        return [slot.module.state for slot in self.wire.server.chain.slots]

    def at_rest(self) -> bool:
        return bool((abs(self.physics_model.velocity_rad_s) < 0.05).all())


@contextmanager
def open_shared_bus(channel: str) -> Iterator[SharedBus]:
    """Open a driver and emulated modules on one kernel bus, with all joints armed and moving, until the end.

    Args:
        channel: Name of the CAN interface.
    """
    run_config = config(clock_mode="realtime")
    settings = CanSettings(channels=[channel], physics_model="inertia")
    module_wire = SocketCanWire(channel, FROM_HOST)
    server = EmulatorServer(
        [module_wire],
        ModuleChain(
            run_config, settings, make_physics_model(run_config, settings, "can"), is_stepped=False
        ),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "open_wire", lambda name, bit_rate: SharedWire(name, server))
        patch.setattr(driver, "compute_response_timeout_s", lambda *_: ANSWER_LIMIT_S)
        patch.setattr(driver, "FIRST_STATE_PAUSE_S", ANSWER_LIMIT_S)
        try:
            backend = CanBackend(run_config, settings)
            try:
                yield armed(SharedBus(backend, run_config))
            finally:
                backend.close()
        finally:
            module_wire.close()
