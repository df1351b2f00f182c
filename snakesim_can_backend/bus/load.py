"""The bus load of a configuration, in bits; refuses one that does not fit.

A classic frame with an 11-bit id and n bytes takes 47 + 8 n bits: start, id, control, data, CRC, acknowledge, end and
the gap to the next. After five equal bits the sender stuffs one in between; at worst that adds one for every four of
the 34 + 8 n bits that can be stuffed. All loads here are worst cases.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    HEALTH_PERIOD_S,
    HEARTBEAT_PERIOD_S,
    LAST_NODE,
    Opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import RunConfig

BIT_RATE = 1_000_000
MAX_LOAD = 0.8  # of a bus's time; the rest is for commands, parameters and repeated frames
MAX_SYNCS_PER_REPORT = 255  # Syncs between reports; limit of the modules' parameters
MIN_RATE_HZ = 20  # a slower control rate is not proposed
MAX_PROPOSED_BUSES = 8
FRAME_BITS = 47  # of a classic frame, without its data
STUFFABLE_BITS = 34  # of these bits, those that can be stuffed
FD_START_BITS = 36  # of a frame of CAN FD with an id of 29 bits, up to the switch of bit rates
FD_END_BITS = 13  # after the CRC
FD_LENGTH_BITS = 5
FD_STUFF_COUNT_BITS = 4


def format_bit_rate(bit_rate: int) -> str:
    """Return a bit rate as text for a person, in Mbit/s."""
    return f"{bit_rate / 1e6:g} Mbit/s"


def compute_max_frame_bits(length: int) -> int:
    """Return the bits of a classic frame with `length` bytes, with the maximum of stuff bits."""
    return FRAME_BITS + 8 * length + (STUFFABLE_BITS + 8 * length - 1) // 4


def compute_max_frame_duration_s(
    length: int, bit_rate: int, data_bit_rate: int | None = None
) -> float:
    """Return the time that a frame occupies the bus with the maximum number of stuff bits.

    On CAN FD, identifier and end are sent at the first bit rate; length, data and CRC at the second. The CRC has 17
    bits, or 21 above 16 bytes of data. Before it comes the count of stuff bits, and it has a fixed stuff bit for every
    four bits.

    Args:
        length: Number of data bytes.
        bit_rate: Bit rate in bit/s.
        data_bit_rate: Second bit rate in bit/s, for CAN FD with an id of 29 bits; None for classic CAN with an id of
            11 bits.

    Returns:
        Duration of the frame in s.
    """
    if data_bit_rate is None:
        return compute_max_frame_bits(length) / bit_rate
    crc_bits = FD_STUFF_COUNT_BITS + (17 if length <= 16 else 21)
    data_bits = FD_LENGTH_BITS + 8 * length
    slow_bits = FD_START_BITS + (FD_START_BITS - 1) // 4 + FD_END_BITS
    fast_bits = data_bits + data_bits // 4 + crc_bits + ceil(crc_bits / 4)
    return slow_bits / bit_rate + fast_bits / data_bit_rate


@dataclass(frozen=True)
class ReportSchedule:
    """Which reports the modules on a bus send, and how often."""

    rate_hz: float  # of Syncs
    contact_every: int = 1  # Syncs; 0: never
    imu_every: int = 20  # Syncs; 0: never
    tail: bool = True  # whether a module on the bus sends TailContact
    bit_rate: int = BIT_RATE


@dataclass(frozen=True)
class FrameStream:
    """One kind of frame on one bus."""

    opcode: Opcode
    frames_per_s: float

    @property
    def bits_per_s(self) -> float:
        """Return the bits per second at worst-case stuffing."""
        return self.frames_per_s * compute_max_frame_bits(load_layouts()[self.opcode].length)


def list_streams(joint_count: int, reports: ReportSchedule) -> list[FrameStream]:
    """Return all kinds of frames on one bus while the robot runs, each with its mean rate.

    Args:
        joint_count: Number of joints on the bus.
        reports: Which reports the modules send, and how often.
    """
    rate_hz = reports.rate_hz
    contact_hz = rate_hz / reports.contact_every if reports.contact_every else 0.0
    imu_hz = rate_hz / reports.imu_every if reports.imu_every else 0.0
    tail_contact_hz = contact_hz if reports.tail else 0.0
    return [
        FrameStream(Opcode.SYNC, rate_hz),
        FrameStream(Opcode.SET_POINT, joint_count * rate_hz),
        FrameStream(Opcode.JOINT_STATE, joint_count * rate_hz),
        FrameStream(Opcode.CONTACT, joint_count * contact_hz),
        FrameStream(Opcode.TAIL_CONTACT, tail_contact_hz),
        FrameStream(Opcode.GYRO, joint_count * imu_hz),
        FrameStream(Opcode.ACCELEROMETER, joint_count * imu_hz),
        FrameStream(Opcode.SHAFT_LOAD, joint_count * imu_hz),
        FrameStream(Opcode.HEARTBEAT, joint_count / HEARTBEAT_PERIOD_S),
        FrameStream(Opcode.HEALTH, joint_count / HEALTH_PERIOD_S),
    ]


def compute_bus_load(joint_count: int, reports: ReportSchedule) -> float:
    """Return the worst-case load of a bus, as a fraction of its time."""
    return (
        sum(stream.bits_per_s for stream in list_streams(joint_count, reports)) / reports.bit_rate
    )


def compute_busiest_period_s(joint_count: int, reports: ReportSchedule) -> float:
    """Return the bus time of a period with force reports: Sync, all answers and all setpoints, at worst."""
    one_period = ReportSchedule(1.0, min(reports.contact_every, 1), 0, reports.tail)
    in_each_period = (
        Opcode.SYNC,
        Opcode.SET_POINT,
        Opcode.JOINT_STATE,
        Opcode.CONTACT,
        Opcode.TAIL_CONTACT,
    )
    streams = [
        stream
        for stream in list_streams(joint_count, one_period)
        if stream.opcode in in_each_period
    ]
    return sum(stream.bits_per_s for stream in streams) / reports.bit_rate


def is_feasible(joint_count: int, reports: ReportSchedule) -> bool:
    """Return whether a bus can carry this many joints, on average and in the longest period."""
    fits_on_average = compute_bus_load(joint_count, reports) <= MAX_LOAD
    return fits_on_average and compute_busiest_period_s(joint_count, reports) * reports.rate_hz <= 1


# --- the reports of a run -----------------------------------------------------------------------------------------


def compute_syncs_per_report(rate_hz: float, report_hz: float) -> int:
    """Return the number of Syncs between reports at about `report_hz`; 0 for never."""
    if report_hz <= 0:
        return 0
    return round(min(max(rate_hz / report_hz, 1.0), MAX_SYNCS_PER_REPORT))


def plan_reports(config: RunConfig, settings: CanSettings) -> ReportSchedule:
    """Return which reports the modules of a run send, and how often."""
    return plan_reports_at(config.rate_hz, config, settings)


def plan_reports_at(rate_hz: float, config: RunConfig, settings: CanSettings) -> ReportSchedule:
    """Return the reports at another control rate than the run's: rates in Hz are converted to Syncs."""
    sensors = config.robot.sensors
    contact_hz = 0.0
    if sensors.contacts is not None:
        contact_hz = sensors.contacts.rate_hz
        if settings.contact_rate_hz is not None:
            contact_hz = settings.contact_rate_hz
    imu_hz = 0.0
    if sensors.imu is not None:
        imu_hz = min(settings.imu_rate_hz, sensors.imu.rate_hz)
    return ReportSchedule(
        rate_hz,
        contact_every=compute_syncs_per_report(rate_hz, contact_hz),
        imu_every=compute_syncs_per_report(rate_hz, imu_hz),
        bit_rate=settings.bit_rate,
    )


