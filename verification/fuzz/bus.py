"""Sends invalid frames on a CAN bus while a driver opens the bus, arms its joint modules and drives them.

The driver and the emulated joint modules are real, on a virtual bus. An intruder, a third node, sends the frames. The
driver may report a fault, or raise BackendError when it opens the bus. It must not raise any other error, and it must
be possible to publish every sample.
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
from verification.fuzz.text_mutations import flip_bits

FRAMES_PER_TICK = 40
FRAMES_PER_OPENING = 2000  # until the driver opens the bus again
# In each such period, the robot is disarmed at one tick and armed again at another.
ARMING_PERIOD_TICKS = 20
DISARM_TICK = 10
ARM_TICK = 15
BRING_UP_LIMIT_S = 0.5
MAX_OVERHEARD_FRAMES = 2000
MAX_FRAME_BYTES = 8
MAX_STANDARD_ID = 0x7FF
NODE_MASK = (1 << NODE_BITS) - 1
UNUSUAL_IDS = (0x7FF, 0x800, 0x1FFFFFFF, 0xFC0)
VALID_CHECKSUM_PROBABILITY = 0.5
ROBOT = make_can_config(
    clock_mode="realtime", robot__sensors__contacts__rate_hz=50.0, robot__sensors__imu__rate_hz=50.0
)
MUTATIONS = ("again", "bit-flipped", "other node", "other message", "length", "random", "odd id")


class FrameMaker:
    """Makes frames from overheard ones. Half of those with a checksum get the right checksum again."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._overheard: list[CanFrame] = [
            CanFrame(0x080, bytes(5)),
            CanFrame(frame_id(Opcode.HEARTBEAT, 1), bytes(8)),
        ]

    def add_overheard(self, frame: CanFrame) -> None:
        """Make later frames from this one too, unless there are enough."""
        if len(self._overheard) < MAX_OVERHEARD_FRAMES:
            self._overheard.append(frame)

    def make_frame(self) -> tuple[str, CanFrame]:
        """Make the next frame, and return the name of its mutation with it."""
        rng = self._rng
        mutation = rng.choice(MUTATIONS)
        identifier, data = rng.choice(self._overheard)
        match mutation:
            case "bit-flipped" if data:
                data = flip_bits(rng, data)
            case "other node":
                identifier = identifier & ~NODE_MASK | rng.randrange(JOINT_COUNT + 2)
            case "other message":
                identifier = rng.choice(list(Opcode)) << NODE_BITS | rng.randrange(JOINT_COUNT + 2)
            case "length":
                padded = data + rng.randbytes(MAX_FRAME_BYTES)
                data = padded[: rng.randrange(MAX_FRAME_BYTES + 1)]
            case "random":
                identifier = rng.randrange(MAX_STANDARD_ID + 1)
                data = rng.randbytes(rng.randrange(MAX_FRAME_BYTES + 1))
            case "odd id":
                identifier = rng.choice(UNUSUAL_IDS)
            case _:
                pass
        if (
            data
            and rng.random() < VALID_CHECKSUM_PROBABILITY
            and parse_opcode(identifier) in WITH_CHECKSUM
        ):
            data = data[:-1] + bytes([checksum(identifier, data[:-1])])
        return mutation, CanFrame(identifier, data)


