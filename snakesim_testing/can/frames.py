"""Makes CAN frames as joint modules send them, and lets modules answer the Syncs of a driver with these frames."""

from collections.abc import Iterable
from typing import Any

from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import CanFrame, ModuleState, Opcode, parse_opcode


def make_joint_state_frame(
    node_id: int, count: int, angle: float = 0.1, **signals: float
) -> CanFrame:
    """Return a joint state of a disarmed module in answer to the Sync with number `count`. The angle is in rad."""
    values: dict[str, float] = {"state": ModuleState.DISARMED, **signals}
    layout = load_layouts()[Opcode.JOINT_STATE]
    return layout.encode(node_id, angle=angle, count=count % 16, **values)


def make_heartbeat_frame(
    node_id: int, uptime_s: float, state: ModuleState = ModuleState.DISARMED, **signals: float
) -> CanFrame:
    """Return a heartbeat of a module that booted `uptime_s` ago."""
    layout = load_layouts()[Opcode.HEARTBEAT]
    return layout.encode(node_id, uptime=uptime_s, state=state, **signals)


def make_contact_frame(
    node_id: int, count: int, *, tail: bool = False, touched: bool = True, **signals: float
) -> CanFrame:
    """Return a contact of the link, or of the tail, in answer to the Sync with number `count`."""
    layout = load_layouts()[Opcode.TAIL_CONTACT if tail else Opcode.CONTACT]
    return layout.encode(node_id, count=count % 16, touched=touched, **signals)


def make_gyro_frame(node_id: int, count: int, rate_x_rad_s: float) -> CanFrame:
    """Return a measurement of the gyroscope in answer to the Sync with number `count`."""
    return load_layouts()[Opcode.GYRO].encode(node_id, rate_x=rate_x_rad_s, count=count % 256)


def make_accelerometer_frame(node_id: int, count: int, acceleration_z_m_s2: float) -> CanFrame:
    """Return a measurement of the accelerometer in answer to the Sync with number `count`."""
    layout = load_layouts()[Opcode.ACCELEROMETER]
    return layout.encode(node_id, acceleration_z=acceleration_z_m_s2, count=count % 256)


def make_health_frame(node_id: int, **signals: float) -> CanFrame:
    """Return a health report with these signals."""
    return load_layouts()[Opcode.HEALTH].encode(node_id, **signals)


def decode_signals(frame: CanFrame) -> dict[str, float]:
    """Return the values of the signals in a frame, by their names."""
    return dict(load_layouts()[Opcode(parse_opcode(frame.id))].decode(frame.data))


def corrupt_checksum(frame: CanFrame) -> CanFrame:
    """Return a copy of a frame whose checksum, its last byte, is wrong."""
    wrong_checksum = frame.data[-1] ^ 0x5A
    return CanFrame(frame.id, frame.data[:-1] + bytes((wrong_checksum,)))


def start_sync(reports: ModuleReports, *, contacts: bool = False, tail: bool = False) -> int:
    """Let the driver start its next Sync, and return the number of this Sync."""
    reports.start_sync(reports.sync + 1, has_contacts=contacts, has_tail_contact=tail)
    return reports.sync


def answer_sync(reports: ModuleReports, nodes: Iterable[int] | None = None, **signals: Any) -> None:
    """Let modules answer the newest Sync with their joint states.

    Args:
        reports: What the driver has received.
        nodes: Ids of the modules that answer. None for all modules.
        **signals: Values of the joint states.
    """
    if nodes is None:
        nodes = range(1, len(reports.modules) + 1)
    for node in nodes:
        reports.process_frame(make_joint_state_frame(node, reports.sync, **signals))


def run_syncs(
    reports: ModuleReports, count: int, nodes: Iterable[int] | None = None, **signals: Any
) -> None:
    """Start several Syncs, and let modules answer each of them. See `answer_sync`."""
    answering_nodes = None if nodes is None else list(nodes)
    for _ in range(count):
        start_sync(reports)
        answer_sync(reports, answering_nodes, **signals)
