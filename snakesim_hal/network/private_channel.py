"""The private channel between a host and the process that started it: a socket pair without other access.

Over it the host sends its description and its status, and takes requests. So the starter knows, without
trusting anything on the network, which robot that is, its state, and that it is this one that is armed.
"""

import contextlib
import socket
from collections.abc import Callable

import msgspec

from snakesim_hal.base.workers import start_worker
from snakesim_hal.wire.messages import Answer, Description, LifecycleRequest, Status

MAX_BYTES = 1 << 18


class HostMessage(msgspec.Struct, frozen=True, kw_only=True):
    """A message of the host: one of these at a time."""

    description: Description | None = None
    status: Status | None = None
    answer: Answer | None = None


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Two ends with message boundaries: one for the starter, one to be inherited by the host."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class HostEnd:
    """The host's end. Never waits: messages that the starter does not read are lost."""

    def __init__(self, inherited: socket.socket | None) -> None:
        """inherited: None for a host that was started on its own."""
        self._socket = inherited

    @staticmethod
    def of(descriptor: int | None) -> "HostEnd":
        """From the inherited file descriptor."""
        return HostEnd(None if descriptor is None else socket.socket(fileno=descriptor))

    def say(self, message: HostMessage) -> None:
        """Send a message to the starter."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(msgspec.msgpack.encode(message), socket.MSG_DONTWAIT)

    def serve(self, take: Callable[[LifecycleRequest, Callable[[Answer], None]], None]) -> None:
        """Call `take(request, reply)` for each request, from a separate thread."""
        opened = self._socket
        if opened is None:
            return
        decoder = msgspec.msgpack.Decoder(LifecycleRequest)

        def listen() -> None:
            while True:
                try:
                    request = opened.recv(MAX_BYTES)
                except OSError:
                    return
                if not request:
                    return
                take(decoder.decode(request), lambda answer: self.say(HostMessage(answer=answer)))

        start_worker("private channel", listen)


class StarterEnd:
    """The starter's end: the last messages of its host."""

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        self._socket.setblocking(False)
        self._decoder = msgspec.msgpack.Decoder(HostMessage)
        self.description: Description | None = None
        self.status: Status | None = None
        self.answers: list[Answer] = []
        self.resets = 0  # how often another host has begun in the same process

    def take_in(self) -> None:
        """Read new messages."""
        while True:
            try:
                message = self._socket.recv(MAX_BYTES)
            except OSError:  # no message, or the host is gone
                return
            if not message:
                return
            said = self._decoder.decode(message)
            if said.description is not None and self.description is not None:  # it was reset
                self.status, self.resets = None, self.resets + 1
                self.answers.clear()
            self.description = said.description or self.description
            self.status = said.status or self.status
            if said.answer is not None:
                self.answers.append(said.answer)

    def ask(self, request: LifecycleRequest) -> None:
        """Send a request; the answer is appended to `answers`."""
        with contextlib.suppress(OSError):
            self._socket.send(msgspec.msgpack.encode(request))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
