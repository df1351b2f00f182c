"""Bus load of a configuration, in bits; refuses one that does not fit.

A classic frame with an 11-bit id and n bytes takes 47 + 8 n bits: start, id, control, data, CRC, acknowledge, end and
the gap to the next. After five equal bits the sender stuffs one in between; at worst that adds one for every four of
the 34 + 8 n bits that can be stuffed. All loads here are worst cases.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import HEALTH_PERIOD_S, HEARTBEAT_PERIOD_S, LAST_NODE, Opcode
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import RunConfig

BIT_RATE = 1_000_000
MAX_LOAD = 0.8
MAX_EVERY = 255  # Syncs; limit of the parameters
MIN_RATE_HZ = 20
FRAME_BITS = 47
STUFFED_FROM = 34
FD_START, FD_END = 36, 13  # bits of CAN FD with an id of 29: up to the switch of rates, and after the CRC


def format_bit_rate(bit_rate: int) -> str:
    """In words."""
    return f"{bit_rate / 1e6:g} Mbit/s"


def worst_frame_bits(length: int) -> int:
    """Bits of a frame with `length` bytes, with the maximum of stuff bits."""
    return FRAME_BITS + 8 * length + (STUFFED_FROM + 8 * length - 1) // 4


def worst_frame_s(length: int, bit_rate: int, data_bit_rate: int | None = None) -> float:
    """Time of a frame, at worst-case stuffing; with a second bit rate, of CAN FD with an id of 29 bits.

    There identifier and end go at the first rate; length, data and CRC at the second. Its CRC has 17 bits, or 21 above
    16 bytes, with the count of stuff bits before it and a fixed stuff bit for every four.
    """
    if data_bit_rate is None:
        return worst_frame_bits(length) / bit_rate
    crc = 4 + (17 if length <= 16 else 21)
    data = 5 + 8 * length
    slow, fast = FD_START + (FD_START - 1) // 4 + FD_END, data + data // 4 + crc + ceil(crc / 4)
    return slow / bit_rate + fast / data_bit_rate


@dataclass(frozen=True)
class ReportSchedule:
    """Which reports are sent, and how often."""

    rate_hz: float
    contact_every: int = 1  # Syncs; 0: never
    imu_every: int = 20
    tail: bool = True  # a module on the bus sends TailContact
    bit_rate: int = BIT_RATE


@dataclass(frozen=True)
class Stream:
    """One kind of frame on one bus."""

    opcode: Opcode
    frames_per_s: float

    @property
    def bits_per_s(self) -> float:
        """Worst case."""
        return self.frames_per_s * worst_frame_bits(load_layouts()[self.opcode].length)


def list_streams(joints: int, reports: ReportSchedule) -> list[Stream]:
    """All frames on a bus with this many joints while the robot runs."""
    rate = reports.rate_hz
    contacts = rate / reports.contact_every if reports.contact_every else 0.0
    imus = rate / reports.imu_every if reports.imu_every else 0.0
    return [
        Stream(Opcode.SYNC, rate),
        Stream(Opcode.SET_POINT, joints * rate),
        Stream(Opcode.JOINT_STATE, joints * rate),
        Stream(Opcode.CONTACT, joints * contacts),
        Stream(Opcode.TAIL_CONTACT, contacts if reports.tail else 0.0),
        Stream(Opcode.GYRO, joints * imus),
        Stream(Opcode.ACCELEROMETER, joints * imus),
        Stream(Opcode.SHAFT_LOAD, joints * imus),
        Stream(Opcode.HEARTBEAT, joints / HEARTBEAT_PERIOD_S),
        Stream(Opcode.HEALTH, joints / HEALTH_PERIOD_S),
    ]


def bus_load(joints: int, reports: ReportSchedule) -> float:
    """Worst-case load of a bus, as a share of its time."""
    return sum(stream.bits_per_s for stream in list_streams(joints, reports)) / reports.bit_rate


def busiest_period_s(joints: int, reports: ReportSchedule) -> float:
    """Bus time of one period in which forces are reported: Sync, all answers, all setpoints, at worst."""
    once = list_streams(joints, ReportSchedule(1.0, min(reports.contact_every, 1), 0, reports.tail))
    each_period = (Opcode.SYNC, Opcode.SET_POINT, Opcode.JOINT_STATE, Opcode.CONTACT, Opcode.TAIL_CONTACT)
    return sum(stream.bits_per_s for stream in once if stream.opcode in each_period) / reports.bit_rate


def is_feasible(joints: int, reports: ReportSchedule) -> bool:
    """Whether a bus can carry this many joints, on average and in the longest period."""
    return bus_load(joints, reports) <= MAX_LOAD and busiest_period_s(joints, reports) * reports.rate_hz <= 1


def syncs_per_report(rate_hz: float, wanted_hz: float) -> int:
    """Number of Syncs between reports at about `wanted_hz`; 0 for never."""
    return 0 if wanted_hz <= 0 else round(min(max(rate_hz / wanted_hz, 1.0), MAX_EVERY))


def plan_reports(config: RunConfig, settings: CanSettings) -> ReportSchedule:
    """The reports of a run's modules, and how often."""
    return plan_reports_at(config.rate_hz, config, settings)


def plan_reports_at(rate_hz: float, config: RunConfig, settings: CanSettings) -> ReportSchedule:
    """The same for another control rate: rates in Hz are converted to Syncs."""
    sensors = config.robot.sensors
    contact_hz = 0.0
    if sensors.contacts is not None:
        contact_hz = sensors.contacts.rate_hz if settings.contact_rate_hz is None else settings.contact_rate_hz
    imu_hz = min(settings.imu_rate_hz, sensors.imu.rate_hz) if sensors.imu is not None else 0.0
    return ReportSchedule(
        rate_hz, syncs_per_report(rate_hz, contact_hz), syncs_per_report(rate_hz, imu_hz), bit_rate=settings.bit_rate
    )


