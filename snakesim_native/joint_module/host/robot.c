#include "robot.h"

#include <string.h>

#include "../firmware/frames.h"

enum {
    BOOT_US = 100000,
    HEARTBEAT_FRAME_US = 135, /* of a frame with 8 bytes at 1 Mbit/s */
    MAX_SYNC_INTERVAL_US = 60000000, /* A Sync that is later by more is of another clock. */
    MIN_HOST_RESTART_US = 1000000    /* A Sync that is earlier by this much is of a restarted host. */
};

static void poll_all(robot *r)
{
    for (int i = 0; i < r->on_bus_count; i++) {
        poll_emulated_module(&r->modules[i], r->now_us);
    }
}

/* The firmware subtracts times. The clock of the modules begins at BOOT_US, so that a module may have booted. */
void start_robot(robot *r, local_bus *bus, bool is_stepped)
{
    r->bus = bus;
    r->is_stepped = is_stepped;
    r->on_bus_count = r->module_count;
    r->now_us = is_stepped ? BOOT_US : 0;
    r->stepped_us = r->now_us;
    for (int i = 0; i < r->module_count; i++) {
        start_module(&r->modules[i], &r->descriptions[i], is_stepped, 0);
    }
    poll_all(r);
}

static void send_all(robot *r)
{
    for (int i = 0; i < r->outgoing_count; i++) {
        send_frame(r->bus, &r->outgoing[i]);
    }
    r->outgoing_count = 0;
}

static void add_outgoing(robot *r, const jm_frame *frame)
{
    if (r->outgoing_count >= MAX_OUTGOING) {
        send_all(r);
    }
    r->outgoing[r->outgoing_count] = *frame;
    r->outgoing_count++;
}

static void collect_frames(robot *r)
{
    jm_frame frame;
    for (int i = 0; i < r->on_bus_count; i++) {
        while (pop_sent_frame(&r->modules[i], &frame)) {
            add_outgoing(r, &frame);
        }
    }
}

void flush_robot(robot *r)
{
    collect_frames(r);
    send_all(r);
}

/* Orders waiting frames as arbitration does: the lowest id first. Frames with one id keep their order. */
static void sort_outgoing(robot *r)
{
    for (int i = 1; i < r->outgoing_count; i++) {
        jm_frame frame = r->outgoing[i];
        int place = i;
        while (place > 0 && r->outgoing[place - 1].id > frame.id) {
            r->outgoing[place] = r->outgoing[place - 1];
            place--;
        }
        r->outgoing[place] = frame;
    }
}

/* Sends as many heartbeats of babbling modules as the bus can carry. */
static void babble(robot *r)
{
    for (int i = 0; i < r->on_bus_count; i++) {
        emulated_module *module = &r->modules[i];
        while (module->is_babbling && module->babbled_us + HEARTBEAT_FRAME_US <= r->now_us) {
            jm_frame frame = jm_make_frame(JM_OPCODE_HEARTBEAT, module->firmware.config.node, 8);
            jm_write_bits(&frame, 0, 4, (uint32_t)module->firmware.state);
            jm_write_bits(&frame, 32, 32, (uint32_t)(r->now_us / 1000));
            add_outgoing(r, &frame);
            module->babbled_us += HEARTBEAT_FRAME_US;
        }
    }
}

void advance_robot(robot *r, uint64_t until_us)
{
    while (r->stepped_us + STEP_US <= until_us) {
        r->stepped_us += STEP_US;
        r->now_us = r->stepped_us;
        for (int i = 0; i < r->module_count; i++) {
            step_module(&r->modules[i], r->now_us);
        }
        poll_all(r);
        babble(r);
        collect_frames(r);
    }
    if (until_us > r->now_us) {
        r->now_us = until_us;
        poll_all(r);
    }
}

void advance_without_host(robot *r, double duration_s)
{
    uint64_t duration_us = (uint64_t)(duration_s * 1e6 + 0.5);
    advance_robot(r, r->now_us + duration_us);
    r->sync_time_us += (uint32_t)duration_us;
}

/* Advances by the time from the Sync before to this one. The first sets zero, as does one of another clock. */
static void advance_to_sync(robot *r, uint32_t time_us)
{
    uint32_t later_us = r->has_sync_time ? time_us - r->sync_time_us : 0;
    uint32_t earlier_us = r->sync_time_us - time_us;
    if (later_us > 0 && later_us <= MAX_SYNC_INTERVAL_US) {
        advance_robot(r, r->now_us + later_us);
    } else if (r->has_sync_time && earlier_us > 0 && earlier_us < MIN_HOST_RESTART_US) {
        return;
    }
    r->has_sync_time = true;
    r->sync_time_us = time_us;
}

void process_frame(robot *r, const jm_frame *frame)
{
    bool is_sync = frame->id >> JM_NODE_BITS == JM_OPCODE_SYNC && frame->length == JM_SYNC_BYTES;
    if (is_sync && r->is_stepped) {
        advance_to_sync(r, jm_read_bits(frame, 8, 32));
    }
    for (int i = 0; i < r->on_bus_count; i++) {
        deliver_frame(&r->modules[i], frame, r->now_us);
    }
    poll_all(r);
    collect_frames(r);
    if (is_sync) {
        sort_outgoing(r);
    }
    send_all(r);
}

static void remove_duplicates(robot *r, const emulated_module *original)
{
    int kept = r->module_count;
    for (int i = r->module_count; i < r->on_bus_count; i++) {
        if (r->modules[i].measured_joint != &original->joint) {
            r->modules[kept] = r->modules[i];
            kept++;
        }
    }
    r->on_bus_count = kept;
}

static void set_duplicate(robot *r, emulated_module *original, bool is_active)
{
    remove_duplicates(r, original);
    if (is_active && r->on_bus_count < MAX_ON_BUS) {
        uint64_t boot_start_us = r->now_us > BOOT_US ? r->now_us - BOOT_US : 0;
        start_duplicate(&r->modules[r->on_bus_count], original, boot_start_us);
        r->on_bus_count++;
    }
}

bool inject_fault(robot *r, const char *kind, const char *joint, bool is_active)
{
    for (int i = 0; i < r->module_count; i++) {
        emulated_module *module = &r->modules[i];
        if (strcmp(module->description->name, joint) != 0) {
            continue;
        }
        if (strcmp(kind, "duplicate") == 0) {
            set_duplicate(r, module, is_active);
            poll_all(r);
            return true;
        }
        bool is_known = set_module_fault(module, kind, is_active, r->now_us);
        poll_all(r);
        return is_known;
    }
    return false;
}
