"""Serves a chain of emulated joint modules on its buses: frames in, frames out, and time if it runs by the clock.

server = EmulatorServer(wires, chain)
while ...:
    pause_s = server.run_due(time.monotonic_ns())
    wait(wires, pause_s)
"""

import time
from collections.abc import Callable, Sequence

from snakesim_can_backend.bus.bus import VirtualWire, Wire
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.protocol.definitions import NODE_BITS, Frame, Opcode
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.emulated_body import make_physics_model
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.scenario import RunConfig

IN_STEP_US = 2000.0  # the physics model lags now by at most this, so that a Sync needs little computing
FINEST_US = 200.0  # frames are released in groups of this length, for fewer wake-ups


class EmulatorServer:
    """The far end of one or more buses, tail to head."""

    def __init__(self, wires: Sequence[Wire], chain: ModuleChain) -> None:
        if len(wires) != len(chain.modules_per_bus):
            raise ConfigError(f"{len(wires)} channels for modules on {len(chain.modules_per_bus)} buses")
        self.wires, self.chain = wires, chain
        self.unsent = 0  # frames that an interface did not accept
        self._start_ns: int | None = None

    def run_due(self, now_ns: int) -> float | None:
        """Handle received frames, send due ones; seconds until the next run is due. None: never."""
        arrived = [wire.receive() for wire in self.wires]
        if self.chain.stepped:
            for channel, frames in enumerate(arrived):
                for frame in frames:
                    self.chain.receive(channel, frame)
            self._send()
            return None
        if self._start_ns is None:
            self._start_ns = now_ns
        clock_us = (now_ns - self._start_ns) / 1000
        self._receive_in_time(arrived, clock_us)
        self.chain.advance_to(clock_us)
        self._send()
        now_us = self.chain.now_us
        wait_us = min(self.chain.next_us() - now_us, IN_STEP_US)
        return max(wait_us, FINEST_US) * 1e-6

    def _receive_in_time(self, arrived: Sequence[Sequence[Frame]], clock_us: float) -> None:
        """Handle frames at their estimated times of arrival.

        After a delay of this process several periods are in the queue: they are spread over the time that it took, so
        that a delay here does not look like a delay of the host.
        """
        before_us = self.chain.now_us + self.chain.skipped_us
        for channel, frames in enumerate(arrived):
            if not frames:
                continue
            syncs = sum(frame.id >> NODE_BITS == Opcode.SYNC for frame in frames)
            met = 0
            if not syncs:
                self.chain.advance_to(clock_us)
            for frame in frames:
                if frame.id >> NODE_BITS == Opcode.SYNC:
                    met += 1
                    self.chain.advance_to(before_us + (clock_us - before_us) * met / syncs)
                self.chain.receive(channel, frame)

    def _send(self) -> None:
        for channel, wire in enumerate(self.wires):
            for frame in self.chain.take_frames(channel):
                self.unsent += not wire.send(frame)


class InProcessEmulators:
    """Emulators in this process, at the other end of a virtual bus: calling it runs them."""

    def __init__(self, server: EmulatorServer, send_pose: PoseSender | None, clock_ns: Callable[[], int]) -> None:
        self.server = server
        self._send_pose, self._clock_ns = send_pose, clock_ns

    def __call__(self) -> float | None:
        """Handle received frames and send due ones; seconds until the next run is due, None for never."""
        return self.server.run_due(self._clock_ns())

    def inject(self, injection: Injection, *, begins: bool) -> None:
        """Begin or end a fault of a module."""
        self.server.chain.inject(injection, begins=begins)

    def close(self) -> None:
        """Close the bus."""
        for wire in self.server.wires:
            wire.close()
        if self._send_pose is not None:
            self._send_pose.close()


def make_local_emulators(
    config: RunConfig,
    settings: CanSettings,
    channel: str,
    pose: str | None = None,
    *,
    stepped: bool,
) -> InProcessEmulators:
    """All emulators of a run on one virtual bus; pose: address for poses, HOST:PORT. Raises ConfigError."""
    send_pose = None if pose is None else PoseSender(pose)
    physics_model = make_physics_model(config, settings, "can")
    chain = ModuleChain(config, settings, physics_model, stepped=stepped, send_pose=send_pose)
    return InProcessEmulators(EmulatorServer([VirtualWire(channel)], chain), send_pose, time.monotonic_ns)
