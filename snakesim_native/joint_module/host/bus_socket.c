#include "bus_socket.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

enum {
    /* The bytes of a record: id (little-endian), number of data bytes, three bytes that are not used, data. */
    ID_BYTES = 4,
    LENGTH_BYTE = 4,
    FIRST_DATA_BYTE = 8,
    LAST_STANDARD_ID = 0x7FF, /* An id with higher bits is extended, remote, or an error. */
    ONLY_OWNER = 0177         /* umask: no other user may connect */
};

static bool make_address(struct sockaddr_un *address, const char *path)
{
    memset(address, 0, sizeof *address);
    address->sun_family = AF_UNIX;
    if (strlen(path) >= sizeof address->sun_path) {
        fprintf(stderr, "%s: the path of a socket has at most %zu characters\n", path, sizeof address->sun_path - 1);
        return false;
    }
    strcpy(address->sun_path, path);
    return true;
}

/* Removes the socket of a process that has ended. Returns false if another process listens there. */
static bool remove_old_socket(const struct sockaddr_un *address)
{
    struct stat status;
    if (lstat(address->sun_path, &status) != 0 || !S_ISSOCK(status.st_mode)) {
        return true; /* `bind` reports a file of another kind. */
    }
    int probe = socket(AF_UNIX, SOCK_STREAM, 0);
    bool is_used = connect(probe, (const struct sockaddr *)address, sizeof *address) == 0;
    close(probe);
    if (is_used) {
        fprintf(stderr, "%s: another process emulates modules there. Stop it, or use another path\n",
                address->sun_path);
        return false;
    }
    unlink(address->sun_path);
    return true;
}

bool open_bus(bus_socket *bus, const char *path)
{
    struct sockaddr_un address;
    bus->client = -1;
    bus->received_bytes = 0;
    if (!make_address(&address, path) || !remove_old_socket(&address)) {
        return false;
    }
    bus->listener = socket(AF_UNIX, SOCK_STREAM, 0);
    mode_t earlier_mask = umask(ONLY_OWNER);
    bool is_open = bus->listener >= 0 && bind(bus->listener, (struct sockaddr *)&address, sizeof address) == 0 &&
                   listen(bus->listener, 1) == 0;
    umask(earlier_mask);
    if (!is_open) {
        fprintf(stderr, "%s: cannot listen there: %s\n", path, strerror(errno));
    }
    return is_open;
}

void accept_driver(bus_socket *bus)
{
    if (bus->client < 0) {
        bus->client = accept(bus->listener, NULL, NULL);
        bus->received_bytes = 0;
    }
}

static void disconnect(bus_socket *bus)
{
    close(bus->client);
    bus->client = -1;
}

/* Reads as much of the next record as has arrived. Returns whether the record is complete. */
static bool read_record(bus_socket *bus)
{
    size_t missing_bytes = (size_t)(RECORD_BYTES - bus->received_bytes);
    ssize_t count = recv(bus->client, bus->received + bus->received_bytes, missing_bytes, MSG_DONTWAIT);
    if (count == 0 || (count < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR)) {
        disconnect(bus);
        return false;
    }
    if (count < 0) {
        return false;
    }
    bus->received_bytes += (int)count;
    return bus->received_bytes == RECORD_BYTES;
}

static uint32_t read_id(const uint8_t *record)
{
    uint32_t id = 0;
    for (int i = 0; i < ID_BYTES; i++) {
        id |= (uint32_t)record[i] << (8 * i);
    }
    return id;
}

bool receive_frame(bus_socket *bus, jm_frame *frame)
{
    while (bus->client >= 0 && read_record(bus)) {
        bus->received_bytes = 0;
        uint32_t id = read_id(bus->received);
        uint8_t length = bus->received[LENGTH_BYTE];
        if (id > LAST_STANDARD_ID || length > JM_MAX_DATA_BYTES) {
            continue;
        }
        frame->id = (uint16_t)id;
        frame->length = length;
        memcpy(frame->data, bus->received + FIRST_DATA_BYTE, JM_MAX_DATA_BYTES);
        return true;
    }
    return false;
}

void send_frame(bus_socket *bus, const jm_frame *frame)
{
    uint8_t record[RECORD_BYTES] = {0};
    record[0] = (uint8_t)(frame->id & 0xFF);
    record[1] = (uint8_t)(frame->id >> 8);
    record[LENGTH_BYTE] = frame->length;
    memcpy(record + FIRST_DATA_BYTE, frame->data, JM_MAX_DATA_BYTES);
    size_t sent_bytes = 0;
    while (bus->client >= 0 && sent_bytes < RECORD_BYTES) {
        ssize_t count = send(bus->client, record + sent_bytes, RECORD_BYTES - sent_bytes, MSG_NOSIGNAL | MSG_DONTWAIT);
        if (count > 0) {
            sent_bytes += (size_t)count;
        } else if (errno == EAGAIN && sent_bytes == 0) {
            return; /* The frame is lost, as on a bus without a receiver. */
        } else if (errno != EAGAIN && errno != EINTR) {
            disconnect(bus);
        }
    }
}

void close_bus(bus_socket *bus, const char *path)
{
    if (bus->client >= 0) {
        close(bus->client);
    }
    close(bus->listener);
    unlink(path);
}
