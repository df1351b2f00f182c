#include "local_bus.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum {
    /* The bytes of a record: magic, number of lost frames, id, number of data bytes, three unused bytes, data. Numbers
     * are little-endian. */
    LOST_BYTE = 4,
    ID_BYTE = 8,
    LENGTH_BYTE = 12,
    FIRST_DATA_BYTE = 16,
    NUMBER_BYTES = 4,
    LAST_STANDARD_ID = 0x7FF, /* An id with higher bits is extended. */

    OWNER_ONLY_FOLDER = 0700,
    OWNER_ONLY_FILE = 0600,
    OTHER_USERS = 0077,
    INBOX_BYTES = 1 << 20,
    SET_PIPE_SIZE = 1031, /* F_SETPIPE_SZ: linux/fcntl.h */
    MAX_JOIN_ATTEMPTS = 10,
    INBOX_PATH_BYTES = MAX_PATH_BYTES + MAX_INBOX_NAME_BYTES + 2
};

/* File systems store times in steps of up to 10 ms: a folder that changed just now may change again unnoticed. */
static const double SETTLED_AFTER_S = 0.1;
static const uint8_t MAGIC[] = {'C', 'A', 'N', 1};
static const char INBOX_SUFFIX[] = ".can";

static uint32_t read_number(const uint8_t *bytes)
{
    uint32_t number = 0;
    for (int i = 0; i < NUMBER_BYTES; i++) {
        number |= (uint32_t)bytes[i] << (8 * i);
    }
    return number;
}

static void write_number(uint8_t *bytes, uint32_t number)
{
    for (int i = 0; i < NUMBER_BYTES; i++) {
        bytes[i] = (uint8_t)(number >> (8 * i));
    }
}

static void make_inbox_path(char *path, const local_bus *bus, const char *prefix, const char *name)
{
    snprintf(path, INBOX_PATH_BYTES, "%s/%s%s", bus->folder, prefix, name);
}

/* --- joining --- */

/* Returns whether only this user can enter the folder of the bus. Prints a message otherwise. */
static bool is_private_folder(const local_bus *bus)
{
    struct stat status;
    if (stat(bus->folder, &status) != 0) {
        return true; /* `create_inbox` fails for the same reason. */
    }
    if (!S_ISDIR(status.st_mode) || status.st_uid != geteuid() || (status.st_mode & OTHER_USERS) != 0) {
        fprintf(stderr, "%s: this is no folder that only this user can enter. Name a folder that does not exist\n",
                bus->folder);
        return false;
    }
    return true;
}

/* Creates the inbox. It gets its name when it can be written to. It is open for writing, too, so that it does not end
 * when the last writer leaves it. Returns false, with `errno`, if that is not possible. */
static bool create_inbox(local_bus *bus)
{
    char new_path[INBOX_PATH_BYTES];
    char path[INBOX_PATH_BYTES];
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now); /* In a container, another program may have the same process id. */
    snprintf(bus->inbox_name, sizeof bus->inbox_name, "%ld-%09ld%s", (long)getpid(), now.tv_nsec, INBOX_SUFFIX);
    make_inbox_path(new_path, bus, ".", bus->inbox_name);
    make_inbox_path(path, bus, "", bus->inbox_name);
    if (mkfifo(new_path, OWNER_ONLY_FILE) != 0) {
        return false;
    }
    bus->inbox = open(new_path, O_RDWR | O_NONBLOCK | O_CLOEXEC);
    if (bus->inbox < 0) {
        return false;
    }
    fcntl(bus->inbox, SET_PIPE_SIZE, INBOX_BYTES); /* It stays smaller if this user has too many pipes. */
    return rename(new_path, path) == 0;
}

