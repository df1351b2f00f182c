"""Base class of the wires that are no interface of the kernel, so that the faults of their bus are injected here."""

from abc import ABC, abstractmethod

from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.bus.bus_faults import SendOutcome, VirtualFaults
from snakesim_can_backend.protocol.definitions import CanFrame


class FaultableWire(ABC):
    """One end of a bus, with injected faults between it and its caller. The other ends are not affected."""

    def __init__(self, channel: str) -> None:
        """Begin without faults.

        Args:
            channel: Name of the channel, for messages.
        """
        self.channel = channel
        self._faults = VirtualFaults(channel)

    @abstractmethod
    def _send_frame(self, frame: CanFrame) -> bool:
        """Send a frame, and return whether the bus accepted it."""

    @abstractmethod
    def _receive_frames(self) -> list[CanFrame]:
        """Return all received frames, in order."""

    def send(self, frame: CanFrame) -> bool:
        """Send a frame, and return whether the bus accepted it. An injected fault may reject or lose it."""
        if self._faults.active:
            match self._faults.simulate_send():
                case SendOutcome.REJECTED:
                    return False
                case SendOutcome.LOST:
                    return True
                case SendOutcome.SENT:
                    pass
        return self._send_frame(frame)

    def receive(self) -> list[CanFrame]:
        """Return all received frames, in order. An injected fault may lose them."""
        frames = self._receive_frames()
        if self._faults.active:
            return self._faults.filter_received(frames)
        return frames

    def errors(self) -> list[BusError]:
        """Return the injected errors since the last call."""
        return self._faults.pop_errors()

    def inject(self, kind: str, *, begins: bool) -> None:
        """Start or end a fault, as an interface of the kernel would have it."""
        self._faults.inject(kind, begins=begins)