def count_joints_per_bus(config: RunConfig, settings: CanSettings) -> list[int]:
    """Distribute the joints of a robot over its buses, as the settings say or as evenly as possible.

    Args:
        config: Configuration of the run, with the robot.
        settings: Settings of the backend, with its channels.

    Returns:
        The number of joints on each bus, from tail to head.

    Raises:
        ConfigError: A channel is named twice, or the numbers do not fit the robot.
    """
    joints = config.robot.chain.modules
    buses = max(len(settings.channels), 1)
    if len(set(settings.channels)) < len(settings.channels):
        raise ConfigError(
            f"`backends.can.channels` = {settings.channels} names a channel twice",
            code="bus/invalid-channel",
        )
    if joints > LAST_NODE:
        raise ConfigError(
            f"robot {config.robot.name!r} has {joints} joints; node ids of protocol version 1 go to {LAST_NODE}",
            code="drive/unsupported-setting",
        )
    joint_counts = settings.joints_per_channel
    if joint_counts and (len(joint_counts) != buses or sum(joint_counts) != joints):
        raise ConfigError(
            f"`backends.can.joints_per_channel` = {joint_counts} must be {buses} numbers that add up to the {joints} "
            f"joints of robot {config.robot.name!r}",
            code="bus/invalid-channel",
        )
    if buses > joints:
        raise ConfigError(
            f"`backends.can.channels` names {buses} channels for {joints} joints",
            code="bus/invalid-channel",
        )
    if joint_counts:
        return list(joint_counts)
    min_joints, remainder = divmod(joints, buses)
    return [min_joints + (bus < remainder) for bus in range(buses)]  # the first buses have one more


