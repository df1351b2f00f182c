"""Our packets and the SDK of ROBOTIS encode and decode each other: CRC, byte stuffing and parsing."""

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
bytes_like_headers = st.lists(st.sampled_from([0x00, 0xFD, 0xFE, 0xFF]), max_size=40).map(
    bytes
) | st.binary(max_size=120)


class RecordingPort:
    """A port of the SDK that records what is written, and returns a prepared answer."""

    def __init__(self, answer: bytes = b"") -> None:
        self.is_using = False
        self.written = b""
        self._answer = answer

    def clearPort(self) -> None:  # noqa: N802
        pass

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self.written += bytes(packet)
        return len(packet)

    def readPort(self, size: int) -> bytes:  # noqa: N802
        data = self._answer[:size]
        self._answer = self._answer[size:]
        return data

    def setPacketTimeout(self, size: int) -> None:  # noqa: N802
        pass

    setPacketTimeoutMillis = setPacketTimeout  # noqa: N815

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return not self._answer


@given(id_=st.integers(0, 252), address=st.integers(0, 600), data=bytes_like_headers.filter(bool))
def test_packet_written_is_stuffed_and_checksummed_as_by_sdk(
    id_: int, address: int, data: bytes
) -> None:
    content = [DynamixelInstruction.WRITE, *address.to_bytes(2, "little"), *data]
    unstuffed = [0xFF, 0xFF, 0xFD, 0, id_, len(content) + 2, 0, *content, 0, 0]
    # `txPacket` of the SDK does not stuff packets that become longer, so this calls `addStuffing` itself.
    stuffed = SDK.addStuffing(unstuffed)
    crc = SDK.updateCRC(0, stuffed, len(stuffed) - 2)
    encoded = encode_packet(id_, DynamixelInstruction.WRITE, bytes(content[1:]))
    assert encoded == bytes(stuffed[:-2]) + crc.to_bytes(2, "little")
    assert next(iter(DynamixelDecoder().feed(encoded))).parameters[2:] == data


@given(
    ids=st.lists(st.integers(0, 252), min_size=1, max_size=20, unique=True), is_fast=st.booleans()
)
def test_sync_requests_and_goals_equal_those_of_the_sdk(ids: list[int], is_fast: bool) -> None:
    port = RecordingPort()
    SDK.syncReadTx(port, 126, 10, ids, len(ids), is_fast)
    assert port.written == encode_sync_read_request(ids, 126, 10, fast=is_fast)
    port = RecordingPort()
    goals = [(id_, bytes([id_, 1, 2, 0xFF])) for id_ in ids]
    values = [byte for id_, data in goals for byte in (id_, *data)]
    SDK.syncWriteTxOnly(port, 116, 4, values, len(values))
    assert port.written == encode_sync_write(116, goals)


@given(
    id_=st.integers(0, 252),
    data=bytes_like_headers,
    noise=st.binary(max_size=8),
    chunk_size=st.integers(1, 30),
)
def test_status_packet_is_decoded_by_sdk_and_our_decoder(
    id_: int, data: bytes, noise: bytes, chunk_size: int
) -> None:
    status = encode_packet(id_, DynamixelInstruction.STATUS, bytes([ALERT]) + data)
    received, result = SDK.rxPacket(RecordingPort(status), False)
    assert result == COMM_SUCCESS
    assert bytes(received[9 : 9 + len(data)]) == data
    assert received[8] == ALERT
    decoder = DynamixelDecoder()
    stream = noise + status
    packets = [
        packet
        for start in range(0, len(stream), chunk_size)
        for packet in decoder.feed(stream[start : start + chunk_size])
    ]
    assert [
        (received_packet.id, received_packet.data, received_packet.alert)
        for received_packet in packets
    ] == [(id_, data, True)]


@given(
    parts=st.lists(
        st.tuples(st.just(0), st.integers(1, 200), bytes_like_headers), min_size=1, max_size=8
    )
)
def test_fast_status_is_decoded_by_sdk_and_our_decoder(parts: list[Any]) -> None:
    size = min(len(data) for _, _, data in parts)
    ids = list(dict.fromkeys(id_ for _, id_, _ in parts))
    parts = [
        (0, id_, bytes([id_, *data[:size]])) for id_, (_, _, data) in zip(ids, parts, strict=False)
    ]
    size += 1
    answer = encode_fast_status(parts, len(parts))
    group = GroupSyncRead(RecordingPort(answer), SDK, 126, size)
    for _, id_, _ in parts:
        group.addParam(id_)
    assert group.fastSyncReadRxPacket() == COMM_SUCCESS
    assert [bytes(group.data_dict[id_]) for _, id_, _ in parts] == [data for _, _, data in parts]
    (packet,) = DynamixelDecoder().feed(answer)
    assert packet.id == BROADCAST_ID
    assert [(status.id, status.data) for status in split_fast_status(packet, size)] == [
        (id_, data) for _, id_, data in parts
    ]
    ends_early = encode_fast_status(parts, len(parts) + 1) + b"\x00"
    assert list(DynamixelDecoder().feed(ends_early)) == []
    intact = [(id_, data) for _, id_, data in parts]
    assert [
        (status.id, status.data) for status in split_damaged_fast_status(ends_early, size)
    ] == intact
    last_is_garbled = answer[:-1] + bytes([answer[-1] ^ 0x10])
    assert [
        (status.id, status.data)
        for status in split_damaged_fast_status(b"\x00" + last_is_garbled, size)
    ] == intact[:-1]


@pytest.mark.parametrize("position", [4, 5, 8, 10, 12])
def test_packet_with_a_changed_byte_is_dropped(position: int) -> None:
    packet = bytearray(encode_packet(7, DynamixelInstruction.WRITE, b"\x74\x00\x10\x20\x30\x40"))
    packet[position] ^= 0x04
    assert list(DynamixelDecoder().feed(bytes(packet))) == []
