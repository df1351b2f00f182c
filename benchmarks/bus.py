"""The cost of a received CAN frame: the driver, against a bare loop and against plain python-can with cantools.

The frames go over vcan0 if the kernel has it. Otherwise they go over a pair of local sockets, which carry the same 16
bytes a frame; python-can cannot be measured there.
"""

import contextlib
import socket
import statistics
import struct
import time
from collections.abc import Callable, Iterator

import can

from benchmarks.table import RATIO_HEADER, format_row
from snakesim_can_backend.bus.bus import drain_socket, is_up
from snakesim_can_backend.bus.load import BIT_RATE, FRAME_BITS
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_database, load_layouts
from snakesim_can_backend.protocol.definitions import COUNTER_MODULUS, Opcode

JOINTS = 13
SYNCS = 400  # in one measurement
CHANNEL = "vcan0"
MAX_FRAMES_PER_S = BIT_RATE / (FRAME_BITS + 64)  # of frames with 64 data bits, without stuffing
RAW_FRAME = struct.Struct("<IB3x8s")  # the kernel's struct can_frame
JOINT_STATE_FIELDS = struct.Struct("<hhhBB")

ReceiveFrames = Callable[[int], int]  # count of the Sync -> number of frames that were received


def make_reports(sync: int) -> list[bytes]:
    """Return the reports of all joint modules after a Sync, as the kernel delivers them."""
    joint_state = load_layouts()[Opcode.JOINT_STATE]
    contact = load_layouts()[Opcode.CONTACT]
    count = sync % COUNTER_MODULUS
    frames = []
    for node in range(1, JOINTS + 1):
        frames.append(
            joint_state.encode(
                node, angle=0.1 * node, velocity=-0.2, torque=1.5, count=count, state=2
            )
        )
        frames.append(
            contact.encode(
                node, force_x=1.0, force_y=-20.0, along=0.05, bearing=1.0, touched=1, count=count
            )
        )
    return [RAW_FRAME.pack(frame.id, len(frame.data), frame.data) for frame in frames]


def report_frame_costs(report: Callable[[str], None], repeat_count: int) -> float:
    """Measure the driver and its references in turn, and report them as a table.

    Args:
        report: gets each line of the table.
        repeat_count: number of rounds.

    Returns:
        The cost of a frame in the driver, in µs.
    """
    on_vcan = is_up(CHANNEL)
    driver_us: list[float] = []
    bare_us: list[float] = []
    python_can_us: list[float] = []
    for _ in range(repeat_count):
        driver_us.append(_measure_frame_us(_make_driver_receiver))
        bare_us.append(_measure_frame_us(_make_bare_receiver))
        if on_vcan:
            python_can_us.append(_measure_python_can_us())
    carrier = CHANNEL if on_vcan else "a local socket pair"
    subject = f"driver: receive, check, decode and store a frame, on {carrier}"
    report(RATIO_HEADER)
    report(format_row(subject, "bare `recv_into` + `struct` loop", driver_us, bare_us, 3.0))
    if python_can_us:
        report(format_row(subject, "python-can + cantools", driver_us, python_can_us, 1.0))
    return statistics.median(driver_us)


@contextlib.contextmanager
def _open_socket_pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Open a sender and a receiver that does not block, on vcan0 or as a pair of local sockets."""
    if is_up(CHANNEL):
        sender, receiver = (
            socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) for _ in range(2)
        )
        sender.bind((CHANNEL,))
        receiver.bind((CHANNEL,))
    else:
        sender, receiver = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    receiver.setblocking(False)
    with sender, receiver:
        yield sender, receiver


def _measure_frame_us(make_receiver: Callable[[socket.socket], ReceiveFrames]) -> float:
    """Return the median cost of a frame, in µs. Only the receiving is timed."""
    with _open_socket_pair() as (sender, source):
        receive_frames = make_receiver(source)
        costs_us: list[float] = []
        for sync in range(SYNCS):
            for frame in make_reports(sync):
                sender.send(frame)
            begin_ns = time.perf_counter_ns()
            frame_count = receive_frames(sync)
            duration_ns = time.perf_counter_ns() - begin_ns
            costs_us.append(duration_ns / 1000 / frame_count)
        return statistics.median(costs_us)


def _make_driver_receiver(source: socket.socket) -> ReceiveFrames:
    """Return a function that receives as the driver does."""
    reports = ModuleReports(JOINTS)
    buffer = bytearray(RAW_FRAME.size)

    def receive_frames(sync: int) -> int:
        reports.start_sync(sync, has_contacts=True, has_tail_contact=False)
        frames = []
        drain_socket(source, buffer, frames, lambda _identifier, _data: None)
        for frame in frames:
            reports.process_frame(frame)
        assert reports.is_complete
        reports.shaft_values()
        return len(frames)

    return receive_frames


def _make_bare_receiver(source: socket.socket) -> ReceiveFrames:
    """Return a function that receives and decodes without any check."""
    buffer = bytearray(RAW_FRAME.size)
    decoded: dict[int, tuple[int, ...]] = {}

    def receive_frames(_sync: int) -> int:
        count = 0
        try:
            while True:
                source.recv_into(buffer)
                identifier, _length, data = RAW_FRAME.unpack(buffer)
                decoded[identifier] = JOINT_STATE_FIELDS.unpack(data)
                count += 1
        except BlockingIOError:
            return count

    return receive_frames


def _measure_python_can_us() -> float:
    """Return the median cost of a frame with python-can and cantools, used as their manuals show them, in µs."""
    database = load_database()
    decoded = {}
    costs_us: list[float] = []
    with _open_socket_pair() as (sender, _), can.Bus(interface="socketcan", channel=CHANNEL) as bus:
        for sync in range(SYNCS // 4):
            frames = make_reports(sync)
            for frame in frames:
                sender.send(frame)
            begin_ns = time.perf_counter_ns()
            for _ in frames:
                message = bus.recv(1.0)
                assert message is not None
                layout = database.get_message_by_frame_id(message.arbitration_id)
                decoded[message.arbitration_id] = layout.decode(bytes(message.data))
            duration_ns = time.perf_counter_ns() - begin_ns
            costs_us.append(duration_ns / 1000 / len(frames))
    return statistics.median(costs_us)


if __name__ == "__main__":  # for a virtual machine, where all other benchmarks take too long
    report_frame_costs(print, 3)
