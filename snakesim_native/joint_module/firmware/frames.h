/* The frames of the protocol: ids, checksum, and the packing of signals. Private to the firmware. */
#ifndef JOINT_MODULE_FRAMES_H
#define JOINT_MODULE_FRAMES_H

#include "joint_module.h"

/* The kind of a message: the upper five bits of an id. */
typedef enum {
    JM_OPCODE_EMERGENCY = 0,
    JM_OPCODE_COMMAND = 1,
    JM_OPCODE_SYNC = 2,
    JM_OPCODE_SET_POINT = 3,
    JM_OPCODE_JOINT_STATE = 4,
    JM_OPCODE_CONTACT = 5,
    JM_OPCODE_TAIL_CONTACT = 6,
    JM_OPCODE_HEARTBEAT = 7,
    JM_OPCODE_GYRO = 8,
    JM_OPCODE_ACCELEROMETER = 9,
    JM_OPCODE_SHAFT_LOAD = 10,
    JM_OPCODE_HEALTH = 11,
    JM_OPCODE_IDENTITY = 12,
    JM_OPCODE_PARAMETER_ANSWER = 13,
    JM_OPCODE_PARAMETER_REQUEST = 16
} jm_opcode;

enum {
    JM_BROADCAST = 0, /* node of frames to all modules */
    JM_NODE_BITS = 6,
    JM_NODE_MASK = 0x3F,
    JM_LAST_ID = 0x7FF, /* of 11 bits */

    JM_COMMAND_BYTES = 4,
    JM_SYNC_BYTES = 5,
    JM_SET_POINT_BYTES = 6,
    JM_PARAMETER_BYTES = 6
};

/* Returns the checksum of a frame: the low byte of CRC-16/XMODEM over `length` bytes, with the id as initial value. */
uint8_t jm_compute_checksum(uint16_t id, const uint8_t *data, uint8_t length);

/* Returns whether the last byte of a frame is the checksum of the others. A frame without data has none. */
bool jm_has_valid_checksum(const jm_frame *frame);

/* Returns an unsigned signal of a received frame: `width` bits from bit `start` on, at most 32. */
uint32_t jm_read_bits(const jm_frame *frame, uint8_t start, uint8_t width);

/* Returns a number of 16 bits as a signed one. */
int16_t jm_to_signed_16(uint32_t bits);

/* Returns a frame of a node whose data are all 0. */
jm_frame jm_make_frame(jm_opcode opcode, uint8_t node, uint8_t length);

/* Writes an unsigned signal of at most 32 bits. Bits above `width` are dropped. */
void jm_write_bits(jm_frame *frame, uint8_t start, uint8_t width, uint32_t value);

/* Writes a signed signal of at most 31 bits. A value beyond its range becomes the end of the range. */
void jm_write_signed(jm_frame *frame, uint8_t start, uint8_t width, int32_t value);

/* Writes the checksum into the last byte. */
void jm_write_checksum(jm_frame *frame);

/* Returns a value, or the bound that it is beyond. */
int32_t jm_clamp(int32_t value, int32_t low, int32_t high);

#endif