def plan_buses(config: RunConfig, settings: CanSettings) -> list[tuple[int, ReportSchedule]]:
    """Return the number of joints and the reports of every bus, tail to head.

    Only the first bus carries TailContact.

    Raises:
        ConfigError: A channel is named twice, or the numbers do not fit the robot.
    """
    reports = plan_reports(config, settings)
    buses: list[tuple[int, ReportSchedule]] = []
    for bus_index, joint_count in enumerate(count_joints_per_bus(config, settings)):
        has_tail = reports.tail and bus_index == 0
        buses.append((joint_count, replace(reports, tail=has_tail)))
    return buses


# --- the check ----------------------------------------------------------------------------------------------------


def validate_bus_load(config: RunConfig, settings: CanSettings) -> list[float]:
    """Check that every bus can carry the frames of its joints.

    Args:
        config: Configuration of the run, with the control rate.
        settings: Settings of the backend, with its channels.

    Returns:
        The load of every bus, as a fraction of its time.

    Raises:
        ConfigError: A load is above `MAX_LOAD`, or the frames of a single control period do not fit into it. The error
            lists the load by kind of frame, and alternatives that fit.
    """
    buses = plan_buses(config, settings)
    joint_counts = [joint_count for joint_count, _ in buses]
    loads = [compute_bus_load(*bus) for bus in buses]
    fullest_bus = max(range(len(loads)), key=lambda i: loads[i])
    if loads[fullest_bus] > MAX_LOAD:
        raise ConfigError(
            f"{joint_counts[fullest_bus]} joints at {config.rate_hz:g} Hz do not fit on "
            f"{_describe_bus(settings, fullest_bus)}:",
            *explain_load(*buses[fullest_bus]),
            suggest_alternatives(joint_counts, config, settings),
            code="bus/overloaded",
        )
    periods_s = [compute_busiest_period_s(*bus) for bus in buses]
    longest_period_bus = max(range(len(buses)), key=lambda i: periods_s[i])
    if periods_s[longest_period_bus] * config.rate_hz > 1:
        raise ConfigError(
            f"{joint_counts[longest_period_bus]} joints at {config.rate_hz:g} Hz do not fit on "
            f"{_describe_bus(settings, longest_period_bus)}: a period with force reports takes "
            f"{periods_s[longest_period_bus] * 1000:.2f} ms of bus time and lasts {1000 / config.rate_hz:.2f} ms.",
            suggest_alternatives(joint_counts, config, settings),
            code="bus/overloaded",
        )
    return loads


