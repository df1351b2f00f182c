"""The stop by UDP, at the address of the robot's TCP endpoint: `SNAKSTOP`, 16 bytes of a nonce, and who asks."""

import contextlib
import os
import random
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

from verification.attack.command import address
from verification.attack.means.repeating import repeating

ASK, DONE = b"SNAKSTOP", b"SNAKDONE"
AGAIN_S = 0.05


def stop(who: str | bytes = "operator", nonce: bytes | None = None) -> bytes:
    """A datagram that stops the robot."""
    return (
        ASK
        + (os.urandom(16) if nonce is None else nonce)
        + (who.encode() if isinstance(who, str) else who)
    )


def ask(endpoint: str, datagram: bytes, limit_s: float) -> bytes | None:
    """Send it again and again until it is answered; the answer, or None."""
    deadline = time.monotonic() + limit_s
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.settimeout(AGAIN_S)
        while time.monotonic() < deadline:
            try:
                wire.sendto(datagram, address(endpoint))
                answer, sender = wire.recvfrom(65536)
            except OSError:  # refused: nobody listens there; or no answer yet
                time.sleep(AGAIN_S / 5)
                continue
            if sender == address(endpoint) and answer.startswith(DONE + datagram[8:24]):
                return answer
    return None


@contextmanager
def false_port(endpoint: str, *, knows_nonce: bool = True) -> Iterator[None]:
    """Somebody who answers stops at a robot's UDP port, where no robot is."""
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.bind(address(endpoint))
    wire.settimeout(0.1)

    def answer() -> None:
        with contextlib.suppress(TimeoutError):
            asked, sender = wire.recvfrom(2048)
            nonce = asked[8:24] if knows_nonce else bytes(16)
            wire.sendto(DONE + nonce + b"planar13\nstopped", sender)

    with wire, repeating(answer):
        yield


@contextmanager
def flood(endpoint: str) -> Iterator[list[int]]:
    """Noise, truncated and oversized stops, as fast as one thread can send."""
    dice, sent = random.Random(1), [0]
    nonce = bytes(16)
    shots = [
        *(dice.randbytes(size) for size in (0, 1, 8, 24, 100, 1400, 60_000)),
        *(stop(nonce=nonce)[:size] for size in (1, 7, 8, 9, 23)),
        b"snakstop" + nonce + b"x",
        DONE + nonce + b"done",
        b"SNAKSTOQ" + nonce,
    ]
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send() -> None:
        with contextlib.suppress(OSError):
            wire.sendto(dice.choice(shots), address(endpoint))
            sent[0] += 1

    with wire, repeating(send):
        yield sent
