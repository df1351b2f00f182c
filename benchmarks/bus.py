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

import can

from benchmarks.table import HEADER, row
from snakesim_can_backend.bus.bus import drain_socket, is_up
from snakesim_can_backend.bus.load import BIT_RATE, FRAME_BITS
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_database, load_layouts
from snakesim_can_backend.protocol.definitions import COUNTER_MODULUS, Opcode

JOINTS = 13
SYNCS = 400
CHANNEL = "vcan0"
FULLEST_FRAMES_PER_S = BIT_RATE / (FRAME_BITS + 64)
RAW = struct.Struct("<IB3x8s")
WANTED = struct.Struct("<hhhBB")


def answers(sync: int) -> list[bytes]:
    """What all modules say to one Sync, as the kernel hands it over."""
    state, contact = load_layouts()[Opcode.JOINT_STATE], load_layouts()[Opcode.CONTACT]
    count = sync % COUNTER_MODULUS
    frames = []
    for node in range(1, JOINTS + 1):
        frames.append(state.encode(node, angle=0.1 * node, velocity=-0.2, torque=1.5, count=count, state=2))
        frames.append(contact.encode(node, force_x=1.0, force_y=-20.0, along=0.05, bearing=1.0, touched=1, count=count))
    return [RAW.pack(frame.id, len(frame.data), frame.data) for frame in frames]


def say_frame_costs(say: Callable[[str], None], repeats: int) -> float:
    """Measure all of them in turn, and say it as a table. Returns what a frame costs the driver, in µs."""
    on_vcan = is_up(CHANNEL)
    ours, bare, libraries = [], [], []
    for _ in range(repeats):
        ours.append(_cost(_driver))
        bare.append(_cost(_bare))
        if on_vcan:
            libraries.append(_libraries())
    what = f"driver: receive, check, decode and store a frame, on {CHANNEL if on_vcan else 'a local socket pair'}"
    say(HEADER)
    say(row(what, "bare `recv_into` + `struct` loop", ours, bare, 3.0))
    if libraries:
        say(row(what, "python-can + cantools", ours, libraries, 1.0))
    return statistics.median(ours)


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
    reading, buffer = ModuleReports(JOINTS), bytearray(RAW.size)

    def receive(sync: int) -> int:
        reading.begin_sync(sync, contacts=True, tail=False)
        frames = []
        drain_socket(source, buffer, frames, lambda _identifier, _data: None)
        for frame in frames:
            reading.process_frame(frame)
        assert reading.complete
        reading.shaft_values()
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
    say_frame_costs(print, 3)
