"""What a received CAN frame costs: the driver, against a bare loop and against plain python-can with cantools.

On vcan0 where the kernel has it, else over a pair of local sockets that carry the same 16 bytes a frame; there
python-can cannot be measured.
"""

import contextlib
import socket
import statistics
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import can

from snakesim_can_backend.bus.bus import drain, is_up
from snakesim_can_backend.bus.load import BIT_RATE, FRAME_BITS
from snakesim_can_backend.driver.reports import Reading
from snakesim_can_backend.protocol.codec import codec, load_database
from snakesim_can_backend.protocol.definitions import COUNTS, Opcode

JOINTS = 13
SYNCS = 400
CHANNEL = "vcan0"
FULLEST_FRAMES_PER_S = BIT_RATE / (FRAME_BITS + 64)
RAW = struct.Struct("<IB3x8s")
WANTED = struct.Struct("<hhhBB")


@dataclass(frozen=True)
class FrameCosts:
    """Medians, in µs a frame."""

    on: str
    ours: list[float]
    bare: list[float]
    libraries: list[float]  # empty where they cannot be measured


def answers(sync: int) -> list[bytes]:
    """What all modules say to one Sync, as the kernel hands it over."""
    state, contact = codec()[Opcode.JOINT_STATE], codec()[Opcode.CONTACT]
    count = sync % COUNTS
    frames = []
    for node in range(1, JOINTS + 1):
        frames.append(state.frame(node, angle=0.1 * node, velocity=-0.2, torque=1.5, count=count, state=2))
        frames.append(contact.frame(node, force_x=1.0, force_y=-20.0, along=0.05, bearing=1.0, touched=1, count=count))
    return [RAW.pack(frame.id, len(frame.data), frame.data) for frame in frames]


def frame_costs(repeats: int) -> FrameCosts:
    """Measure all of them in turn."""
    on_vcan = is_up(CHANNEL)
    ours, bare, libraries = [], [], []
    for _ in range(repeats):
        ours.append(_cost(_driver))
        bare.append(_cost(_bare))
        if on_vcan:
            libraries.append(_libraries())
    return FrameCosts(CHANNEL if on_vcan else "a local socket pair", ours, bare, libraries)


def saturated_share(cost_us: float) -> float:
    """Share of one core that a bus full of 8-byte frames takes, none of them stuffed."""
    return cost_us * 1e-6 * FULLEST_FRAMES_PER_S


@contextlib.contextmanager
def _pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    if is_up(CHANNEL):
        ends = [socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) for _ in range(2)]
        for end in ends:
            end.bind((CHANNEL,))
    else:
        ends = list(socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))
    ends[1].setblocking(False)
    try:
        yield ends[0], ends[1]
    finally:
        for end in ends:
            end.close()


def _cost(receiver: Callable[[socket.socket], Callable[[int], int]]) -> float:
    """Median cost of a frame, in µs; only the receiving is timed."""
    with _pair() as (sender, source):
        receive = receiver(source)
        costs = []
        for sync in range(SYNCS):
            for frame in answers(sync):
                sender.send(frame)
            started = time.perf_counter_ns()
            got = receive(sync)
            costs.append((time.perf_counter_ns() - started) / 1000 / got)
        return statistics.median(costs)


def _driver(source: socket.socket) -> Callable[[int], int]:
    reading, buffer = Reading(JOINTS), bytearray(RAW.size)

    def receive(sync: int) -> int:
        reading.begin(sync, contacts=True, tail=False)
        frames = []
        drain(source, buffer, frames, lambda _identifier, _data: None)
        for frame in frames:
            reading.take(frame)
        assert reading.complete
        reading.joints()
        return len(frames)

    return receive


def _bare(source: socket.socket) -> Callable[[int], int]:
    buffer, store = bytearray(RAW.size), {}

    def receive(_sync: int) -> int:
        count = 0
        try:
            while True:
                source.recv_into(buffer)
                identifier, _length, data = RAW.unpack(buffer)
                store[identifier] = WANTED.unpack(data)
                count += 1
        except BlockingIOError:
            return count

    return receive


def _libraries() -> float:
    """python-can and cantools as their manuals show them."""
    database, store = load_database(), {}
    costs = []
    with _pair() as (sender, _), can.Bus(interface="socketcan", channel=CHANNEL) as bus:
        for sync in range(SYNCS // 4):
            frames = answers(sync)
            for frame in frames:
                sender.send(frame)
            started = time.perf_counter_ns()
            for _ in frames:
                message = bus.recv(1.0)
                assert message is not None
                decoded = database.get_message_by_frame_id(message.arbitration_id).decode(bytes(message.data))
                store[message.arbitration_id] = decoded
            costs.append((time.perf_counter_ns() - started) / 1000 / len(frames))
    return statistics.median(costs)


if __name__ == "__main__":  # for a VM, where everything else takes too long
    measured = frame_costs(3)
    print(f"on {measured.on}: driver {statistics.median(measured.ours):.1f} us a frame")
    for name, others in (("bare loop", measured.bare), ("python-can + cantools", measured.libraries)):
        if others:
            ratio = statistics.median(a / b for a, b in zip(measured.ours, others, strict=True))
            print(f"  {ratio:.2f} times the {name}")
