#include "frames.h"

enum { CRC_POLYNOMIAL = 0x1021, CRC_HIGHEST_BIT = 0x8000, BITS_PER_BYTE = 8 };

uint8_t jm_compute_checksum(uint16_t id, const uint8_t *data, uint8_t length)
{
    uint32_t crc = id;
    for (uint8_t i = 0; i < length; i++) {
        crc ^= (uint32_t)data[i] << BITS_PER_BYTE;
        for (uint8_t bit = 0; bit < BITS_PER_BYTE; bit++) {
            bool is_highest_bit_set = (crc & CRC_HIGHEST_BIT) != 0;
            crc = (crc << 1) & 0xFFFF;
            if (is_highest_bit_set) {
                crc ^= CRC_POLYNOMIAL;
            }
        }
    }
    return (uint8_t)(crc & 0xFF);
}

bool jm_has_valid_checksum(const jm_frame *frame)
{
    if (frame->length == 0 || frame->length > JM_MAX_DATA_BYTES) {
        return false;
    }
    uint8_t payload_bytes = (uint8_t)(frame->length - 1);
    return jm_compute_checksum(frame->id, frame->data, payload_bytes) == frame->data[payload_bytes];
}

uint32_t jm_read_bits(const jm_frame *frame, uint8_t start, uint8_t width)
{
    uint64_t bits = 0;
    for (uint8_t i = 0; i < frame->length && i < JM_MAX_DATA_BYTES; i++) {
        bits |= (uint64_t)frame->data[i] << (BITS_PER_BYTE * i);
    }
    uint64_t mask = (UINT64_C(1) << width) - 1;
    return (uint32_t)((bits >> start) & mask);
}

int16_t jm_to_signed_16(uint32_t bits)
{
    int32_t value = (int32_t)(bits & 0xFFFF);
    if (value > INT16_MAX) {
        value -= UINT16_MAX + 1;
    }
    return (int16_t)value;
}

jm_frame jm_make_frame(jm_opcode opcode, uint8_t node, uint8_t length)
{
    jm_frame frame = {0};
    frame.id = (uint16_t)(((uint32_t)opcode << JM_NODE_BITS) | node);
    frame.length = length;
    return frame;
}

void jm_write_bits(jm_frame *frame, uint8_t start, uint8_t width, uint32_t value)
{
    uint64_t mask = (UINT64_C(1) << width) - 1;
    uint64_t bits = ((uint64_t)value & mask) << start;
    for (uint8_t i = 0; i < frame->length; i++) {
        frame->data[i] |= (uint8_t)(bits >> (BITS_PER_BYTE * i));
    }
}

void jm_write_signed(jm_frame *frame, uint8_t start, uint8_t width, int32_t value)
{
    int32_t high = (int32_t)((UINT32_C(1) << (width - 1)) - 1);
    int32_t low = -high - 1;
    jm_write_bits(frame, start, width, (uint32_t)jm_clamp(value, low, high));
}

void jm_write_checksum(jm_frame *frame)
{
    uint8_t payload_bytes = (uint8_t)(frame->length - 1);
    frame->data[payload_bytes] = jm_compute_checksum(frame->id, frame->data, payload_bytes);
}

int32_t jm_clamp(int32_t value, int32_t low, int32_t high)
{
    if (value < low) {
        return low;
    }
    if (value > high) {
        return high;
    }
    return value;
}
