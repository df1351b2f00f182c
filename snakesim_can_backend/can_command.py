"""What `snakesim drive` does for joint modules: bus load, scan, replay of a log, the expanded DBC file."""

import argparse
import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence
from math import ceil
from pathlib import Path
from typing import Any

from snakesim_can_backend.arguments import EXPANDED_DBC_FILENAME
from snakesim_can_backend.bus.adapter import open_bus, open_wire, split_channel, validate_channel
from snakesim_can_backend.bus.bus import Wire
from snakesim_can_backend.bus.load import (
    MAX_LOAD,
    ReportSchedule,
    compute_bus_load,
    compute_busiest_period_s,
    explain_load,
    format_bit_rate,
    is_feasible,
    plan_buses,
    plan_reports,
    plan_reports_at,
    suggest_alternatives,
)
from snakesim_can_backend.bus.local_wire import LOCAL, LocalWire
from snakesim_can_backend.bus.read_log import BusLog
from snakesim_can_backend.bus.unknown_frames import (
    LocalBusReader,
    UnknownFrames,
    listen_for_unknown_frames,
)
from snakesim_can_backend.driver.bring_up import ModuleBus, ModuleIdentity, find_modules
from snakesim_can_backend.driver.modules import compute_response_timeout_s
from snakesim_can_backend.driver.offline import LogReplay, compare_with_run_log
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import FIRST_NODE, LAST_NODE, Opcode
from snakesim_can_backend.protocol.expanded import make_expanded_dbc
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import align_columns, discard_line, print_json, print_line
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.scenario import KeyOverride, LoadedScenario, RunConfig, parse_set_option
from snakesim_hal.model.scenario import load_scenario as load_scenario
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.run_log.black_box import read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX

OK, FAILED = 0, 1
MODULE_BACKEND = "can"  # the backend of joint modules
# For others on a bus; most devices send something five times a second or more.
LISTEN_DURATION_S = 0.3
COLUMNS = (
    *("channel", "node", "serial", "firmware", "protocol", "emulated", "state", "faults", "uptime"),
    *("voltage", "motor", "board", "shaft"),
)
UNKNOWN = "-"


# --- load --------------------------------------------------------------------------------------------------


def print_module_load(arguments: argparse.Namespace) -> int:
    """Run `snakesim drive load can`: print the worst-case load of the buses of joint modules.

    Without `--joints` and `--hz` it prints the load of each bus of the scenario. With one of them it prints a table,
    which is an answer for any numbers, so its exit code is 0.

    Args:
        arguments: Parsed command line, with the options of `add_module_load_arguments`.

    Returns:
        Exit code: OK, or FAILED if a bus of the scenario cannot carry its load.
    """
    overrides = [
        KeyOverride("backend", "can", "drive load can"),
        *(parse_set_option(text) for text in arguments.set),
    ]
    loaded = load_scenario(arguments.scenario, overrides)
    settings = load_can_settings(loaded)
    config = loaded.config
    if arguments.joints is None and arguments.hz is None:
        return _print_load_of_scenario(config, settings, as_json=arguments.json)
    joint_counts = arguments.joints or [config.robot.chain.modules]
    if arguments.json:
        print_json({"loads": list(_list_loads(config, settings, joint_counts, arguments.hz))})
        return OK
    for line in format_load_table(config, settings, joint_counts, arguments.hz):
        print_line(line)
    return OK


def _print_load_of_scenario(config: RunConfig, settings: CanSettings, *, as_json: bool) -> int:
    """Print the load of every bus of a scenario. Return the exit code: FAILED if a bus cannot carry its load."""
    lines, all_fit = describe_bus_loads(config, settings)
    if as_json:
        channels = settings.channels or ["one bus"]
        buses = [
            {
                "channel": channel,
                "joints": joint_count,
                "load": compute_bus_load(joint_count, reports),
                "fits": is_feasible(joint_count, reports),
            }
            for channel, (joint_count, reports) in zip(
                channels, plan_buses(config, settings), strict=True
            )
        ]
        print_json({"rate_hz": config.rate_hz, "buses": buses, "fits": all_fit})
    else:
        for line in lines:
            print_line(line)
    return OK if all_fit else FAILED


