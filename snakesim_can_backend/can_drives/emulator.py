"""Emulated drives of a driver type, at the other end of their buses, on a body that a physics model moves."""

import contextlib
import struct
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from snakesim_can_backend.bus.bus import Wire
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.emulation.drive_emulator import DriveEmulator
from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_hal.model.robot_file.joints import Joint

NO_BROADCAST = -1  # no frame has this address


@dataclass(frozen=True)
class CanEmulatorContext:
    """What a driver type gets to emulate its drives."""

    joints: Sequence[Joint]  # of the driver type, as the robot file describes them
    settings: Any  # an instance of the driver type's own `Settings`
    body: EmulatedBody  # moved by these drives; it has the same joints as they are in truth
    wires: Sequence[Wire]  # the bus of every drive; drives of one bus have the same object
    clock_ns: Callable[[], int]  # a steady time, with any origin


class CanEmulator(DriveEmulator[Wire]):
    """All drives of a driver type on CAN. In all methods `i` is the index of a drive, from tail to head.

    A driver type implements the abstract methods, and `restart` and `on_step` of `DriveEmulator`. The thread that
    calls the emulator calls them while it holds the lock of the body.
    """

    broadcast_id: ClassVar[int] = NO_BROADCAST  # the address of frames that every drive receives

    def __init__(self, context: CanEmulatorContext) -> None:
        """Start to simulate the drives and to receive frames on their buses."""
        body = context.body
        self.wires = list(context.wires)
        self.watchdog_us = context.settings.watchdog_s * 1e6
        self._index_by_node_id: dict[tuple[int, int], int] = {}  # by id() of the wire, and node
        for i, (wire, joint) in enumerate(zip(self.wires, body.joints, strict=True)):
            self._index_by_node_id[id(wire), joint.id] = i
        super().__init__(body, self.wires, context.clock_ns)

    @abstractmethod
    def find_destination_node(self, frame: CanFrame) -> int:
        """Return the node that a frame is for."""

    @abstractmethod
    def handle_frame(self, i: int, frame: CanFrame) -> None:
        """Handle a frame that a drive receives.

        Raises:
            ValueError, LookupError, struct.error: The frame is malformed, and is ignored.
        """

    @abstractmethod
    def duplicate_frame(self, frame: CanFrame) -> CanFrame:
        """Return the frame that a second drive with the same id sends together with a frame of the first one.

        It gets the same commands, so that only its serial number differs.
        """

    def __call__(self) -> float | None:
        """Handle the frames that have arrived, and simulate up to the current time."""
        with self.body.lock:
            self._handle_received_frames()
        return None

    def send_frame(self, i: int, frame: CanFrame) -> None:
        """Send a frame of a drive, unless the drive is silent; twice if an injected fault duplicates the drive."""
        if self.body.is_silent(i):
            return
        self.wires[i].send(frame)
        if self.body.is_duplicated(i):
            self.wires[i].send(self.duplicate_frame(frame))

    def _handle_received_frames(self) -> None:
        self.catch_up()
        for wire in self._bus_ends:
            for frame in wire.receive():
                for i in self._find_receiving_drives(wire, frame):
                    if self.body.is_booting(i):
                        continue
                    with contextlib.suppress(ValueError, LookupError, struct.error):
                        self.handle_frame(i, frame)
        self.simulate_to_now()

    def _find_receiving_drives(self, wire: Wire, frame: CanFrame) -> list[int]:
        """Return the indices of the drives on a bus that a frame is for: one drive, all after a broadcast, or none."""
        node = self.find_destination_node(frame)
        if node == self.broadcast_id:
            return [i for i, drive_wire in enumerate(self.wires) if drive_wire is wire]
        i = self._index_by_node_id.get((id(wire), node))
        return [] if i is None else [i]