bool open_bus(local_bus *bus, const char *folder)
{
    memset(bus, 0, sizeof *bus);
    if (strlen(folder) >= sizeof bus->folder) {
        fprintf(stderr, "%s: the path has at most %zu characters\n", folder, sizeof bus->folder - 1);
        return false;
    }
    strcpy(bus->folder, folder);
    for (int i = 0; i < MAX_JOIN_ATTEMPTS; i++) {
        if (mkdir(folder, OWNER_ONLY_FOLDER) != 0 && errno != EEXIST) {
            break;
        }
        if (!is_private_folder(bus)) {
            return false;
        }
        if (create_inbox(bus)) {
            return true;
        }
        if (errno != ENOENT) { /* With ENOENT, the last program has just left, and removed the folder. */
            break;
        }
    }
    fprintf(stderr, "%s: cannot join this bus: %s\n", folder, strerror(errno));
    return false;
}

/* --- other programs --- */

static bool is_inbox_of_other(const local_bus *bus, const char *name)
{
    size_t length = strlen(name);
    size_t suffix_length = sizeof INBOX_SUFFIX - 1;
    return name[0] != '.' && length > suffix_length && length < MAX_INBOX_NAME_BYTES &&
           strcmp(name + length - suffix_length, INBOX_SUFFIX) == 0 && strcmp(name, bus->inbox_name) != 0;
}

static bus_destination *find_destination(local_bus *bus, const char *name)
{
    for (int i = 0; i < bus->destination_count; i++) {
        if (strcmp(bus->destinations[i].name, name) == 0) {
            return &bus->destinations[i];
        }
    }
    return NULL;
}

static void remove_inbox(const local_bus *bus, const char *name)
{
    char path[INBOX_PATH_BYTES];
    make_inbox_path(path, bus, "", name);
    unlink(path);
}

/* Opens the inbox of another program, or removes it if that program was killed. */
static void add_destination(local_bus *bus, const char *name)
{
    if (bus->destination_count == MAX_DESTINATIONS) {
        if (!bus->has_too_many_programs) {
            fprintf(stderr, "%s: these modules send to at most %d programs\n", bus->folder, MAX_DESTINATIONS);
        }
        bus->has_too_many_programs = true;
        return;
    }
    char path[INBOX_PATH_BYTES];
    struct stat status;
    make_inbox_path(path, bus, "", name);
    if (stat(path, &status) != 0 || !S_ISFIFO(status.st_mode)) {
        return; /* a file of another program */
    }
    int descriptor = open(path, O_WRONLY | O_NONBLOCK | O_CLOEXEC);
    if (descriptor < 0) {
        if (errno == ENXIO) { /* No process reads it. */
            remove_inbox(bus, name);
        }
        return;
    }
    bus_destination *destination = &bus->destinations[bus->destination_count];
    memset(destination, 0, sizeof *destination);
    strcpy(destination->name, name);
    destination->descriptor = descriptor;
    destination->is_listed = true;
    bus->destination_count++;
}

static void forget_destination(local_bus *bus, int place)
{
    close(bus->destinations[place].descriptor);
    bus->destination_count--;
    bus->destinations[place] = bus->destinations[bus->destination_count];
}

static void list_folder(local_bus *bus)
{
    for (int i = 0; i < bus->destination_count; i++) {
        bus->destinations[i].is_listed = false;
    }
    DIR *folder = opendir(bus->folder);
    struct dirent *entry;
    while (folder != NULL && (entry = readdir(folder)) != NULL) {
        if (!is_inbox_of_other(bus, entry->d_name)) {
            continue;
        }
        bus_destination *known = find_destination(bus, entry->d_name);
        if (known != NULL) {
            known->is_listed = true;
        } else {
            add_destination(bus, entry->d_name);
        }
    }
    if (folder != NULL) {
        closedir(folder);
    }
    for (int i = bus->destination_count - 1; i >= 0; i--) {
        if (!bus->destinations[i].is_listed) {
            forget_destination(bus, i);
        }
    }
}