def _list_loads(
    config: RunConfig,
    settings: CanSettings,
    joint_counts: Sequence[int],
    rates_hz: Sequence[float] | None,
) -> Iterator[dict[str, Any]]:
    """Yield the load of the bus with the most joints, for every number of joints of a robot and every control rate."""
    bus_count = max(len(settings.channels), 1)
    for joint_count in joint_counts:
        max_joints_per_bus = ceil(joint_count / bus_count)
        for rate_hz in rates_hz or [config.rate_hz]:
            reports = plan_reports_at(rate_hz, config, settings)
            yield {
                "joints": joint_count,
                "rate_hz": rate_hz,
                "load": compute_bus_load(max_joints_per_bus, reports),
                "fits": is_feasible(max_joints_per_bus, reports),
            }


def load_can_settings(loaded: LoadedScenario) -> CanSettings:
    """Decode the section `backends.can` of a scenario; raise ConfigError if it is invalid."""
    table = loaded.table
    section = ConfigTable(loaded.config.backends.get("can", {}), table.source, table.origin_by_key)
    return decode_table(section, CanSettings, "backends.can")


def describe_bus_loads(config: RunConfig, settings: CanSettings) -> tuple[list[str], bool]:
    """Return the load of every bus as lines of text, and whether every bus can carry it."""
    buses = plan_buses(config, settings)
    period_ms = 1e3 / config.rate_hz
    lines: list[str] = []
    channels = settings.channels or ["one bus"]
    for channel, (joint_count, reports) in zip(channels, buses, strict=True):
        lines.append(f"{channel}: {joint_count} joints at {config.rate_hz:g} Hz")
        lines += explain_load(joint_count, reports)
        busiest_ms = 1e3 * compute_busiest_period_s(joint_count, reports)
        lines.append(
            f"  Sync, answers, forces and setpoints of one period: {busiest_ms:.2f} of {period_ms:.2f} ms"
        )
    if all(is_feasible(joint_count, reports) for joint_count, reports in buses):
        return lines, True
    joint_counts = [joint_count for joint_count, _ in buses]
    lines.append(f"Refused. {suggest_alternatives(joint_counts, config, settings)}")
    return lines, False


def format_load_table(
    config: RunConfig,
    settings: CanSettings,
    joint_counts: Sequence[int],
    rates_hz: Sequence[float] | None = None,
) -> Iterator[str]:
    """Yield the lines of a table with the load of the bus with the most joints.

    Args:
        config: Configuration of the run.
        settings: Settings of the backend.
        joint_counts: Numbers of joints of a robot, one for each row.
        rates_hz: Control rates, one for each column; None for the rate of the scenario.
    """
    bus_count = max(len(settings.channels), 1)
    columns_hz = rates_hz or [config.rate_hz]
    yield "joints" + "".join(f"{f'{rate_hz:g} Hz':>16}" for rate_hz in columns_hz)
    for joint_count in joint_counts:
        max_joints_per_bus = ceil(joint_count / bus_count)
        cells = [
            _format_load_cell(max_joints_per_bus, plan_reports_at(rate_hz, config, settings))
            for rate_hz in columns_hz
        ]
        yield f"{joint_count:6}" + "".join(f"{cell:>16}" for cell in cells)
    bus = "one bus" if bus_count == 1 else f"the fullest of {bus_count} buses"
    bit_rate = format_bit_rate(settings.bit_rate)
    yield f"Worst-case load of {bus}, {bit_rate}; above {MAX_LOAD:.0%}, or with too long a period, it is refused."


def _format_load_cell(joint_count: int, reports: ReportSchedule) -> str:
    return f"{100 * compute_bus_load(joint_count, reports):.1f} %" + (
        "" if is_feasible(joint_count, reports) else " refused"
    )


