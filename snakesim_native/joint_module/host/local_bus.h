/* The bus: a folder with an inbox for each program, which is a named pipe. It is the channel `local:FOLDER`.
 *
 * A frame is written into the inboxes of all other programs. A program that does not read loses frames, and delays no
 * other program. `snakesim_can_backend/bus/local_wire.py` is the same bus in Python, and explains it.
 *
 * It works on kernels without CAN. To use SocketCAN instead, open a raw CAN socket here.
 */
#ifndef LOCAL_BUS_H
#define LOCAL_BUS_H

#include <time.h>

#include "../firmware/joint_module.h"

enum {
    RECORD_BYTES = 80,
    READ_RECORDS = 50,
    MAX_PATH_BYTES = 1024,
    MAX_INBOX_NAME_BYTES = 64,
    MAX_DESTINATIONS = 32
};

/* The inbox of another program on the bus. */
typedef struct {
    char name[MAX_INBOX_NAME_BYTES];
    int descriptor;      /* open for writing */
    uint32_t lost_count; /* frames that did not fit since the last frame that did */
    bool is_listed;      /* at the last listing of the folder */
} bus_destination;

/* The modules' end of a bus. */
typedef struct {
    char folder[MAX_PATH_BYTES];
    char inbox_name[MAX_INBOX_NAME_BYTES];
    int inbox; /* file descriptor, on which frames can be waited for */

    /* Bytes that were read, and are not decoded. */
    uint8_t received[READ_RECORDS * RECORD_BYTES];
    size_t received_bytes;
    size_t decoded_bytes;

    /* The other programs on the bus. */
    bus_destination destinations[MAX_DESTINATIONS];
    int destination_count;
    bool has_too_many_programs;
    struct timespec changed; /* when the folder had changed, at the last listing */
    bool is_list_settled;

    /* Statistics. */
    uint64_t lost_by_modules;
    uint64_t lost_by_others;
} local_bus;

/* Joins the bus of a folder, which is created if it does not exist. Prints a message, and returns false, if that is not
 * possible. */
bool open_bus(local_bus *bus, const char *folder);

/* Takes a received frame. Returns false if there is none. Never blocks. */
bool receive_frame(local_bus *bus, jm_frame *frame);

/* Sends a frame to all other programs. A program whose inbox is full loses it. Never blocks. */
void send_frame(local_bus *bus, const jm_frame *frame);

/* Leaves the bus, and removes its folder if no other program is on it. */
void close_bus(local_bus *bus);

#endif
