"""Emulated drives of a driver type, at the other end of their buses, on a body that a physics model moves."""

import contextlib
import struct
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

from snakesim_can_backend.bus.bus import Wire
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_drivers.emulation.emulated_body import DriveEmulator, EmulatedBody
from snakesim_drivers.kit.drive_settings import DriveSettings

NO_BROADCAST = -1  # no frame has this address


class CanEmulator(DriveEmulator):
    """All drives of a driver type on CAN. In all methods `i` is the index of a drive, from tail to head.

    A driver type implements the abstract methods, and `restart` and `on_step` of `DriveEmulator`. The thread that
    calls the emulator calls them while it holds the lock of the body.
    """

    broadcast_id: ClassVar[int] = NO_BROADCAST  # the address of frames that every drive receives

    def __init__(
        self, settings: DriveSettings, body: EmulatedBody, wires: Sequence[Wire], clock_ns: Callable[[], int]
    ) -> None:
        """Begin to receive.

        Args:
            settings: The settings of the driver type.
            body: The body that these drives move.
            wires: The bus of every drive; drives of one bus have the same object.
            clock_ns: A steady time, with any origin.
        """
        self.wires = list(wires)
        self.watchdog_us = settings.watchdog_s * 1e6
        self._index_of_node: dict[tuple[int, int], int] = {}  # by id() of the wire, and node
        for i, (wire, joint) in enumerate(zip(wires, body.joints, strict=True)):
            self._index_of_node[id(wire), joint.id] = i
        super().__init__(body, wires, clock_ns)

    @abstractmethod
    def find_addressee(self, frame: Frame) -> int:
        """Return the node that a frame is for."""

    @abstractmethod
    def handle_frame(self, i: int, frame: Frame) -> None:
        """Handle a frame that a drive receives.

        Raises:
            ValueError, LookupError, struct.error: the frame is malformed, and is ignored.
        """

    @abstractmethod
    def duplicate_frame(self, frame: Frame) -> Frame:
        """Return the frame that a second drive with the same id sends together with a frame of the first one.

        It gets the same commands, so that only its serial number differs.
        """

    def __call__(self) -> float | None:
        """Handle the frames that have arrived, and simulate up to the present time."""
        with self.body.lock:
            self._handle_arrivals()
        return None

    def send_frame(self, i: int, frame: Frame) -> None:
        """Send a frame of a drive, unless the drive is silent."""
        if self.body.is_silent(i):
            return
        self.wires[i].send(frame)
        if self.body.is_doubled(i):
            self.wires[i].send(self.duplicate_frame(frame))

    def _handle_arrivals(self) -> None:
        self.catch_up()
        for wire in self._ends:
            for frame in wire.receive():
                for i in self._find_receivers(wire, frame):
                    if self.body.is_booting(i):
                        continue
                    with contextlib.suppress(ValueError, LookupError, struct.error):
                        self.handle_frame(i, frame)
        self.pass_time()

    def _find_receivers(self, wire: Wire, frame: Frame) -> list[int]:
        node = self.find_addressee(frame)
        if node == self.broadcast_id:
            return [i for i, drive_wire in enumerate(self.wires) if drive_wire is wire]
        i = self._index_of_node.get((id(wire), node))
        return [] if i is None else [i]
