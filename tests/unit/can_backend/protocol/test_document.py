"""The pages `docs/reference/can-*.md` agree with the DBC file, the parameters and the emulated firmware."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from snakesim_can_backend.bus.load import compute_bus_load, compute_max_frame_bits, plan_reports_at
from snakesim_can_backend.emulator.firmware import BOOT_US, ModuleFirmware
from snakesim_can_backend.emulator.parameters import ParameterStore, make_factory_defaults
from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.codec import load_database, load_layouts
from snakesim_can_backend.protocol.definitions import (
    FIRST_NODE,
    FROM_HOST,
    LAST_NODE,
    MAX_WRONG_COUNTS,
    NODE_BITS,
    PARAMETERS,
    CanFrame,
    CommandAction,
    ModuleState,
    Opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.model.scenario import load_scenario as load_scenario
from snakesim_hal.physics.thermal import HeatLimits

REFERENCE = Path(__file__).parents[4] / "docs" / "reference"
PAGES = "\n".join(page.read_text(encoding="utf-8") for page in sorted(REFERENCE.glob("can-*.md")))
NODE = 5


def find_section(heading: str) -> str:
    """Return the text under a heading, up to the next one."""
    match = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", PAGES, re.MULTILINE | re.DOTALL)
    assert match, f"docs/reference/can-*.md have no heading {heading!r}"
    return match[1]


def read_table(heading: str) -> list[list[str]]:
    """Return the rows of the first table under a heading, without its header, code marks and links."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", find_section(heading))
    first = text.partition("\n|")[2].partition("\n\n")[0]
    lines = ["|" + line.removeprefix("|") for line in first.splitlines()]
    return [[cell.strip().replace("`", "") for cell in line[1:-1].split("|")] for line in lines[2:]]


def format_number(value: float) -> str:
    return f"{value:.6g}"


# --- layouts -----------------------------------------------------------------------------------------------


def make_message_row(opcode: Opcode) -> list[str]:
    """Return the row of a message in the table of messages."""
    layout = load_layouts()[opcode]
    first = opcode << NODE_BITS
    to_all = opcode in (Opcode.EMERGENCY, Opcode.COMMAND, Opcode.SYNC)
    to_one = opcode not in (Opcode.EMERGENCY, Opcode.SYNC)
    low = first if to_all else first + FIRST_NODE
    high = first + LAST_NODE if to_one else first
    ids = f"{low:03X}" if low == high else f"{low:03X}–{high:03X}"
    return [
        layout.name,
        str(int(opcode)),
        ids,
        "host" if opcode in FROM_HOST else "module",
        str(layout.length),
    ]


def make_signal_rows(opcode: Opcode) -> list[list[str]]:
    """Return the rows of the table of signals of a message."""
    table = []
    for signal in sorted(load_layouts()[opcode].signals.values(), key=lambda s: (s.shift, s.name)):
        last = signal.shift + signal.bits - 1
        bits = str(signal.shift) if signal.bits == 1 else f"{signal.shift}–{last}"
        if signal.is_float:
            kind = "float"
        elif signal.signed:
            kind = "signed"
        else:
            kind = "unsigned"
        step = "" if signal.is_float else format_number(signal.scale)
        zero = f", raw 0 is {format_number(signal.offset)}" if signal.offset else ""
        table.append(
            [
                signal.name,
                bits,
                kind,
                step + zero,
                f"{format_number(signal.low)} to {format_number(signal.high)}",
                signal.unit.replace("N.m", "N·m").replace("m/s^2", "m/s²").replace("degC", "°C"),
            ]
        )
    return table


def test_document_table_of_messages_agrees_with_the_dbc() -> None:
    assert [row[:5] for row in read_table("Messages")] == [
        make_message_row(opcode) for opcode in Opcode
    ]


@pytest.mark.parametrize("opcode", list(Opcode))
def test_document_layout_of_every_message_agrees_with_the_dbc(opcode: Opcode) -> None:
    assert [row[:6] for row in read_table(load_layouts()[opcode].name)] == make_signal_rows(opcode)


def test_document_lists_every_named_value() -> None:
    for message in load_database().messages:
        for signal in message.signals:
            if signal.choices and signal.name != "index":  # the table of parameters contains those
                listed = ", ".join(
                    f"{value} {name}" for value, name in sorted(signal.choices.items())
                )
                assert f"`{signal.name}`: {listed}" in PAGES, signal.name


def test_document_table_of_parameters_agrees_with_the_code() -> None:
    expected = [
        [
            str(int(parameter)),
            parameter.name.lower(),
            f"{format_number(allowed.low)} to {format_number(allowed.high)}",
            allowed.unit,
            "yes" if allowed.writable else "no",
        ]
        for parameter, allowed in PARAMETERS.items()
    ]
    assert [row[:5] for row in read_table("Parameters")] == expected


# --- numbers -----------------------------------------------------------------------------------------------


def test_document_example_of_the_checksum_is_right() -> None:
    frame = commands.make_command(CommandAction.ARM, NODE)
    text = find_section("Checksum")
    assert f"`{frame.id:03X}`" in text
    assert f"`{frame.data.hex(' ').upper()}`" in text
    crc = frame.id
    for byte in frame.data[:-1]:  # as the C code in the page does it
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
        assert f"`{crc:04X}`" in text
    assert crc & 0xFF == frame.data[-1]
    setpoint = load_layouts()[Opcode.SET_POINT].encode(
        NODE, mode=1, count=3, position=-0.5, torque_limit=7.0
    )
    assert f"`{setpoint.data.hex(' ').upper()}`" in find_section("SetPoint")


