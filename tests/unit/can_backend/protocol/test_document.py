"""The pages `docs/reference/can-*.md` say what the DBC file, the parameters and the emulators' firmware say."""

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
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in sorted(REFERENCE.glob("can-*.md")))
NODE = 5


def section(heading: str) -> str:
    """The text under a heading, up to the next one."""
    found = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", TEXT, re.MULTILINE | re.DOTALL)
    assert found, f"docs/reference/can-*.md have no heading {heading!r}"
    return found[1]


def rows(heading: str) -> list[list[str]]:
    """The first table under a heading, without its head; code marks and links are taken off."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", section(heading))
    first = text.partition("\n|")[2].partition("\n\n")[0]
    lines = ["|" + line.removeprefix("|") for line in first.splitlines()]
    return [[cell.strip().replace("`", "") for cell in line[1:-1].split("|")] for line in lines[2:]]


def number(value: float) -> str:
    return f"{value:.6g}"


# --- layouts -----------------------------------------------------------------------------------------------


def message_row(opcode: Opcode) -> list[str]:
    layout = load_layouts()[opcode]
    first = opcode << NODE_BITS
    to_all = opcode in (Opcode.EMERGENCY, Opcode.COMMAND, Opcode.SYNC)
    to_one = opcode not in (Opcode.EMERGENCY, Opcode.SYNC)
    low, high = (first if to_all else first + FIRST_NODE), (first + LAST_NODE if to_one else first)
    ids = f"{low:03X}" if low == high else f"{low:03X}–{high:03X}"
    return [
        layout.name,
        str(int(opcode)),
        ids,
        "host" if opcode in FROM_HOST else "module",
        str(layout.length),
    ]


def signal_rows(opcode: Opcode) -> list[list[str]]:
    found = []
    for signal in sorted(load_layouts()[opcode].signals.values(), key=lambda s: (s.shift, s.name)):
        last = signal.shift + signal.bits - 1
        bits = str(signal.shift) if signal.bits == 1 else f"{signal.shift}–{last}"
        kind = "float" if signal.is_float else "signed" if signal.signed else "unsigned"
        step = "" if signal.is_float else number(signal.scale)
        zero = f", raw 0 is {number(signal.offset)}" if signal.offset else ""
        found.append(
            [
                *(
                    signal.name,
                    bits,
                    kind,
                    step + zero,
                    f"{number(signal.low)} to {number(signal.high)}",
                ),
                signal.unit.replace("N.m", "N·m").replace("m/s^2", "m/s²").replace("degC", "°C"),
            ]
        )
    return found


def test_the_table_of_messages() -> None:
    assert [row[:5] for row in rows("Messages")] == [message_row(opcode) for opcode in Opcode]


@pytest.mark.parametrize("opcode", list(Opcode))
def test_the_layout_of_every_message(opcode: Opcode) -> None:
    assert [row[:6] for row in rows(load_layouts()[opcode].name)] == signal_rows(opcode)


def test_every_number_that_has_a_name_is_listed() -> None:
    for message in load_database().messages:
        for signal in message.signals:
            if signal.choices and signal.name != "index":  # those are the parameters
                listed = ", ".join(
                    f"{value} {name}" for value, name in sorted(signal.choices.items())
                )
                assert f"`{signal.name}`: {listed}" in TEXT, signal.name


def test_the_table_of_parameters() -> None:
    expected = [
        [
            *(
                str(int(parameter)),
                parameter.name.lower(),
                f"{number(allowed.low)} to {number(allowed.high)}",
            ),
            *(allowed.unit, "yes" if allowed.writable else "no"),
        ]
        for parameter, allowed in PARAMETERS.items()
    ]
    assert [row[:5] for row in rows("Parameters")] == expected


# --- numbers -----------------------------------------------------------------------------------------------


def test_the_worked_example_of_the_checksum() -> None:
    frame = commands.make_command(CommandAction.ARM, NODE)
    text = section("Checksum")
    assert f"`{frame.id:03X}`" in text
    assert f"`{frame.data.hex(' ').upper()}`" in text
    crc = frame.id
    for byte in frame.data[:-1]:  # as the C code there does it
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
        assert f"`{crc:04X}`" in text
    assert crc & 0xFF == frame.data[-1]
    setpoint = load_layouts()[Opcode.SET_POINT].encode(
        NODE, mode=1, count=3, position=-0.5, torque_limit=7.0
    )
    assert f"`{setpoint.data.hex(' ').upper()}`" in section("SetPoint")


def test_the_bits_of_a_frame() -> None:
    table = rows("Bus load")
    assert table[0][1:] == [str(47 + 8 * length) for length in (1, 3, 4, 5, 6, 7, 8)]
    assert table[1][1:] == [str(compute_max_frame_bits(length)) for length in (1, 3, 4, 5, 6, 7, 8)]


def test_the_table_of_loads() -> None:
    config = load_scenario("triplet").config
    found = rows("What fits")
    assert [row[0] for row in found] == ["13", "18", "30"]
    for row in found:
        loads = [
            100 * compute_bus_load(int(row[0]), plan_reports_at(rate, config, CanSettings()))
            for rate in (50, 100, 200)
        ]
        assert row[1:] == [f"{share:.1f} %" + (" refused" if share > 80 else "") for share in loads]


# --- state machine -----------------------------------------------------------------------------------------


def module_in(state: ModuleState) -> ModuleFirmware:
    """A module that has just come to be in a state, at 1 s."""
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
    for opened_by in {
        ModuleState.DISARMED: [],
        ModuleState.ARMED: [CommandAction.ARM],
        ModuleState.STOPPING: [CommandAction.ARM, CommandAction.STOP],
        ModuleState.FAULT: [CommandAction.ARM],
        ModuleState.EMERGENCY: [],
    }[state]:
        module.receive(commands.make_command(opened_by, NODE), now_us)
    if state == ModuleState.FAULT:
        module.poll(now_us + 1e5)
    if state == ModuleState.EMERGENCY:
        module.receive(commands.make_emergency(), now_us)
    assert module.state == state
    module.frames.clear()
    return module


def now_of(module: ModuleFirmware) -> float:
    return {ModuleState.BOOT: BOOT_US / 2, ModuleState.FAULT: 1.1e6}.get(module.state, 1e6)


def command(action: CommandAction) -> Callable[[ModuleFirmware], None]:
    return lambda module: module.receive(commands.make_command(action, NODE), now_of(module))


def emergency(module: ModuleFirmware) -> None:
    module.receive(commands.make_emergency(), now_of(module))


def time_passes(module: ModuleFirmware) -> None:
    """The watchdog's time, and no more than that."""
    module.poll(now_of(module) + 99_000)
    module.poll(now_of(module) + 100_000)