def _describe_bus(settings: CanSettings, bus_index: int) -> str:
    return settings.channels[bus_index] if settings.channels else "the virtual bus"


def explain_load(joint_count: int, reports: ReportSchedule) -> list[str]:
    """Return the sum of a bus's load, one line for each kind of frame."""
    lines: list[str] = []
    for stream in list_streams(joint_count, reports):
        if not stream.frames_per_s:
            continue
        layout = load_layouts()[stream.opcode]
        bits = compute_max_frame_bits(layout.length)
        percent = 100 * stream.bits_per_s / reports.bit_rate
        lines.append(
            f"  {layout.name:<14}{stream.frames_per_s:7.0f} frames/s x {bits:3d} bits ({layout.length} bytes)"
            f" = {percent:5.1f} %"
        )
    total_percent = 100 * compute_bus_load(joint_count, reports)
    bit_rate = format_bit_rate(reports.bit_rate)
    lines.append(
        f"  together {total_percent:.1f} % of {bit_rate} at worst-case stuffing; at most {MAX_LOAD:.0%}"
    )
    return lines


def suggest_alternatives(
    joint_counts: Sequence[int], config: RunConfig, settings: CanSettings
) -> str:
    """Suggest what would fit where buses are overloaded.

    Args:
        joint_counts: Number of joints on each bus.
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: Settings of the backend.

    Returns:
        A sentence with a lower control rate, a higher number of buses, and a lower rate of contact reports; without
        those that would not help.
    """
    max_joint_count = max(joint_counts)  # on one bus
    total_joint_count = sum(joint_counts)
    bus_count = len(joint_counts)
    reports = plan_reports(config, settings)
    alternatives: list[str] = []

    # A lower control rate, if any lower rate fits.
    rate_hz = find_max_rate_hz(max_joint_count, config, settings)
    if rate_hz is not None:
        buses = "1 bus" if bus_count == 1 else f"{bus_count} buses"
        alternatives.append(f"rate_hz = {rate_hz} on {buses}")

    # More buses.
    max_bus_count = min(total_joint_count, MAX_PROPOSED_BUSES)
    for proposed_bus_count in range(bus_count + 1, max_bus_count + 1):
        joints_per_bus = ceil(total_joint_count / proposed_bus_count)
        if is_feasible(joints_per_bus, reports):
            alternatives.append(
                f"{proposed_bus_count} channels with up to {joints_per_bus} joints each"
            )
            break

    # Contact reports at half or a quarter of their rate. 0 Syncs per report means that there are none.
    for factor in (2, 4):
        syncs_per_report = factor * reports.contact_every
        if not 0 < syncs_per_report <= MAX_SYNCS_PER_REPORT:
            continue
        if is_feasible(max_joint_count, replace(reports, contact_every=syncs_per_report)):
            alternatives.append(
                f"backends.can.contact_rate_hz = {config.rate_hz / syncs_per_report:g}"
            )
            break

    text = "; or ".join(alternatives) or "nothing on classic CAN"
    return f"What would fit: {text}."


def find_max_rate_hz(joint_count: int, config: RunConfig, settings: CanSettings) -> int | None:
    """Return the highest integer rate below the run's at which this many joints fit on a bus; None if there is none.

    Bisection does not work: at some lower rate reports may come at every Sync instead of every second one.
    """
    for rate_hz in range(ceil(config.rate_hz) - 1, MIN_RATE_HZ - 1, -1):
        if is_feasible(joint_count, plan_reports_at(rate_hz, config, settings)):
            return rate_hz
    return None