def test_document_table_of_frame_bits_is_right() -> None:
    table = read_table("Bus load")
    assert table[0][1:] == [str(47 + 8 * length) for length in (1, 3, 4, 5, 6, 7, 8)]
    assert table[1][1:] == [str(compute_max_frame_bits(length)) for length in (1, 3, 4, 5, 6, 7, 8)]


def test_document_table_of_bus_loads_is_right() -> None:
    config = load_scenario("triplet").config
    table = read_table("What fits")
    assert [row[0] for row in table] == ["13", "18", "30"]
    for row in table:
        loads = [
            100 * compute_bus_load(int(row[0]), plan_reports_at(rate, config, CanSettings()))
            for rate in (50, 100, 200)
        ]
        assert row[1:] == [f"{load:.1f} %" + (" refused" if load > 80 else "") for load in loads]


# --- state machine -----------------------------------------------------------------------------------------


def make_module_in_state(state: ModuleState) -> ModuleFirmware:
    """Return a module that has just entered a state, at 1 s."""
    module = ModuleFirmware(
        NODE, 1, ParameterStore(make_factory_defaults(7.0, 7.5)), HeatLimits(80.0, 105.0)
    )
    if state == ModuleState.BOOT:
        module.poll(BOOT_US / 2)
        return module
    module.poll(BOOT_US)
    now_us = 1e6
    module.poll(now_us)
    module.health.speed_rad_s = 1.0
    for action in {
        ModuleState.DISARMED: [],
        ModuleState.ARMED: [CommandAction.ARM],
        ModuleState.STOPPING: [CommandAction.ARM, CommandAction.STOP],
        ModuleState.FAULT: [CommandAction.ARM],
        ModuleState.EMERGENCY: [],
    }[state]:
        module.receive(commands.make_command(action, NODE), now_us)
    if state == ModuleState.FAULT:
        module.poll(now_us + 1e5)
    if state == ModuleState.EMERGENCY:
        module.receive(commands.make_emergency(), now_us)
    assert module.state == state
    module.frames.clear()
    return module


def get_entry_time_us(module: ModuleFirmware) -> float:
    """Return the time in us at which a module entered its state."""
    return {ModuleState.BOOT: BOOT_US / 2, ModuleState.FAULT: 1.1e6}.get(module.state, 1e6)


def make_command_event(action: CommandAction) -> Callable[[ModuleFirmware], None]:
    """Return a function that sends a command to a module."""
    return lambda module: module.receive(
        commands.make_command(action, NODE), get_entry_time_us(module)
    )


def send_emergency(module: ModuleFirmware) -> None:
    module.receive(commands.make_emergency(), get_entry_time_us(module))


def pass_watchdog_time(module: ModuleFirmware) -> None:
    """Let exactly the time of the watchdog pass."""
    module.poll(get_entry_time_us(module) + 99_000)
    module.poll(get_entry_time_us(module) + 100_000)


def come_to_rest(module: ModuleFirmware) -> None:
    module.health.speed_rad_s = 0.0
    module.poll(get_entry_time_us(module))


def send_wrong_counters(module: ModuleFirmware) -> None:
    layout = load_layouts()[Opcode.SET_POINT]
    for _ in range(MAX_WRONG_COUNTS + 1):
        module.receive_setpoint(layout.encode(NODE, mode=0, count=9), get_entry_time_us(module))


def report_leak(module: ModuleFirmware) -> None:
    module.health.leak = True
    module.poll(get_entry_time_us(module))


EVENTS: dict[str, Callable[[ModuleFirmware], None]] = {
    "Command arm": make_command_event(CommandAction.ARM),
    "Command disarm": make_command_event(CommandAction.DISARM),
    "Command stop": make_command_event(CommandAction.STOP),
    "Command clear": make_command_event(CommandAction.CLEAR),
    "Command reboot": make_command_event(CommandAction.REBOOT),
    "Emergency": send_emergency,
    "watchdog's time without a setpoint": pass_watchdog_time,
    "five wrong counters in a row": send_wrong_counters,
    "heat, leak, voltage, sensor": report_leak,
    "at rest": come_to_rest,
}


@pytest.mark.parametrize("event", list(EVENTS))
@pytest.mark.parametrize("state", list(ModuleState))
def test_document_table_of_states_agrees_with_emulated_firmware(
    event: str, state: ModuleState
) -> None:
    table = {row[0]: row[1:] for row in read_table("States and events")}
    assert table["motor"][:2] == ["off", "off"]
    assert set(EVENTS) | {"motor"} == set(table)
    documented = table[event][state]
    module = make_module_in_state(state)
    trigger_event = EVENTS[event]
    trigger_event(module)
    if documented.startswith("after boot"):
        module.poll(2e5)
    expected = next((member for member in ModuleState if member.name in documented), None)
    if state == ModuleState.BOOT and event == "watchdog's time without a setpoint":
        expected = ModuleState.DISARMED  # the module has booted meanwhile
    assert module.state == (state if expected is None else expected)


# --- examples ----------------------------------------------------------------------------------------------


def test_protocol_document_examples_contain_only_defined_frames() -> None:
    lengths = {int(opcode): load_layouts()[opcode].length for opcode in Opcode}
    for identifier, data in re.findall(r"\b([0-9A-F]{3})#([0-9A-F]*)", PAGES):
        frame = CanFrame(int(identifier, 16), bytes.fromhex(data))
        assert lengths[frame.id >> NODE_BITS] == len(frame.data)