def rest(module: ModuleFirmware) -> None:
    module.health.speed_rad_s = 0.0
    module.poll(now_of(module))


def wrong_counts(module: ModuleFirmware) -> None:
    layout = load_layouts()[Opcode.SET_POINT]
    for _ in range(MAX_WRONG_COUNTS + 1):
        module.receive_setpoint(layout.encode(NODE, mode=0, count=9), now_of(module))


def leak(module: ModuleFirmware) -> None:
    module.health.leak = True
    module.poll(now_of(module))


EVENTS: dict[str, Callable[[ModuleFirmware], None]] = {
    "Command arm": command(CommandAction.ARM),
    "Command disarm": command(CommandAction.DISARM),
    "Command stop": command(CommandAction.STOP),
    "Command clear": command(CommandAction.CLEAR),
    "Command reboot": command(CommandAction.REBOOT),
    "Emergency": emergency,
    "watchdog's time without a setpoint": time_passes,
    "five wrong counters in a row": wrong_counts,
    "heat, leak, voltage, sensor": leak,
    "at rest": rest,
}


@pytest.mark.parametrize("event", list(EVENTS))
@pytest.mark.parametrize("state", list(ModuleState))
def test_the_firmware_of_the_twins_does_what_the_table_says(event: str, state: ModuleState) -> None:
    table = {row[0]: row[1:] for row in rows("States and events")}
    assert table["motor"][:2] == ["off", "off"]
    assert set(EVENTS) | {"motor"} == set(table)
    said = table[event][state]
    module = module_in(state)
    happens = EVENTS[event]
    happens(module)
    if said.startswith("after boot"):
        module.poll(2e5)
    expected = next((s for s in ModuleState if s.name in said), None)
    if state == ModuleState.BOOT and event == "watchdog's time without a setpoint":
        expected = ModuleState.DISARMED  # boot is over meanwhile
    assert module.state == (state if expected is None else expected)


# --- pictures and neighbors -------------------------------------------------------------------------------


def test_protocol_document_examples_contain_only_defined_frames() -> None:
    lengths = {int(opcode): load_layouts()[opcode].length for opcode in Opcode}
    for identifier, data in re.findall(r"\b([0-9A-F]{3})#([0-9A-F]*)", TEXT):
        frame = CanFrame(int(identifier, 16), bytes.fromhex(data))
        assert lengths[frame.id >> NODE_BITS] == len(frame.data)
