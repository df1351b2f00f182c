"""Packets of the Feetech protocol: known bytes, damaged packets, and the sign-magnitude format."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_serial_backend.feetech import registers
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

bytes_like_headers = st.lists(st.sampled_from([0x00, 0xFE, 0xFF]), max_size=20).map(
    bytes
) | st.binary(max_size=60)


def test_encoded_packets_equal_bytes_of_the_protocol() -> None:
    """Compare with packets computed by hand: the checksum is the complement of the sum from the id on."""
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


@given(
    id_=st.integers(0, 253),
    error=st.integers(0, 0x2F),
    data=bytes_like_headers,
    noise=bytes_like_headers,
)
def test_packet_is_found_after_noise_without_header(
    id_: int, error: int, data: bytes, noise: bytes
) -> None:
    decoder = FeetechDecoder()
    noise_without_header = noise.replace(b"\xff", b"\x01")
    packets = list(decoder.feed(noise_without_header + encode_packet(id_, error, data)))
    assert packets == [FeetechPacket(id_, error, data)]
    assert decoder.garbled == bool(noise_without_header)


@given(data=bytes_like_headers, split_at=st.integers(1, 60))
def test_packet_in_pieces_is_found_once(data: bytes, split_at: int) -> None:
    decoder = FeetechDecoder()
    packet = encode_packet(7, 0, data)
    assert [*decoder.feed(packet[:split_at]), *decoder.feed(packet[split_at:])] == [
        FeetechPacket(7, 0, data)
    ]


@given(data=bytes_like_headers, place=st.integers(2, 60), flip=st.integers(1, 255))
def test_damaged_packet_is_not_decoded_as_the_sent_one(data: bytes, place: int, flip: int) -> None:
    packet = bytearray(encode_packet(7, 0, data))
    place = min(place, len(packet) - 1)
    packet[place] ^= flip
    assert FeetechPacket(7, 0, data) not in list(FeetechDecoder().feed(bytes(packet)))


@pytest.mark.parametrize(
    ("value", "bit", "word"),
    [(-1, 15, 0x8001), (100, 15, 100), (-2047, 11, 0xFFF), (-5, 10, 0x405)],
)
def test_sign_magnitude_value_is_encoded_and_decoded(value: int, bit: int, word: int) -> None:
    assert encode_sign_magnitude(value, bit) == word
    assert decode_sign_magnitude(word, bit) == value


def test_angle_conversion_is_centered_and_limited_to_one_revolution() -> None:
    assert registers.to_angle_rad(2048) == 0.0
    assert registers.to_position(0.1) == 2048 + 65
    assert registers.to_position(-9.0) == 0
    assert registers.to_position(9.0) == 4095