def joints_per_bus(config: RunConfig, settings: CanSettings) -> list[int]:
    """Number of joints of each bus, tail to head. Raises ConfigError."""
    joints, buses = config.robot.chain.modules, max(len(settings.channels), 1)
    if len(set(settings.channels)) < len(settings.channels):
        raise ConfigError(f"`backends.can.channels` = {settings.channels} names a channel twice")
    if joints > LAST_NODE:
        raise ConfigError(
            f"robot {config.robot.name!r} has {joints} joints; node ids of protocol version 1 go to {LAST_NODE}"
        )
    given = settings.joints_per_channel
    if given and (len(given) != buses or sum(given) != joints):
        raise ConfigError(
            f"`backends.can.joints_per_channel` = {given} must be {buses} numbers that add up to the {joints} joints "
            f"of robot {config.robot.name!r}"
        )
    if buses > joints:
        raise ConfigError(f"`backends.can.channels` names {buses} channels for {joints} joints")
    return list(given) or [joints // buses + (i < joints % buses) for i in range(buses)]


def check_load(config: RunConfig, settings: CanSettings) -> list[float]:
    """The load of every bus. Raises ConfigError, with the sum and alternatives that fit, when one is too high.

    Too high is more than `MAX_LOAD` of the time, or a single period that is too long.
    """
    buses = plan_buses(config, settings)
    joints, loads = [count for count, _ in buses], [bus_load(*bus) for bus in buses]
    worst = max(range(len(loads)), key=lambda i: loads[i])
    if loads[worst] > MAX_LOAD:
        raise ConfigError(
            f"{joints[worst]} joints at {config.rate_hz:g} Hz do not fit on {_name(settings, worst)}:",
            *explain_load(*buses[worst]),
            suggest_alternatives(joints, config, settings),
        )
    longest = max(range(len(buses)), key=lambda i: busiest_period_s(*buses[i]))
    needed_s = busiest_period_s(*buses[longest])
    if needed_s * config.rate_hz > 1:
        raise ConfigError(
            f"{joints[longest]} joints at {config.rate_hz:g} Hz do not fit on {_name(settings, longest)}: a period "
            f"with force reports takes {needed_s * 1000:.2f} ms of bus time and lasts {1000 / config.rate_hz:.2f} ms.",
            suggest_alternatives(joints, config, settings),
        )
    return loads


def _name(settings: CanSettings, bus: int) -> str:
    return settings.channels[bus] if settings.channels else "the virtual bus"


def explain_load(joints: int, reports: ReportSchedule) -> list[str]:
    """The sum, line by line."""
    lines: list[str] = []
    for stream in list_streams(joints, reports):
        if stream.frames_per_s:
            layout = load_layouts()[stream.opcode]
            bits = worst_frame_bits(layout.length)
            lines.append(
                f"  {layout.name:<14}{stream.frames_per_s:7.0f} frames/s x {bits:3d} bits ({layout.length} bytes)"
                f" = {100 * stream.bits_per_s / reports.bit_rate:5.1f} %"
            )
    total = 100 * bus_load(joints, reports)
    return [
        *lines,
        f"  together {total:.1f} % of {format_bit_rate(reports.bit_rate)} at worst-case stuffing; at most {MAX_LOAD:.0%}",
    ]


def suggest_alternatives(joints: Sequence[int], config: RunConfig, settings: CanSettings) -> str:
    """Alternatives that fit: a lower rate, more buses, fewer reports."""
    fullest, total = max(joints), sum(joints)
    reports = plan_reports(config, settings)
    ways = []
    rate = max_rate_hz(fullest, config, settings)
    if rate is not None:
        ways.append(f"rate_hz = {rate} on {len(joints)} bus{'es' if len(joints) > 1 else ''}")
    for buses in range(len(joints) + 1, min(total, 8) + 1):
        if is_feasible(ceil(total / buses), reports):
            ways.append(f"{buses} channels with up to {ceil(total / buses)} joints each")
            break
    for times in (2, 4):
        contact_every = times * reports.contact_every
        if 0 < contact_every <= MAX_EVERY and is_feasible(fullest, replace(reports, contact_every=contact_every)):
            ways.append(f"backends.can.contact_rate_hz = {config.rate_hz / contact_every:g}")
            break
    return "What would fit: " + ("; or ".join(ways) or "nothing on classic CAN") + "."


def max_rate_hz(joints: int, config: RunConfig, settings: CanSettings) -> int | None:
    """The highest integer rate below the run's at which this many joints fit on a bus; None when none does.

    Bisection does not work: at some lower rate reports may come at every Sync instead of every second one.
    """
    for rate_hz in range(ceil(config.rate_hz) - 1, MIN_RATE_HZ - 1, -1):
        if is_feasible(joints, plan_reports_at(rate_hz, config, settings)):
            return rate_hz
    return None


def plan_buses(config: RunConfig, settings: CanSettings) -> list[tuple[int, ReportSchedule]]:
    """Joints and reports of every bus, tail to head: only the first carries TailContact. Raises ConfigError."""
    reports = plan_reports(config, settings)
    return [
        (count, replace(reports, tail=reports.tail and i == 0))
        for i, count in enumerate(joints_per_bus(config, settings))
    ]
