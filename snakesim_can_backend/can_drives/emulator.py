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


class CanEmulator(DriveEmulator):
    """All drives of a driver type on CAN."""

    everybody: ClassVar[int] = -1  # the address of frames that every drive takes; -1: there is none

    def __init__(
        self, settings: DriveSettings, body: EmulatedBody, wires: Sequence[Wire], clock_ns: Callable[[], int]
    ) -> None:
        """wires: of every joint; clock_ns: the time, since anything."""
        self.wires, self.watchdog_us = list(wires), settings.watchdog_s * 1e6
        nodes = (joint.id for joint in body.joints)
        self._at = {(id(wire), node): i for i, (wire, node) in enumerate(zip(wires, nodes, strict=True))}
        super().__init__(body, wires, clock_ns)

    @abstractmethod
    def find_addressee(self, frame: Frame) -> int:
        """The node that a frame is for."""

    @abstractmethod
    def handle_frame(self, i: int, frame: Frame) -> None:
        """A frame to a drive. ValueError, LookupError, struct.error: malformed."""

    def __call__(self) -> float | None:
        """Handle what has arrived, and let time pass up to now."""
        with self.body.lock:
            self._act()
        return None

    def _act(self) -> None:
        self.catch_up()
        for wire in self._ends:
            for frame in wire.receive():
                for i in self._addressees(wire, frame):
                    if self.body.is_booting(i):
                        continue
                    with contextlib.suppress(ValueError, LookupError, struct.error):
                        self.handle_frame(i, frame)
        self.pass_time()

    @abstractmethod
    def duplicate_frame(self, frame: Frame) -> Frame:
        """What a second drive with the same id sends beside a frame of the first one.

        It gets the same commands, so only its serial number is its own.
        """

    def _addressees(self, wire: Wire, frame: Frame) -> list[int]:
        node = self.find_addressee(frame)
        if node == self.everybody:
            return [i for i, one in enumerate(self.wires) if one is wire]
        i = self._at.get((id(wire), node))
        return [] if i is None else [i]

    def say(self, i: int, frame: Frame) -> None:
        """A frame of a drive, unless it is silent."""
        if self.body.is_silent(i):
            return
        self.wires[i].send(frame)
        if self.body.is_doubled(i):
            self.wires[i].send(self.duplicate_frame(frame))
