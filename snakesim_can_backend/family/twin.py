"""Emulated drives of a family, at the other end of their buses, on a body that a plant moves."""

import struct
from abc import abstractmethod
from collections.abc import Callable, Sequence

from snakesim_can_backend.bus.bus import Wire
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.drivers.drive_settings import DriveSettings
from snakesim_hal.drivers.twin_body import DriveTwin, TwinBody


class CanTwin(DriveTwin):
    """All drives of a family on CAN."""

    def __init__(
        self, settings: DriveSettings, body: TwinBody, wires: Sequence[Wire], clock_ns: Callable[[], int]
    ) -> None:
        """wires: of every joint; clock_ns: the time, since anything."""
        self.wires, self.watchdog_us = list(wires), settings.watchdog_s * 1e6
        nodes = (joint.id for joint in body.joints)
        self._at = {(id(wire), node): i for i, (wire, node) in enumerate(zip(wires, nodes, strict=True))}
        super().__init__(body, wires, clock_ns)

    @abstractmethod
    def addressee(self, frame: Frame) -> int:
        """The node that a frame is for."""

    @abstractmethod
    def take(self, i: int, frame: Frame) -> None:
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
                i = self._at.get((id(wire), self.addressee(frame)))
                if i is None or self.body.deaf(i):
                    continue
                try:
                    self.take(i, frame)
                except (ValueError, LookupError, struct.error):
                    continue
        self.pass_time()

    def say(self, i: int, frame: Frame) -> None:
        """A frame of a drive, unless it is silent."""
        if not self.body.silent(i):
            self.wires[i].send(frame)
