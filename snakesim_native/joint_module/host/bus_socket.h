/* The bus: a Unix stream socket that carries the 16 bytes of the kernel's `struct can_frame` for each frame.
 *
 * It works on kernels without CAN. To use SocketCAN instead, open a raw CAN socket here: the bytes are the same.
 */
#ifndef BUS_SOCKET_H
#define BUS_SOCKET_H

#include "../firmware/joint_module.h"

enum { RECORD_BYTES = 16 };

/* The modules' end of a bus. */
typedef struct {
    int listener; /* file descriptor, on which the driver connects */
    int client;   /* file descriptor of the connected driver, -1 without one */
    uint8_t received[RECORD_BYTES];
    int received_bytes; /* of a record that is not complete yet */
} bus_socket;

/* Listens at a path. A socket that an earlier process left there is replaced. Prints a message, and returns false, if
 * that is not possible. */
bool open_bus(bus_socket *bus, const char *path);

/* Accepts a driver that waits, if none is connected. */
void accept_driver(bus_socket *bus);

/* Takes a received frame. Returns false if no complete frame waits. Never blocks. */
bool receive_frame(bus_socket *bus, jm_frame *frame);

/* Sends a frame. It is lost without a driver, or if the driver does not read. */
void send_frame(bus_socket *bus, const jm_frame *frame);

/* Closes the bus, and removes the socket. */
void close_bus(bus_socket *bus, const char *path);

#endif
