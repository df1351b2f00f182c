"""The numbers of the protocol are those of the DBC file."""

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
NAMED: dict[str, type[IntEnum]] = {
    "state": ModuleState,
    "mode": JointMode,
    "action": CommandAction,
    "reason": EmergencyReason,
    "last_stop": LastStop,
    "operation": ParameterOperation,
    "result": ParameterResult,
    "index": ModuleParameter,
}


def test_every_opcode_is_a_message_of_the_same_name() -> None:
    found = {message.name: message.frame_id for message in DATABASE.messages}
    assert found == {opcode.name.title().replace("_", ""): opcode << NODE_BITS for opcode in Opcode}
    assert max(found.values()) | NODE_MASK <= 0x7FF


def test_every_enumeration_is_a_value_table() -> None:
    tables = {
        (m.name, s.name): s.choices for m in DATABASE.messages for s in m.signals if s.choices
    }
    assert {signal for _, signal in tables} == set(NAMED)
    for (message, signal), table in tables.items():
        ours = {int(member): member.name.lower() for member in NAMED[signal]}
        assert {number: str(name) for number, name in table.items()} == ours, (message, signal)


def test_signal_with_a_table_has_no_narrower_range() -> None:
    for message in DATABASE.messages:
        for signal in message.signals:
            if signal.name in NAMED:
                assert signal.choices, (message.name, signal.name)
                most = max(NAMED[signal.name])
                assert float(signal.maximum or 0) >= most and most < 1 << signal.length, (
                    message.name,
                    signal.name,
                )


def test_fault_bits_stand_in_the_heartbeat_in_their_order() -> None:
    signals = load_layouts()[Opcode.HEARTBEAT].signals
    first = signals["fault_watchdog"].shift
    found = {
        name: signal.shift - first for name, signal in signals.items() if name.startswith("fault_")
    }
    assert found == {f"fault_{fault.name.lower()}": int(fault) for fault in ModuleFault}


def test_protocol_messages_have_the_declared_direction() -> None:
    for message in DATABASE.messages:
        host = Opcode(message.frame_id >> NODE_BITS) in FROM_HOST
        assert message.senders == (["Host"] if host else ["Module"]), message.name
        assert message.receivers == ({"Module"} if host else {"Host"}), message.name


def test_checksum_is_last_byte_of_messages_that_have_one() -> None:
    for opcode, layout in load_layouts().items():
        assert ("checksum" in layout.signals) == (opcode in WITH_CHECKSUM)
        if opcode in WITH_CHECKSUM:
            signal = layout.signals["checksum"]
            assert signal.shift == 8 * layout.length - 8
            assert signal.bits == 8


def test_signals_of_a_message_overlap_only_for_setpoint_targets() -> None:
    for opcode, layout in load_layouts().items():
        for a, b in combinations(layout.signals.values(), 2):
            shared = (a.mask << a.shift) & (b.mask << b.shift)
            targets = opcode == Opcode.SET_POINT and {a.name, b.name} <= {
                "position",
                "velocity",
                "torque",
            }
            assert bool(shared) == targets, (opcode, a.name, b.name)
            assert (a.mask << a.shift).bit_length() <= 8 * layout.length


# --- checksum ----------------------------------------------------------------------------------------------


def checked(opcode: Opcode, node: int, payload: bytes) -> CanFrame:
    identifier = frame_id(opcode, node)
    data = payload[: load_layouts()[opcode].length - 1]
    return CanFrame(identifier, data + bytes((checksum(identifier, data),)))


@pytest.mark.parametrize("opcode", sorted(WITH_CHECKSUM))
@given(node=st.integers(FIRST_NODE, LAST_NODE), payload=st.binary(min_size=7, max_size=7))
def test_checksum_detects_every_single_bit_error_and_wrong_node(
    opcode: Opcode, node: int, payload: bytes
) -> None:
    frame = checked(opcode, node, payload)
    assert has_valid_checksum(frame)
    number = int.from_bytes(frame.data, "little")
    for bit in range(8 * len(frame.data)):
        wrong = (number ^ 1 << bit).to_bytes(len(frame.data), "little")
        assert not has_valid_checksum(CanFrame(frame.id, wrong)), bit
    for bit in range(11):
        assert not has_valid_checksum(CanFrame(frame.id ^ 1 << bit, frame.data)), bit
    for other in range(NODE_MASK + 1):
        assert has_valid_checksum(CanFrame(frame_id(opcode, other), frame.data)) == (other == node)


def test_messages_with_checksum_have_distinct_lengths() -> None:
    assert len({load_layouts()[opcode].length for opcode in WITH_CHECKSUM}) == len(WITH_CHECKSUM)
