"""Serves a chain of emulated joint modules on its buses: receives and sends frames, and advances wall-clock time.

server = EmulatorServer(wires, chain)
while ...:
    pause_s = server.run_due(time.monotonic_ns())
    wait(wires, pause_s)
"""

import time
from collections.abc import Callable, Sequence

from snakesim_can_backend.bus.bus import VirtualWire, Wire
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.protocol.definitions import NODE_BITS, CanFrame, Opcode
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.shared_physics import make_physics_model
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.scenario import RunConfig

# Of the physics model behind the present, so that a Sync needs little computing.
MAX_LAG_US = 2000.0
MIN_PAUSE_US = 200.0  # frames are released in groups of this length, for fewer wake-ups


class EmulatorServer:
    """The emulated modules' end of one or more buses, tail to head."""

    def __init__(self, wires: Sequence[Wire], chain: ModuleChain) -> None:
        """Connect a chain to its buses. Raises ConfigError if their numbers differ."""
        if len(wires) != len(chain.modules_per_bus):
            raise ConfigError(
                f"{len(wires)} channels for modules on {len(chain.modules_per_bus)} buses",
                code="bus/invalid-channel",
            )
        self.wires = wires
        self.chain = chain
        self.unsent = 0  # frames that an interface did not accept
        self._start_ns: int | None = None

    def run_due(self, now_ns: int) -> float | None:
        """Process received frames, advance the modules to the current time, and send the frames that are due.

        Args:
            now_ns: Current time of a steady clock; not used by a stepped chain.

        Returns:
            Seconds until the next run is due; None for a stepped chain, which only reacts to frames.
        """
        received = [wire.receive() for wire in self.wires]
        if self.chain.is_stepped:
            for channel, frames in enumerate(received):
                for frame in frames:
                    self.chain.receive(channel, frame)
            self._send()
            return None
        if self._start_ns is None:
            self._start_ns = now_ns
        clock_us = (now_ns - self._start_ns) / 1000
        self._receive_at_arrival_times(received, clock_us)
        self.chain.advance_to(clock_us)
        self._send()
        pause_us = min(self.chain.find_next_due_us() - self.chain.now_us, MAX_LAG_US)
        return max(pause_us, MIN_PAUSE_US) * 1e-6

    def _receive_at_arrival_times(
        self, received: Sequence[Sequence[CanFrame]], clock_us: float
    ) -> None:
        """Process received frames at their estimated times of arrival.

        After a delay of this process several periods are in the queue. They are spread over the time since the last
        run, so that a delay of this process does not look like a delay of the host.

        Args:
            received: Received frames of every bus, in order.
            clock_us: Current time since the start.
        """
        last_run_us = self.chain.now_us + self.chain.skipped_us
        for channel, frames in enumerate(received):
            if not frames:
                continue
            syncs = sum(_is_sync(frame) for frame in frames)
            if syncs == 0:
                self.chain.advance_to(clock_us)
            syncs_so_far = 0
            for frame in frames:
                if _is_sync(frame):
                    syncs_so_far += 1
                    self.chain.advance_to(
                        last_run_us + (clock_us - last_run_us) * syncs_so_far / syncs
                    )
                self.chain.receive(channel, frame)

    def _send(self) -> None:
        for channel, wire in enumerate(self.wires):
            for frame in self.chain.pop_frames(channel):
                if not wire.send(frame):
                    self.unsent += 1


def _is_sync(frame: CanFrame) -> bool:
    return frame.id >> NODE_BITS == Opcode.SYNC


class InProcessEmulators:
    """Emulators in this process, at the other end of a virtual bus: a call runs them."""

    def __init__(
        self, server: EmulatorServer, pose_sender: PoseSender | None, clock_ns: Callable[[], int]
    ) -> None:
        self.server = server
        self._send_pose = pose_sender
        self._clock_ns = clock_ns

    def __call__(self) -> float | None:
        """Process received frames and send due ones; return the seconds until the next run is due, None for never."""
        return self.server.run_due(self._clock_ns())

    def inject(self, injection: FaultInjection, *, begins: bool) -> None:
        """Start or end a fault of a module."""
        self.server.chain.inject(injection, begins=begins)

    def close(self) -> None:
        """Close the bus, and the sender of poses."""
        for wire in self.server.wires:
            wire.close()
        if self._send_pose is not None:
            self._send_pose.close()


def make_in_process_emulators(
    config: RunConfig,
    settings: CanSettings,
    channel: str,
    pose_address: str | None = None,
    *,
    is_stepped: bool,
) -> InProcessEmulators:
    """Create the emulators of all joint modules on one virtual bus, in this process.

    Args:
        config: Configuration of the run, with the robot.
        settings: Settings of the backend.
        channel: Name of the virtual bus, which the driver opens, too.
        pose_address: HOST:PORT to which they send motion capture; None if they do not send.
        is_stepped: Whether time advances only from Sync to Sync (for lockstep).

    Raises:
        ConfigError: The physics model is unknown, the address is malformed, or the settings name several buses, or
            an invalid fault or node id.
    """
    pose_sender = None if pose_address is None else PoseSender(pose_address)
    physics_model = make_physics_model(config, settings, "can")
    chain = ModuleChain(
        config, settings, physics_model, is_stepped=is_stepped, send_pose=pose_sender
    )
    server = EmulatorServer([VirtualWire(channel)], chain)
    return InProcessEmulators(server, pose_sender, time.monotonic_ns)
