"""The enumerations and constants of the protocol agree with the DBC file."""

from enum import IntEnum
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_can_backend.protocol.codec import load_database, load_layouts
from snakesim_can_backend.protocol.definitions import (
    FIRST_NODE,
    FROM_HOST,
    LAST_NODE,
    NODE_BITS,
    NODE_MASK,
    WITH_CHECKSUM,
    CanFrame,
    CommandAction,
    EmergencyReason,
    LastStop,
    ModuleFault,
    ModuleParameter,
    ModuleState,
    Opcode,
    ParameterOperation,
    ParameterResult,
    checksum,
    frame_id,
    has_valid_checksum,
)
from snakesim_hal.wire.messages import JointMode

DATABASE = load_database()
ENUMERATIONS: dict[str, type[IntEnum]] = {
    "state": ModuleState,
    "mode": JointMode,
    "action": CommandAction,
    "reason": EmergencyReason,
    "last_stop": LastStop,
    "operation": ParameterOperation,
    "result": ParameterResult,
    "index": ModuleParameter,
}


def test_opcodes_equal_the_messages_of_the_dbc() -> None:
    frame_ids = {message.name: message.frame_id for message in DATABASE.messages}
    assert frame_ids == {
        opcode.name.title().replace("_", ""): opcode << NODE_BITS for opcode in Opcode
    }
    assert max(frame_ids.values()) | NODE_MASK <= 0x7FF


def test_enumerations_equal_the_value_tables_of_the_dbc() -> None:
    tables = {
        (database_message.name, database_signal.name): database_signal.choices
        for database_message in DATABASE.messages
        for database_signal in database_message.signals
        if database_signal.choices
    }
    assert {signal for _, signal in tables} == set(ENUMERATIONS)
    for (message, signal), table in tables.items():
        members = {int(member): member.name.lower() for member in ENUMERATIONS[signal]}
        assert {number: str(name) for number, name in table.items()} == members, (message, signal)


def test_signal_with_a_table_has_no_narrower_range() -> None:
    for message in DATABASE.messages:
        for signal in message.signals:
            if signal.name in ENUMERATIONS:
                assert signal.choices, (message.name, signal.name)
                max_value = max(ENUMERATIONS[signal.name])
                assert float(signal.maximum or 0) >= max_value and max_value < 1 << signal.length, (
                    message.name,
                    signal.name,
                )


def test_fault_bits_of_the_heartbeat_are_in_order() -> None:
    signals = load_layouts()[Opcode.HEARTBEAT].signals
    first_bit = signals["fault_watchdog"].shift
    positions = {
        name: signal.shift - first_bit
        for name, signal in signals.items()
        if name.startswith("fault_")
    }
    assert positions == {f"fault_{fault.name.lower()}": int(fault) for fault in ModuleFault}


def test_protocol_messages_have_the_declared_direction() -> None:
    for message in DATABASE.messages:
        is_from_host = Opcode(message.frame_id >> NODE_BITS) in FROM_HOST
        assert message.senders == (["Host"] if is_from_host else ["Module"]), message.name
        assert message.receivers == ({"Module"} if is_from_host else {"Host"}), message.name


def test_checksum_is_last_byte_of_messages_that_have_one() -> None:
    for opcode, layout in load_layouts().items():
        assert ("checksum" in layout.signals) == (opcode in WITH_CHECKSUM)
        if opcode in WITH_CHECKSUM:
            signal = layout.signals["checksum"]
            assert signal.shift == 8 * layout.length - 8
            assert signal.bits == 8


def test_signals_of_a_message_overlap_only_for_setpoint_targets() -> None:
    for opcode, layout in load_layouts().items():
        for first, second in combinations(layout.signals.values(), 2):
            shared_bits = (first.mask << first.shift) & (second.mask << second.shift)
            are_targets = opcode == Opcode.SET_POINT and {first.name, second.name} <= {
                "position",
                "velocity",
                "torque",
            }
            assert bool(shared_bits) == are_targets, (opcode, first.name, second.name)
            assert (first.mask << first.shift).bit_length() <= 8 * layout.length


# --- checksum ----------------------------------------------------------------------------------------------


def make_frame_with_checksum(opcode: Opcode, node: int, payload: bytes) -> CanFrame:
    """Return a frame with its checksum."""
    identifier = frame_id(opcode, node)
    data = payload[: load_layouts()[opcode].length - 1]
    return CanFrame(identifier, data + bytes((checksum(identifier, data),)))


@pytest.mark.parametrize("opcode", sorted(WITH_CHECKSUM))
@given(node=st.integers(FIRST_NODE, LAST_NODE), payload=st.binary(min_size=7, max_size=7))
def test_checksum_detects_every_single_bit_error_and_wrong_node(
    opcode: Opcode, node: int, payload: bytes
) -> None:
    frame = make_frame_with_checksum(opcode, node, payload)
    assert has_valid_checksum(frame)
    number = int.from_bytes(frame.data, "little")
    for bit in range(8 * len(frame.data)):
        damaged = (number ^ 1 << bit).to_bytes(len(frame.data), "little")
        assert not has_valid_checksum(CanFrame(frame.id, damaged)), bit
    for bit in range(11):
        assert not has_valid_checksum(CanFrame(frame.id ^ 1 << bit, frame.data)), bit
    for other in range(NODE_MASK + 1):
        assert has_valid_checksum(CanFrame(frame_id(opcode, other), frame.data)) == (other == node)


def test_messages_with_checksum_have_distinct_lengths() -> None:
    assert len({load_layouts()[opcode].length for opcode in WITH_CHECKSUM}) == len(WITH_CHECKSUM)