class BusIntruder:
    """A third node on the bus, which overhears frames and sends frames that are made from them."""

    def __init__(self, channel: str, maker: FrameMaker, counts: Counter[str]) -> None:
        """Join the bus.

        Args:
            channel: Name of the virtual bus.
            maker: Makes the frames.
            counts: Counts the frames by mutation.
        """
        self._bus = VirtualBus(channel=channel)
        self._maker = maker
        self._counts = counts

    def send_frames(self, frame_count: int, *, as_joint_modules: bool = False) -> None:
        """Send frames.

        Args:
            frame_count: The number of frames.
            as_joint_modules: Send only frames that a joint module of the robot could send. A driver that opens the bus
                takes others for those of another host or of an unknown node.
        """
        while (message := self._bus.recv(0)) is not None:
            self._maker.add_overheard(CanFrame(message.arbitration_id, bytes(message.data)))
        for _ in range(frame_count):
            mutation, frame = self._maker.make_frame()
            while as_joint_modules and not is_from_joint_module(frame.id):
                mutation, frame = self._maker.make_frame()
            self._counts[mutation] += 1
            self._bus.send(
                can.Message(
                    arbitration_id=frame.id,
                    data=frame.data,
                    is_extended_id=frame.id > MAX_STANDARD_ID,
                )
            )

    def leave(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


def is_from_joint_module(identifier: int) -> bool:
    """Return whether a joint module of the robot could have sent a frame with this identifier."""
    return parse_opcode(identifier) not in FROM_HOST and 1 <= parse_node(identifier) <= JOINT_COUNT


def fuzz_bus(frame_count: int, seed: int) -> Counter[str]:
    """Send invalid frames to a driver and its joint modules.

    Args:
        frame_count: The number of frames, rounded up to whole ticks.
        seed: Selects the frames.

    Returns:
        The number of frames by mutation, of openings, of refused openings, and of faults by kind.

    Raises:
        Exception: The driver or a joint module has raised what it must not.
    """
    counts: Counter[str] = Counter()
    maker = FrameMaker(random.Random(seed))
    sent_count = 0
    while sent_count < frame_count:
        remaining_count = min(FRAMES_PER_OPENING, frame_count - sent_count)
        try:
            with _open_driver(maker, counts) as (driver, intruder):
                for _ in range(remaining_count // FRAMES_PER_TICK + 1):
                    _run_tick(driver, intruder, counts)
                    sent_count += FRAMES_PER_TICK
        except BackendError:
            counts["refused at opening"] += 1
            sent_count += FRAMES_PER_TICK
    return counts


@contextmanager
def _open_driver(
    maker: FrameMaker, counts: Counter[str]
) -> Iterator[tuple[DriverLoop, BusIntruder]]:
    """Open a driver and an intruder on its bus. At every second opening, the intruder sends from the beginning."""
    intruders: list[BusIntruder] = []
    sends_while_opening = counts["openings"] % 2 == 1
    counts["openings"] += 1
    wait_for_idle = VirtualWire.idle

    def send_when_idle(wire: VirtualWire) -> float | None:
        if not intruders:
            intruders.append(BusIntruder(wire.channel, maker, counts))
        if sends_while_opening:
            intruders[0].send_frames(1, as_joint_modules=True)
        return wait_for_idle(wire)

    try:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(VirtualWire, "idle", send_when_idle)
            with open_driver_loop(ROBOT, bring_up_limit_s=BRING_UP_LIMIT_S) as driver:
                sends_while_opening = False
                yield driver, intruders[0]
    finally:
        for intruder in intruders:
            intruder.leave()


def _run_tick(driver: DriverLoop, intruder: BusIntruder, counts: Counter[str]) -> None:
    """Run one control cycle while the intruder sends, and check that its samples can be published."""
    tick_of_period = driver.tick % ARMING_PERIOD_TICKS
    if tick_of_period == DISARM_TICK:
        driver.lifecycle = "disarmed"
        driver.setpoints = None
    if tick_of_period == ARM_TICK:
        driver.lifecycle = "armed"
    intruder.send_frames(FRAMES_PER_TICK)
    fault_count_before = len(driver.faults)
    driver.run(1)
    counts.update(f"fault {fault.what}" for fault in driver.faults[fault_count_before:])
    samples = driver.samples[-1]
    for message in (samples.joints, *samples.by_key.values()):
        encoding = format_encoding(type(message))
        decoded = MessageDecoder(type(message)).decode(encode(message), encoding)
        assert decoded == message
    del driver.samples[:-1]