# --- scan --------------------------------------------------------------------------------------------------


def scan_channels(arguments: argparse.Namespace) -> int:
    """Run `snakesim drive scan can`: list the joint modules that answer on some buses.

    Nothing is sent on a bus that unknown nodes use, unless `--anyway` is given.

    Args:
        arguments: Parsed command line.

    Returns:
        Exit code 0; 1 if no module responds.
    """
    all_rows: list[dict[str, str]] = []  # of all buses, by column
    channels_in_use: list[str] = []
    print_text = discard_line if arguments.json else print_line
    for channel in arguments.channel:
        validate_channel(channel)
        unknown_senders: list[UnknownFrames] = []
        if not arguments.anyway:
            unknown_senders = find_unknown_senders(channel, arguments.bit_rate)
        if unknown_senders:
            channels_in_use.append(channel)
            print_text(
                f"{channel}: others use this bus, and nothing was sent; add --anyway to request modules all the same"
            )
            for sender in unknown_senders:
                print_text(f"  {sender}")
            continue
        wire = open_wire(channel, bit_rate=arguments.bit_rate)
        try:
            rows = scan(wire, arguments.duration)
        finally:
            wire.close()
        lines = align_columns(COLUMNS, rows) if rows else [f"{channel}: no module answers"]
        for line in lines:
            print_text(line)
        all_rows += rows
    if arguments.json:
        print_json({"drives": all_rows, "in_use_by_others": channels_in_use})
    return OK if all_rows else FAILED


def find_unknown_senders(channel: str, bit_rate: int) -> list[UnknownFrames]:
    """Listen to a bus without sending, and return the frames that are not from joint modules, by sender."""
    interface, name = split_channel(channel)
    if interface == LOCAL:
        with contextlib.closing(LocalWire(name, fd=True)) as wire:
            return listen_for_unknown_frames(LocalBusReader(wire), LISTEN_DURATION_S)
    bus = open_bus(channel, bit_rate)
    try:
        return listen_for_unknown_frames(bus, LISTEN_DURATION_S)
    finally:
        bus.shutdown()


def scan(wire: Wire, seconds: float) -> list[dict[str, str]]:
    """Discover the joint modules on a bus, by sending requests for their identity only.

    Args:
        wire: Open bus.
        seconds: Duration to listen for responses.

    Returns:
        A row for each module, as text by the names in `COLUMNS`.
    """
    reading = ModuleReports(LAST_NODE)
    all_nodes_bus = ModuleBus(wire, range(FIRST_NODE, LAST_NODE + 1))
    return [
        _make_scan_row(identity, reading)
        for identity in find_modules([all_nodes_bus], seconds, reading.process_frame)
    ]


def _make_scan_row(identity: ModuleIdentity, reading: ModuleReports) -> dict[str, str]:
    """Return the row of a scan for one module, by column; values that the module has not reported are UNKNOWN.

    Args:
        identity: Response of the module to the request for its identity.
        reading: Reports of all modules that arrived during the scan.
    """
    if identity.is_stepped:
        emulated = "stepped"
    elif identity.is_emulated:
        emulated = "yes"
    else:
        emulated = "no"
    row = dict.fromkeys(COLUMNS, UNKNOWN) | {
        "channel": identity.channel,
        "node": str(identity.node_id),
        "serial": f"{identity.serial:08X}",
        "firmware": identity.firmware,
        "protocol": str(identity.protocol),
        "emulated": emulated,
    }
    if not FIRST_NODE <= identity.node_id <= LAST_NODE:
        return row
    i = identity.node_id - 1
    module = reading.modules[i]
    health = reading.list_health_reports()[i]
    shaft_torque = reading.shaft_raw[i]
    has_sent_heartbeat = module.uptime_ms >= 0
    if has_sent_heartbeat:
        row["state"] = module.state.name.lower()
        row["faults"] = "+".join(module.list_fault_names()) or "none"
        row["uptime"] = f"{module.uptime_ms / 1000:.1f} s"
    if health is not None:
        signals = load_layouts()[Opcode.HEALTH].signals
        row["voltage"] = f"{signals['voltage'].decode(health[0]):.1f} V"
        row["motor"] = f"{signals['motor_temperature'].decode(health[2]):.0f} °C"
        row["board"] = f"{signals['board_temperature'].decode(health[3]):.0f} °C"
    if shaft_torque is not None:  # only while a host sends Syncs, and modules report their IMUs
        torque_nm = load_layouts()[Opcode.SHAFT_LOAD].signals["torque"].decode(shaft_torque)
        row["shaft"] = f"{torque_nm:.3f} N·m"
    return row


