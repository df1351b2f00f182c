"""Packets of Feetech's protocol: known bytes, every damage found, and signs above magnitudes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_serial_backend.feetech import registers as at
from snakesim_serial_backend.feetech.packets import (
    FeetechDecoder,
    FeetechInstruction,
    FeetechPacket,
    decode_sign_magnitude,
    encode_packet,
    encode_sign_magnitude,
    encode_sync_read,
    encode_sync_write,
)

near_header = st.lists(st.sampled_from([0x00, 0xFE, 0xFF]), max_size=20).map(bytes) | st.binary(
    max_size=60
)


def test_packets_are_the_bytes_of_the_protocol() -> None:
    """Each computed by hand: the checksum is the complement of the sum from the id on."""
    assert encode_packet(1, FeetechInstruction.PING).hex(" ") == "ff ff 01 02 01 fb"
    assert (
        encode_packet(1, FeetechInstruction.READ, bytes([56, 2])).hex(" ")
        == "ff ff 01 04 02 38 02 be"
    )
    assert encode_sync_read([1, 2], 56, 8).hex(" ") == "ff ff fe 06 82 38 08 01 02 36"
    assert (
        encode_sync_write(40, [(1, b"\0"), (2, b"\0")]).hex(" ")
        == "ff ff fe 08 83 28 01 01 00 02 00 4a"
    )


@given(id_=st.integers(0, 253), error=st.integers(0, 0x2F), data=near_header, noise=near_header)
def test_packet_is_found_after_noise_without_header(
    id_: int, error: int, data: bytes, noise: bytes
) -> None:
    decoder = FeetechDecoder()
    quiet = noise.replace(b"\xff", b"\x01")
    found = list(decoder.feed(quiet + encode_packet(id_, error, data)))
    assert found == [FeetechPacket(id_, error, data)]
    assert decoder.garbled == bool(quiet)


@given(data=near_header, cut=st.integers(1, 60))
def test_packet_in_pieces_is_found_once(data: bytes, cut: int) -> None:
    decoder = FeetechDecoder()
    packet = encode_packet(7, 0, data)
    assert [*decoder.feed(packet[:cut]), *decoder.feed(packet[cut:])] == [FeetechPacket(7, 0, data)]


@given(data=near_header, place=st.integers(2, 60), flip=st.integers(1, 255))
def test_damaged_packet_is_not_taken_for_the_sent_one(data: bytes, place: int, flip: int) -> None:
    packet = bytearray(encode_packet(7, 0, data))
    place = min(place, len(packet) - 1)
    packet[place] ^= flip
    assert FeetechPacket(7, 0, data) not in list(FeetechDecoder().feed(bytes(packet)))


@pytest.mark.parametrize(
    ("value", "bit", "word"),
    [(-1, 15, 0x8001), (100, 15, 100), (-2047, 11, 0xFFF), (-5, 10, 0x405)],
)
def test_sign_is_a_bit_above_the_magnitude(value: int, bit: int, word: int) -> None:
    assert encode_sign_magnitude(value, bit) == word
    assert decode_sign_magnitude(word, bit) == value


def test_angle_zero_is_the_middle_of_the_count_and_goals_stay_within_a_revolution() -> None:
    assert at.to_angle_rad(2048) == 0.0
    assert at.to_position(0.1) == 2048 + 65
    assert at.to_position(-9.0) == 0
    assert at.to_position(9.0) == 4095