/* Finds the programs that have joined or left, by the time when the folder changed. */
static void update_destinations(local_bus *bus)
{
    struct stat status;
    struct timespec now;
    if (stat(bus->folder, &status) != 0) {
        memset(&status, 0, sizeof status); /* The folder is gone, and with it all inboxes. */
    }
    bool is_unchanged =
        status.st_mtim.tv_sec == bus->changed.tv_sec && status.st_mtim.tv_nsec == bus->changed.tv_nsec;
    if (is_unchanged && bus->is_list_settled) {
        return;
    }
    clock_gettime(CLOCK_REALTIME, &now);
    double age_s = (double)(now.tv_sec - status.st_mtim.tv_sec) +
                   1e-9 * (double)(now.tv_nsec - status.st_mtim.tv_nsec);
    bus->changed = status.st_mtim;
    bus->is_list_settled = age_s > SETTLED_AFTER_S;
    list_folder(bus);
}

/* --- frames --- */

/* Reads into the buffer what has arrived, when everything in it is decoded. Returns whether there is something. */
static bool read_records(local_bus *bus)
{
    if (bus->decoded_bytes + RECORD_BYTES <= bus->received_bytes) {
        return true;
    }
    ssize_t count = read(bus->inbox, bus->received, sizeof bus->received);
    bus->received_bytes = count > 0 ? (size_t)count : 0;
    bus->decoded_bytes = 0;
    return count > 0;
}

bool receive_frame(local_bus *bus, jm_frame *frame)
{
    while (read_records(bus)) {
        if (bus->decoded_bytes + RECORD_BYTES > bus->received_bytes) {
            bus->decoded_bytes = bus->received_bytes; /* No program of this bus writes less than a record. */
            continue;
        }
        const uint8_t *record = bus->received + bus->decoded_bytes;
        if (memcmp(record, MAGIC, sizeof MAGIC) != 0) {
            bus->decoded_bytes++;
            continue;
        }
        bus->decoded_bytes += RECORD_BYTES;
        bus->lost_by_modules += read_number(record + LOST_BYTE);
        uint32_t id = read_number(record + ID_BYTE);
        uint8_t length = record[LENGTH_BYTE];
        if (id > LAST_STANDARD_ID || length > JM_MAX_DATA_BYTES) {
            continue;
        }
        frame->id = (uint16_t)id;
        frame->length = length;
        memcpy(frame->data, record + FIRST_DATA_BYTE, JM_MAX_DATA_BYTES);
        return true;
    }
    return false;
}

void send_frame(local_bus *bus, const jm_frame *frame)
{
    uint8_t record[RECORD_BYTES] = {0};
    memcpy(record, MAGIC, sizeof MAGIC);
    write_number(record + ID_BYTE, frame->id);
    record[LENGTH_BYTE] = frame->length;
    memcpy(record + FIRST_DATA_BYTE, frame->data, JM_MAX_DATA_BYTES);
    update_destinations(bus);
    for (int i = bus->destination_count - 1; i >= 0; i--) {
        bus_destination *destination = &bus->destinations[i];
        write_number(record + LOST_BYTE, destination->lost_count);
        ssize_t count = write(destination->descriptor, record, sizeof record); /* all of it or nothing */
        if (count > 0) {
            destination->lost_count = 0;
        } else if (errno == EAGAIN || errno == EINTR) {
            destination->lost_count++;
            bus->lost_by_others++;
        } else {
            remove_inbox(bus, destination->name); /* Its program has ended. */
            forget_destination(bus, i);
        }
    }
}

static void close_destinations(local_bus *bus)
{
    while (bus->destination_count > 0) {
        forget_destination(bus, 0);
    }
}

void close_bus(local_bus *bus)
{
    remove_inbox(bus, bus->inbox_name);
    close_destinations(bus);
    update_destinations(bus); /* which opens all again, but removes those of killed programs */
    close_destinations(bus);
    close(bus->inbox);
    rmdir(bus->folder); /* It stays if another program is on the bus. */
}
