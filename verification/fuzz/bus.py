"""Frames on a CAN bus that nobody should send, while a driver opens the bus, arms its modules and drives them.

Driver and emulated joint modules are the real ones, on a virtual bus; a third end of it sends. What may come of it is a
fault, or a BackendError when the bus is opened: never another exception, and nothing that cannot be published.
"""

import random
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import can
import pytest
from can.interfaces.virtual import VirtualBus

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.protocol.definitions import (
    FROM_HOST,
    NODE_BITS,
    WITH_CHECKSUM,
    CanFrame,
    Opcode,
    checksum,
    frame_id,
    parse_node,
    parse_opcode,
)
from snakesim_hal.base.errors import BackendError
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_testing.can.driver_loop import (
    JOINT_COUNT,
    DriverLoop,
    make_can_config,
    open_driver_loop,
)
from verification.fuzz.texts import flipped

PER_TICK = 40
PER_OPENING = 2000  # frames until the bus is opened again, with the stranger on it
ROBOT = make_can_config(
    clock_mode="realtime", robot__sensors__contacts__rate_hz=50.0, robot__sensors__imu__rate_hz=50.0
)
KINDS = ("again", "bit-flipped", "other node", "other message", "length", "random", "odd id")


class FrameMaker:
    """Frames like those that go over the bus, with something wrong; half of them with the right checksum again."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self.heard: list[CanFrame] = [
            CanFrame(0x080, bytes(5)),
            CanFrame(frame_id(Opcode.HEARTBEAT, 1), bytes(8)),
        ]

    def make(self) -> tuple[str, CanFrame]:
        """What was done, and the frame."""
        rng = self._rng
        kind, (identifier, data) = rng.choice(KINDS), rng.choice(self.heard)
        match kind:
            case "bit-flipped" if data:
                data = flipped(rng, data)
            case "other node":
                identifier = identifier & ~((1 << NODE_BITS) - 1) | rng.randrange(JOINT_COUNT + 2)
            case "other message":
                identifier = rng.choice(list(Opcode)) << NODE_BITS | rng.randrange(JOINT_COUNT + 2)
            case "length":
                data = (data + rng.randbytes(8))[: rng.randrange(9)]
            case "random":
                identifier, data = rng.randrange(0x800), rng.randbytes(rng.randrange(9))
            case "odd id":
                identifier = rng.choice((0x7FF, 0x800, 0x1FFFFFFF, 0xFC0))
            case _:
                pass
        if data and rng.random() < 0.5 and parse_opcode(identifier) in WITH_CHECKSUM:
            data = data[:-1] + bytes([checksum(identifier, data[:-1])])
        return kind, CanFrame(identifier, data)


class BusIntruder:
    """A third end of the bus."""

    def __init__(self, channel: str, maker: FrameMaker, words: Counter[str]) -> None:
        self.bus, self._maker, self._words = VirtualBus(channel=channel), maker, words

    def speak(self, frame_count: int, *, as_modules: bool = False) -> None:
        """Send so many; what was overheard meanwhile is what later ones are made of.

        as_modules: none that a driver takes for another host's or for a node that should not be there.
        """
        while (message := self.bus.recv(0)) is not None:
            if len(self._maker.heard) < 2000:
                self._maker.heard.append(CanFrame(message.arbitration_id, bytes(message.data)))
        for _ in range(frame_count):
            kind, (identifier, data) = self._maker.make()
            while as_modules and not is_from_module(identifier):
                kind, (identifier, data) = self._maker.make()
            self._words[kind] += 1
            self.bus.send(
                can.Message(arbitration_id=identifier, data=data, is_extended_id=identifier > 0x7FF)
            )


def is_from_module(identifier: int) -> bool:
    """Whether a module of the robot could have sent it."""
    return parse_opcode(identifier) not in FROM_HOST and 1 <= parse_node(identifier) <= JOINT_COUNT


def run(frame_count: int, seed: int) -> Counter[str]:
    """So many frames. Raises whatever driver or modules raise that they must not."""
    words: Counter[str] = Counter()
    maker = FrameMaker(random.Random(seed))
    sent = 0
    while sent < frame_count:
        try:
            with _opened(maker, words) as (run, stranger):
                for _ in range(min(PER_OPENING, frame_count - sent) // PER_TICK + 1):
                    _tick(run, stranger, words)
                    sent += PER_TICK
        except BackendError:
            words["refused at opening"] += 1
            sent += PER_TICK
    return words


@contextmanager
def _opened(maker: FrameMaker, words: Counter[str]) -> Iterator[tuple[DriverLoop, BusIntruder]]:
    """A driver on its bus, and the stranger; at every second opening he speaks from the beginning."""
    strangers: list[BusIntruder] = []
    early = words["openings"] % 2 == 1
    words["openings"] += 1
    idle = VirtualWire.idle

    def speaks_when_idle(wire: VirtualWire) -> float | None:
        if not strangers:
            strangers.append(BusIntruder(wire.channel, maker, words))
        if early:
            strangers[0].speak(1, as_modules=True)
        return idle(wire)

    try:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(VirtualWire, "idle", speaks_when_idle)
            with open_driver_loop(ROBOT, bring_up_limit_s=0.5) as run:
                early = False
                yield run, strangers[0]
    finally:
        for stranger in strangers:
            stranger.bus.shutdown()


def _tick(run: DriverLoop, stranger: BusIntruder, words: Counter[str]) -> None:
    """A period under fire; now and then somebody resets and arms."""
    if run.tick % 20 == 10:
        run.lifecycle, run.setpoints = "disarmed", None
    if run.tick % 20 == 15:
        run.lifecycle = "armed"
    stranger.speak(PER_TICK)
    reported = len(run.faults)
    run.run(1)
    words.update(f"fault {fault.what}" for fault in run.faults[reported:])
    samples = run.samples[-1]
    for message in (samples.joints, *samples.by_key.values()):
        assert (
            MessageDecoder(type(message)).decode(encode(message), format_encoding(type(message)))
            == message
        )
    del run.samples[:-1]
