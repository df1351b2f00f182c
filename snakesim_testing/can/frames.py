"""Frames as modules send them, and modules that answer Syncs with them."""

from collections.abc import Iterable
from typing import Any

from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import CanFrame, ModuleState, Opcode, parse_opcode


def joint_state(node_id: int, count: int, angle: float = 0.1, **other: float) -> CanFrame:
    values: dict[str, float] = {"state": ModuleState.DISARMED, **other}
    return load_layouts()[Opcode.JOINT_STATE].encode(
        node_id, angle=angle, count=count % 16, **values
    )


def heartbeat(
    node_id: int, uptime_s: float, state: ModuleState = ModuleState.DISARMED, **other: float
) -> CanFrame:
    return load_layouts()[Opcode.HEARTBEAT].encode(node_id, uptime=uptime_s, state=state, **other)


def contact(
    node_id: int, count: int, *, tail: bool = False, touched: bool = True, **other: float
) -> CanFrame:
    layout = load_layouts()[Opcode.TAIL_CONTACT if tail else Opcode.CONTACT]
    return layout.encode(node_id, count=count % 16, touched=touched, **other)


def gyro(node_id: int, count: int, rate_x: float) -> CanFrame:
    return load_layouts()[Opcode.GYRO].encode(node_id, rate_x=rate_x, count=count % 256)


def accelerometer(node_id: int, count: int, acceleration_z: float) -> CanFrame:
    return load_layouts()[Opcode.ACCELEROMETER].encode(
        node_id, acceleration_z=acceleration_z, count=count % 256
    )


def health(node_id: int, **values: float) -> CanFrame:
    return load_layouts()[Opcode.HEALTH].encode(node_id, **values)


def read(frame: CanFrame) -> dict[str, float]:
    """The values of its signals."""
    return dict(load_layouts()[Opcode(parse_opcode(frame.id))].decode(frame.data))


def corrupted(frame: CanFrame) -> CanFrame:
    """With a wrong checksum."""
    return CanFrame(frame.id, frame.data[:-1] + bytes((frame.data[-1] ^ 0x5A,)))


def begin(reading: ModuleReports, *, contacts: bool = False, tail: bool = False) -> int:
    """The next Sync goes out; its number."""
    reading.start_sync(reading.sync + 1, has_contacts=contacts, has_tail_contact=tail)
    return reading.sync


def answer(reading: ModuleReports, nodes: Iterable[int] | None = None, **values: Any) -> None:
    """Modules answer the newest Sync; all of them unless configured otherwise."""
    for node in range(1, len(reading.modules) + 1) if nodes is None else nodes:
        reading.process_frame(joint_state(node, reading.sync, **values))


def syncs(
    reading: ModuleReports, count: int, nodes: Iterable[int] | None = None, **values: Any
) -> None:
    """So many Syncs, answered by these nodes."""
    nodes = None if nodes is None else list(nodes)
    for _ in range(count):
        begin(reading)
        answer(reading, nodes, **values)
