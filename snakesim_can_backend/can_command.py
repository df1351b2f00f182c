"""`snakesim can`: bus load of a configuration, modules that answer on a bus, a log replayed, the expanded DBC file."""

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from math import ceil
from pathlib import Path

from snakesim_can_backend.bus.adapter import check_channel, open_bus, open_wire
from snakesim_can_backend.bus.bus import Wire
from snakesim_can_backend.bus.load import (
    BIT_RATE,
    MAX_LOAD,
    MIN_RATE_HZ,
    ReportSchedule,
    bus_load,
    busiest_period_s,
    explain_load,
    format_bit_rate,
    is_feasible,
    plan_buses,
    plan_reports,
    plan_reports_at,
    suggest_alternatives,
)
from snakesim_can_backend.bus.read_log import BusLog
from snakesim_can_backend.bus.unknown_frames import UnknownFrames, listen_for_unknown_frames
from snakesim_can_backend.driver.bring_up import ModuleBus, ModuleIdentity, find_modules
from snakesim_can_backend.driver.modules import answer_limit_s
from snakesim_can_backend.driver.offline import LogReplay, compare_with_run_log
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import FIRST_NODE, LAST_NODE, Opcode
from snakesim_can_backend.protocol.expanded import EXPANDED, expanded_dbc
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.mounting import Mounting
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import align_columns, print_line
from snakesim_hal.model.files import Table, decode
from snakesim_hal.model.scenario import Loaded, Override, RunConfig, parse_set
from snakesim_hal.model.scenario import load as load_scenario
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.programs.arguments import number_type
from snakesim_hal.run_log.black_box import read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX

OK, FAILED = 0, 1
MODULES = "can"  # the backend of joint modules
LISTEN_S = 0.3  # for others on a bus; most devices say something five times a second or more
MAX_RATE_HZ = 5000  # of a scenario
COLUMNS = (
    *("channel", "node", "serial", "firmware", "protocol", "emulated", "state", "faults", "uptime"),
    *("voltage", "motor", "board", "shaft"),
)
UNKNOWN = "-"


def main(argv: Sequence[str]) -> int:
    """Exit code: 0 done, 1 does not fit or no module answers. Raises SnakesimError."""
    arguments = parser().parse_args(list(argv))
    return arguments.act(arguments)


def parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(prog="snakesim can", description="Joint modules and their buses.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    asked = commands.add_parser("load", help="print the worst-case load of a scenario's buses")
    asked.add_argument("scenario", help="name of a shipped scenario, or path of a scenario file or a run's config.json")
    asked.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change any value")
    joints, rate_hz = number_type(1, LAST_NODE, "joints"), number_type(float(MIN_RATE_HZ), MAX_RATE_HZ, "Hz")
    asked.add_argument("--joints", type=joints, nargs="+", metavar="N", help="for a robot with this many joints")
    asked.add_argument("--rates", type=rate_hz, nargs="+", metavar="HZ", help="for these control rates")
    asked.set_defaults(act=_load)

    answering = commands.add_parser(
        "scan", help="list every module that answers; sends only identify, and nothing where others use the bus"
    )
    answering.add_argument("channel", nargs="+", help="SocketCAN interface such as can0, or slcan:/dev/ttyACM0")
    answering.add_argument(
        "--bit-rate", type=number_type(10_000, 1_000_000, "bit/s"), default=BIT_RATE, help="of an adapter (1000000)"
    )
    seconds = number_type(0.001, 3600, "s")
    answering.add_argument("--seconds", type=seconds, default=1.0, help="how long to listen on each (default: 1)")
    answering.add_argument("--anyway", action="store_true", help="send identify also where others use the bus")
    answering.set_defaults(act=_scan)

    again = commands.add_parser(
        "replay", help="read a log of the bus as the driver does, and compare its joint states with the run's record"
    )
    again.add_argument("run", type=Path, help="folder of the run, with config.json and its black box")
    again.add_argument("log", type=Path, help="log of its bus: .log (candump; backends.can.log of a run), .asc, .blf")
    again.set_defaults(act=_replay)

    expand = commands.add_parser("expand", help="write the DBC file with every message of every node")
    expand.add_argument("--out", type=Path, default=Path(EXPANDED), metavar="FILE", help=f"(default: {EXPANDED})")
    expand.set_defaults(act=_expand)
    return parser


# --- load --------------------------------------------------------------------------------------------------


def _load(arguments: argparse.Namespace) -> int:
    overrides = [Override("backend", "can", "snakesim can"), *(parse_set(text) for text in arguments.set)]
    loaded = load_scenario(arguments.scenario, overrides)
    settings = settings_of(loaded)
    if arguments.joints is None and arguments.rates is None:
        lines, all_fit = one(loaded.config, settings)
        for line in lines:
            print_line(line)
        return OK if all_fit else FAILED
    config = loaded.config
    for line in table(config, settings, arguments.joints or [config.robot.chain.modules], arguments.rates):
        print_line(line)
    return OK


def settings_of(loaded: Loaded) -> CanSettings:
    """The section `backends.can` of a scenario. Raises ConfigError."""
    table = loaded.table
    section = Table(loaded.config.backends.get("can", {}), table.source, table.origin)
    return decode(section, CanSettings, "backends.can")


def one(config: RunConfig, settings: CanSettings) -> tuple[list[str], bool]:
    """The sum for every bus as lines, and whether all fit."""
    buses, period_ms, lines = plan_buses(config, settings), 1e3 / config.rate_hz, list[str]()
    for name, bus in zip(settings.channels or ["one bus"], buses, strict=True):
        lines += [f"{name}: {bus[0]} joints at {config.rate_hz:g} Hz", *explain_load(*bus)]
        busiest_ms = 1e3 * busiest_period_s(*bus)
        lines.append(f"  Sync, answers, forces and setpoints of one period: {busiest_ms:.2f} of {period_ms:.2f} ms")
    if all(is_feasible(*bus) for bus in buses):
        return lines, True
    return [*lines, f"Refused. {suggest_alternatives([joints for joints, _ in buses], config, settings)}"], False


def table(
    config: RunConfig, settings: CanSettings, joints: Sequence[int], rates_hz: Sequence[float] | None = None
) -> Iterator[str]:
    """The load of the fullest bus for every number of joints and every rate, as lines."""
    buses = max(len(settings.channels), 1)
    rates = rates_hz or [config.rate_hz]
    yield "joints" + "".join(f"{f'{rate:g} Hz':>16}" for rate in rates)
    for count in joints:
        cells = [_cell(ceil(count / buses), plan_reports_at(rate, config, settings)) for rate in rates]
        yield f"{count:6}" + "".join(f"{cell:>16}" for cell in cells)
    on = "one bus" if buses == 1 else f"the fullest of {buses} buses"
    of = format_bit_rate(settings.bit_rate)
    yield f"Worst-case load of {on}, {of}; above {MAX_LOAD:.0%}, or with too long a period, it is refused."


def _cell(joints: int, reports: ReportSchedule) -> str:
    return f"{100 * bus_load(joints, reports):.1f} %" + ("" if is_feasible(joints, reports) else " refused")


# --- scan --------------------------------------------------------------------------------------------------


def _scan(arguments: argparse.Namespace) -> int:
    found = 0
    for channel in arguments.channel:
        if not arguments.anyway and (others := overheard(channel, arguments.bit_rate)):
            print_line(
                f"{channel}: others use this bus, and nothing was sent; to ask for modules all the same add --anyway"
            )
            for other in others:
                print_line(f"  {other}")
            continue
        wire = open_wire(channel, bit_rate=arguments.bit_rate)
        try:
            rows = scan(wire, arguments.seconds)
        finally:
            wire.close()
        for line in align_columns(COLUMNS, rows) if rows else [f"{channel}: no module answers"]:
            print_line(line)
        found += len(rows)
    return OK if found else FAILED


def overheard(channel: str, bit_rate: int) -> list[UnknownFrames]:
    """Who else is on a bus. Sends nothing."""
    check_channel(channel)
    bus = open_bus(channel, bit_rate)
    try:
        return listen_for_unknown_frames(bus, LISTEN_S)
    finally:
        bus.shutdown()


def scan(wire: Wire, seconds: float) -> list[dict[str, str]]:
    """Discover the modules on a bus; one row a module, as text by `COLUMNS`. Sends only identify."""
    reading = ModuleReports(LAST_NODE)
    everybody = ModuleBus(wire, range(FIRST_NODE, LAST_NODE + 1))
    return [_row(identity, reading) for identity in find_modules([everybody], seconds, reading.process_frame)]


def _row(identity: ModuleIdentity, reading: ModuleReports) -> dict[str, str]:
    row = dict.fromkeys(COLUMNS, UNKNOWN) | {
        "channel": identity.channel,
        "node": str(identity.node),
        "serial": f"{identity.serial:08X}",
        "firmware": identity.firmware,
        "protocol": str(identity.protocol),
        "emulated": "stepped" if identity.stepped else "yes" if identity.emulated else "no",
    }
    if not FIRST_NODE <= identity.node <= LAST_NODE:
        return row
    i = identity.node - 1
    module, health, shaft = reading.modules[i], reading.health()[i], reading.shaft_raw[i]
    if module.uptime_ms >= 0:  # it has sent a heartbeat
        row["state"] = module.state.name.lower()
        row["faults"] = "+".join(module.fault_names()) or "none"
        row["uptime"] = f"{module.uptime_ms / 1000:.1f} s"
    if health is not None:
        signals = load_layouts()[Opcode.HEALTH].signals
        row["voltage"] = f"{signals['voltage'].decode(health[0]):.1f} V"
        row["motor"] = f"{signals['motor_temperature'].decode(health[2]):.0f} °C"
        row["board"] = f"{signals['board_temperature'].decode(health[3]):.0f} °C"
    if shaft is not None:  # only while a host sends Syncs, and modules report their IMUs
        row["shaft"] = f"{load_layouts()[Opcode.SHAFT_LOAD].signals['torque'].decode(shaft):.3f} N·m"
    return row


# --- replay ------------------------------------------------------------------------------------------------


def _replay(arguments: argparse.Namespace) -> int:
    loaded = load_scenario(str(arguments.run / "config.json"), [])
    if loaded.config.backend != MODULES:
        raise ConfigError(
            f"{arguments.run}: is a run with the backend {loaded.config.backend!r}, and `snakesim can replay` reads "
            f"the protocol of joint modules: give it a run with the backend {MODULES!r} and the log of that run",
            code="recording/missing-data",
        )
    layout, rows = read_black_box(arguments.run / BLACK_BOX)
    settings = settings_of(loaded)
    mounting, limit_s = Mounting(loaded.config.robot.joint_table), answer_limit_s(loaded.config, settings)
    done = LogReplay(mounting, plan_reports(loaded.config, settings), limit_s)
    log = BusLog(arguments.log)
    done.read(log)
    if not done.joints:
        found = f"{done.frames} frames, and no Sync among them: the log of another bus"
        print_line(f"{arguments.log}: {found}{looks(done.foreign)}")
        return FAILED
    print_line(f"{arguments.log}: {done.frames} frames, {len(done.joints)} Syncs")
    for line in log.report():
        print_line(f"  {line}")
    for name, silent in zip(layout.joints, done.silent, strict=True):
        if silent:
            print_line(f"  {name} did not answer {silent} Syncs in time")
    for node, count in sorted(done.reading.unknown_nodes.items()):
        print_line(f"  {count} frames of node {node}, which is not of this robot")
    verdict = compare_with_run_log(done, layout, rows)
    if verdict.first_wrong:
        print_line(f"joint states differ from {arguments.run}: {verdict.first_wrong}")
        return FAILED
    print_line(f"joint states of {verdict.compared} ticks are those of the record, to the bit")
    return OK


def looks(foreign: Counter[str]) -> str:
    """Return whose the frames look like that are none of joint modules; empty if that is not known."""
    kinds: Counter[str] = Counter()
    for looks_as, count in foreign.items():
        kinds[looks_as.partition(" of node")[0].removeprefix("as ")] += count
    del kinds[""]
    [(kind, count)] = kinds.most_common(1) or [("", 0)]
    return f"; {count} frames look like {kind}" if count else ""


# --- expand ------------------------------------------------------------------------------------------------


def _expand(arguments: argparse.Namespace) -> int:
    write_text(arguments.out, expanded_dbc(), encoding="cp1252")
    print_line(str(arguments.out))
    return OK
