"""The private channel between a host and the process that started it: a socket pair without other access.

Over it the host sends its description and its status, and takes requests. So the starter knows, without
trusting anything on the network, which robot that is, its state, and that it is this one that is armed.

Threads: any thread of the host may send with `HostEnd.send`; requests arrive in a thread of the channel. The starter
makes every call of `StarterEnd` from one thread.
"""

import contextlib
import socket
from collections.abc import Callable

import msgspec

from snakesim_hal.base.workers import start_restarting_thread
from snakesim_hal.wire.messages import Answer, LifecycleRequest, RobotDescription, RobotStatus

MAX_BYTES = 1 << 18


class HostMessage(msgspec.Struct, frozen=True, kw_only=True):
    """A message of the host, with one of these fields set."""

    description: RobotDescription | None = None
    status: RobotStatus | None = None
    answer: Answer | None = None


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Return two ends with message boundaries: one for the starter, one to be inherited by the host."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class HostEnd:
    """The host's end. Never waits: messages that the starter does not read are lost."""

    def __init__(self, inherited: socket.socket | None) -> None:
        """Use an inherited socket; None: the host was started on its own, and messages go nowhere."""
        self._socket = inherited

    @staticmethod
    def from_descriptor(descriptor: int | None) -> "HostEnd":
        """Return the end of an inherited file descriptor; None: the host was started on its own."""
        if descriptor is None:
            return HostEnd(None)
        return HostEnd(socket.socket(fileno=descriptor))

    def send(self, message: HostMessage) -> None:
        """Send a message to the starter. It is lost if the starter does not read."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(msgspec.msgpack.encode(message), socket.MSG_DONTWAIT)

    def start_serving(
        self, handle: Callable[[LifecycleRequest, Callable[[Answer], None]], None]
    ) -> None:
        """Start a thread that receives the requests of the starter. Does nothing if the host was started on its own.

        Args:
            handle: Function that is called as `handle(request, reply)` for each request. `reply` sends the answer.
        """
        channel = self._socket
        if channel is None:
            return
        decoder = msgspec.msgpack.Decoder(LifecycleRequest)

        def receive_requests() -> None:
            while True:
                try:
                    encoded_request = channel.recv(MAX_BYTES)
                except OSError:
                    return
                if not encoded_request:  # the starter has closed its end
                    return
                handle(
                    decoder.decode(encoded_request),
                    lambda answer: self.send(HostMessage(answer=answer)),
                )

        start_restarting_thread("private channel", receive_requests)


class StarterEnd:
    """The starter's end. It keeps the last messages of its host."""

    def __init__(self, opened: socket.socket) -> None:
        """Use an open socket; it never blocks from now on."""
        self._socket = opened
        self._socket.setblocking(False)
        self._decoder = msgspec.msgpack.Decoder(HostMessage)
        self.description: RobotDescription | None = None
        self.status: RobotStatus | None = None
        self.answers: list[Answer] = []
        self.resets = 0  # how often another host has started in the same process

    def receive(self) -> None:
        """Read all messages that have arrived, without waiting."""
        while True:
            try:
                data = self._socket.recv(MAX_BYTES)
            except OSError:  # no message, or the host has ended
                return
            if not data:
                return
            self._store(self._decoder.decode(data))

    def _store(self, message: HostMessage) -> None:
        """Keep the content of a message. A second description means that the host was reset."""
        if message.description is not None and self.description is not None:
            self.status = None
            self.resets += 1
            self.answers.clear()
        self.description = message.description or self.description
        self.status = message.status or self.status
        if message.answer is not None:
            self.answers.append(message.answer)

    def send_request(self, request: LifecycleRequest) -> None:
        """Send a request; the answer is appended to `answers`."""
        with contextlib.suppress(OSError):
            self._socket.send(msgspec.msgpack.encode(request))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