# --- replay ------------------------------------------------------------------------------------------------


def replay_log(arguments: argparse.Namespace) -> int:
    """Run `snakesim drive replay can`: compare the log of a bus with the run log of the same run.

    Args:
        arguments: Parsed command line, with the log and the folder of the run.

    Returns:
        Exit code 0; 1 if the joint states differ or the log has no Sync.

    Raises:
        ConfigError: The run has another backend, or a file cannot be read.
    """
    loaded = load_scenario(str(arguments.run / "config.json"), [])
    config = loaded.config
    if config.backend != MODULE_BACKEND:
        raise ConfigError(
            f"{arguments.run}: is a run with the backend {config.backend!r}, and `snakesim drive replay can` "
            f"reads the protocol of joint modules: give it a run with the backend {MODULE_BACKEND!r} and the log of "
            "that run",
            code="recording/missing-data",
        )
    layout, rows = read_black_box(arguments.run / BLACK_BOX)
    settings = load_can_settings(loaded)
    replay = LogReplay(
        DriveMounting(config.robot.joint_table),
        plan_reports(config, settings),
        compute_response_timeout_s(config, settings),
    )
    log = BusLog(arguments.log)
    replay.read(log)
    if not replay.joints:
        finding = f"{replay.frames} frames, and no Sync among them: the log of another bus"
        print_line(
            f"{arguments.log}: {finding}{describe_frame_origin(replay.other_protocol_frames)}"
        )
        return FAILED
    print_line(f"{arguments.log}: {replay.frames} frames, {len(replay.joints)} Syncs")
    for line in log.report():
        print_line(f"  {line}")
    for name, silent_syncs in zip(layout.joints, replay.unanswered_syncs, strict=True):
        if silent_syncs:
            print_line(f"  {name} did not answer {silent_syncs} Syncs in time")
    for node, frame_count in sorted(replay.reports.unknown_node_frame_counts.items()):
        print_line(f"  {frame_count} frames of node {node}, which is not of this robot")
    comparison = compare_with_run_log(replay, layout, rows)
    if comparison.first_wrong:
        print_line(f"joint states differ from {arguments.run}: {comparison.first_wrong}")
        return FAILED
    print_line(f"joint states of {comparison.compared} ticks are those of the record, to the bit")
    return OK


def describe_frame_origin(other_protocol_frames: Counter[str]) -> str:
    """Return a text with the most frequent kind of frames that joint modules do not send.

    Args:
        other_protocol_frames: Number of frames by what they look like, such as "as CANopen of node 3".

    Returns:
        A text to be appended to a message; empty if no frame looks like those of a known protocol.
    """
    kinds: Counter[str] = Counter()
    for looks_as, count in other_protocol_frames.items():
        kinds[looks_as.partition(" of node")[0].removeprefix("as ")] += count
    del kinds[""]
    [(kind, count)] = kinds.most_common(1) or [("", 0)]
    return f"; {count} frames look like {kind}" if count else ""


# --- dbc ---------------------------------------------------------------------------------------------------


def write_dbc(arguments: argparse.Namespace) -> int:
    """Write the DBC file with every message of every node, and return the exit code."""
    path = arguments.out or Path(EXPANDED_DBC_FILENAME)
    write_text(path, make_expanded_dbc(), encoding="cp1252")
    print_line(str(path))
    return OK
