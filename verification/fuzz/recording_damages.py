"""Damages a recording in nine ways, each drawn from a random generator: the same numbers give the same damage."""

import random
import struct
from collections.abc import Callable

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from snakesim_operator.recording.mcap_format.chunks import RECORD_HEADER, unpack_chunk
from snakesim_testing.operator.damaged_recordings import (
    flip_bit,
    list_chunks,
    list_records,
    make_chunk_record,
)

Damage = Callable[[random.Random, bytes], bytes]

MAGIC_BYTES = len(MCAP0_MAGIC)  # no damage changes them: without them, the file is no MCAP file
IMPLAUSIBLE_NUMBERS = (0, 1, 2**16, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
IMPLAUSIBLE_TIMES_NS = (*IMPLAUSIBLE_NUMBERS, 10**9, 2**61)
BOMB_BYTES = 60_000_000  # that one small chunk unpacks to

# Bytes from the begin of a record to its fields.
LENGTH_OFFSET = 1
CHUNK_CONTENT_OFFSET = RECORD_HEADER.size
CHUNK_FIELD_OFFSETS = (0, 8, 16, 40)  # first time, last time, unpacked size, packed size
# Bytes from the begin of a message's content to its fields.
SEQUENCE_OFFSET = 2
LOG_TIME_OFFSET = 6
PAYLOAD_OFFSET = 22
MAX_CHANNEL = 40  # more than a recording has


def flip_bits(chance: random.Random, content: bytes) -> bytes:
    """Flip one to twenty bits anywhere behind the magic."""
    for _ in range(chance.choice((1, 1, 3, 20))):
        content = flip_bit(content, _choose_position(chance, content))
    return content


def cut_off_end(chance: random.Random, content: bytes) -> bytes:
    """Remove everything behind a random byte."""
    return content[: _choose_position(chance, content)]


def remove_or_clear_span(chance: random.Random, content: bytes) -> bytes:
    """Remove a part of the content, or replace it by zeros."""
    begin = _choose_position(chance, content)
    end = min(begin + chance.choice((1, 100, 50_000)), len(content))
    zeros = bytes(end - begin) * chance.randrange(2)
    return content[:begin] + zeros + content[end:]


def swap_or_repeat_chunks(chance: random.Random, content: bytes) -> bytes:
    """Exchange two chunks, or write the earlier one also in place of the later one."""
    chunks = chance.sample(list_chunks(content), 2)
    earlier, later = sorted(chunks, key=lambda chunk: chunk.begin)
    earlier_bytes = content[earlier.begin : earlier.end]
    later_bytes = content[later.begin : later.end]
    if chance.random() < 0.3:
        later_bytes = earlier_bytes
    between = content[earlier.end : later.begin]
    head = content[: earlier.begin]
    tail = content[later.end :]
    return head + later_bytes + between + earlier_bytes + tail


def change_record_header(chance: random.Random, content: bytes) -> bytes:
    """Replace a length, size, time or opcode of a record by a wrong one."""
    record = chance.choice([*list_records(content), *list_chunks(content)])
    position = record.begin + LENGTH_OFFSET
    number_format = "<Q"
    if record.opcode == Opcode.CHUNK:
        offsets = [CHUNK_CONTENT_OFFSET + offset for offset in CHUNK_FIELD_OFFSETS]
        position = record.begin + chance.choice([LENGTH_OFFSET, *offsets])
    elif chance.random() < 0.2:
        position = record.begin
        number_format = "<B"
    size_bytes = struct.calcsize(number_format)
    wrong_numbers = (*IMPLAUSIBLE_NUMBERS, len(content), record.end - record.begin)
    wrong_number = chance.choice(wrong_numbers) % 256**size_bytes
    wrong_bytes = struct.pack(number_format, wrong_number)
    return content[:position] + wrong_bytes + content[position + size_bytes :]


def insert_foreign_record(chance: random.Random, content: bytes) -> bytes:
    """Insert a record that no recorder writes: a bomb, a bad compression, or an implausible length."""
    position = chance.choice(list_records(content)).begin
    bombs = make_chunk_record(bytes(BOMB_BYTES)) * chance.choice((1, 30))
    endless_message = RECORD_HEADER.pack(Opcode.MESSAGE, 2**40)
    unknown_header = RECORD_HEADER.pack(chance.randrange(256), chance.choice(IMPLAUSIBLE_NUMBERS))
    foreign_records = (
        bombs,
        make_chunk_record(b"abc", "lz4", b"no such thing"),
        make_chunk_record(b"abc", "snappy"),
        make_chunk_record(endless_message),
        unknown_header + bytes(40),
    )
    return content[:position] + chance.choice(foreign_records) + content[position:]


def forge_messages(chance: random.Random, content: bytes) -> bytes:
    """Change messages in a chunk, and give the chunk the right checksum again."""
    chunk = chance.choice(list_chunks(content))
    messages = unpack_chunk(content[chunk.begin + CHUNK_CONTENT_OFFSET : chunk.end])
    positions = [
        record.begin + RECORD_HEADER.size
        for record in list_records(messages, magic_bytes=0)
        if record.opcode == Opcode.MESSAGE
    ]
    forged_count = min(len(positions), chance.choice((1, 5, 50)))
    for position in chance.sample(positions, forged_count):
        _forge_message(chance, messages, position)
    forged_chunk = make_chunk_record(bytes(messages))
    return content[: chunk.begin] + forged_chunk + content[chunk.end :]


def _forge_message(chance: random.Random, messages: bytearray, position: int) -> None:
    """Change the channel, the sequence number, the time or the payload of one message in place."""
    match chance.randrange(4):
        case 0:
            struct.pack_into("<H", messages, position, chance.randrange(MAX_CHANNEL))
        case 1:
            sequence = chance.choice(IMPLAUSIBLE_NUMBERS) % 2**32
            struct.pack_into("<I", messages, position + SEQUENCE_OFFSET, sequence)
        case 2:
            log_time_ns = chance.choice(IMPLAUSIBLE_TIMES_NS)
            struct.pack_into("<Q", messages, position + LOG_TIME_OFFSET, log_time_ns)
        case _:
            _, length = RECORD_HEADER.unpack_from(messages, position - RECORD_HEADER.size)
            payload_bytes = max(length - PAYLOAD_OFFSET, 1)
            for _ in range(chance.choice((1, 8))):
                wrong_byte = chance.randrange(256)
                offset = chance.randrange(payload_bytes)
                messages[position + PAYLOAD_OFFSET + offset] = wrong_byte


def replace_by_noise(chance: random.Random, _content: bytes) -> bytes:
    """Replace everything behind the magic by random bytes."""
    return MCAP0_MAGIC + chance.randbytes(chance.choice((0, 1, 500, 100_000)))


def leave_undamaged(_chance: random.Random, content: bytes) -> bytes:
    """Return the recording as it is: no command may report a loss in it."""
    return content


DAMAGES: tuple[Damage, ...] = (
    flip_bits,
    cut_off_end,
    remove_or_clear_span,
    swap_or_repeat_chunks,
    change_record_header,
    insert_foreign_record,
    forge_messages,
    replace_by_noise,
    leave_undamaged,
)


def _choose_position(chance: random.Random, content: bytes) -> int:
    return chance.randrange(MAGIC_BYTES, len(content))
