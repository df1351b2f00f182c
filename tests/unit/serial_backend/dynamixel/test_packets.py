"""Packets against ROBOTIS' own SDK: its CRC, byte stuffing and parsing, in both directions."""

from typing import Any

import pytest
from dynamixel_sdk import COMM_SUCCESS, GroupSyncRead, Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from snakesim_serial_backend.dynamixel.packets import (
    ALERT,
    BROADCAST_ID,
    DynamixelDecoder,
    DynamixelInstruction,
    encode_fast_status,
    encode_packet,
    encode_sync_read_request,
    encode_sync_write,
    split_damaged_fast_status,
    split_fast_status,
)

SDK = Protocol2PacketHandler()
near_header = st.lists(st.sampled_from([0x00, 0xFD, 0xFE, 0xFF]), max_size=40).map(
    bytes
) | st.binary(max_size=120)


class Line:
    """A port of the SDK: takes what it writes, and gives what it is to read."""

    def __init__(self, answer: bytes = b"") -> None:
        self.is_using = False
        self.written, self._answer = b"", answer

    def clearPort(self) -> None:  # noqa: N802
        pass

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self.written += bytes(packet)
        return len(packet)

    def readPort(self, size: int) -> bytes:  # noqa: N802
        given, self._answer = self._answer[:size], self._answer[size:]
        return given

    def setPacketTimeout(self, size: int) -> None:  # noqa: N802
        pass

    setPacketTimeoutMillis = setPacketTimeout  # noqa: N815

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return not self._answer


@given(id_=st.integers(0, 252), address=st.integers(0, 600), data=near_header.filter(bool))
def test_packet_written_is_stuffed_and_checksummed_as_by_sdk(
    id_: int, address: int, data: bytes
) -> None:
    inside = [DynamixelInstruction.WRITE, *address.to_bytes(2, "little"), *data]
    plain = [0xFF, 0xFF, 0xFD, 0, id_, len(inside) + 2, 0, *inside, 0, 0]
    # Its `txPacket` sends unstuffed what stuffing would make longer; so `addStuffing` itself is asked.
    stuffed = SDK.addStuffing(plain)
    crc = SDK.updateCRC(0, stuffed, len(stuffed) - 2)
    ours = encode_packet(id_, DynamixelInstruction.WRITE, bytes(inside[1:]))
    assert ours == bytes(stuffed[:-2]) + crc.to_bytes(2, "little")
    assert next(iter(DynamixelDecoder().feed(ours))).parameters[2:] == data


@given(ids=st.lists(st.integers(0, 252), min_size=1, max_size=20, unique=True), fast=st.booleans())
def test_questions_and_goals_of_several_are_those_of_the_sdk(ids: list[int], fast: bool) -> None:
    line = Line()
    SDK.syncReadTx(line, 126, 10, ids, len(ids), fast)
    assert line.written == encode_sync_read_request(ids, 126, 10, fast=fast)
    line = Line()
    each = [(id_, bytes([id_, 1, 2, 0xFF])) for id_ in ids]
    values = [byte for id_, data in each for byte in (id_, *data)]
    SDK.syncWriteTxOnly(line, 116, 4, values, len(values))
    assert line.written == encode_sync_write(116, each)


@given(
    id_=st.integers(0, 252), data=near_header, noise=st.binary(max_size=8), cut=st.integers(1, 30)
)
def test_packet_answers_are_read_by_sdk_and_by_us(
    id_: int, data: bytes, noise: bytes, cut: int
) -> None:
    status = encode_packet(id_, DynamixelInstruction.STATUS, bytes([ALERT]) + data)
    said, result = SDK.rxPacket(Line(status), False)
    assert result == COMM_SUCCESS
    assert bytes(said[9 : 9 + len(data)]) == data
    assert said[8] == ALERT
    decoder, stream = DynamixelDecoder(), noise + status
    found = [
        packet
        for at in range(0, len(stream), cut)
        for packet in decoder.feed(stream[at : at + cut])
    ]
    assert [(one.id, one.data, one.alert) for one in found] == [(id_, data, True)]


@given(
    parts=st.lists(st.tuples(st.just(0), st.integers(1, 200), near_header), min_size=1, max_size=8)
)
def test_fast_answer_is_read_by_sdk_and_to_its_end(parts: list[Any]) -> None:
    size = min(len(data) for _, _, data in parts)
    ids = list(dict.fromkeys(id_ for _, id_, _ in parts))
    parts = [
        (0, id_, bytes([id_, *data[:size]])) for id_, (_, _, data) in zip(ids, parts, strict=False)
    ]
    size += 1
    answer = encode_fast_status(parts, len(parts))
    group = GroupSyncRead(Line(answer), SDK, 126, size)
    for _, id_, _ in parts:
        group.addParam(id_)
    assert group.fastSyncReadRxPacket() == COMM_SUCCESS
    assert [bytes(group.data_dict[id_]) for _, id_, _ in parts] == [data for _, _, data in parts]
    (packet,) = DynamixelDecoder().feed(answer)
    assert packet.id == BROADCAST_ID
    assert [(one.id, one.data) for one in split_fast_status(packet, size)] == [
        (id_, data) for _, id_, data in parts
    ]
    ends_early = encode_fast_status(parts, len(parts) + 1) + b"\x00"
    assert list(DynamixelDecoder().feed(ends_early)) == []
    intact = [(id_, data) for _, id_, data in parts]
    assert [(one.id, one.data) for one in split_damaged_fast_status(ends_early, size)] == intact
    last_is_garbled = answer[:-1] + bytes([answer[-1] ^ 0x10])
    assert [
        (one.id, one.data) for one in split_damaged_fast_status(b"\x00" + last_is_garbled, size)
    ] == intact[:-1]


@pytest.mark.parametrize("at", [4, 5, 8, 10, 12])
def test_a_changed_byte_is_noticed(at: int) -> None:
    packet = bytearray(encode_packet(7, DynamixelInstruction.WRITE, b"\x74\x00\x10\x20\x30\x40"))
    packet[at] ^= 0x04
    assert list(DynamixelDecoder().feed(bytes(packet))) == []
