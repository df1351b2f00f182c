/* All modules of a robot on one bus, and their time. */
#ifndef ROBOT_H
#define ROBOT_H

#include "local_bus.h"
#include "emulated_module.h"

enum {
    MAX_MODULES = JM_LAST_NODE,
    MAX_ON_BUS = 2 * MAX_MODULES, /* with a duplicate of each module */
    MAX_OUTGOING = 1024
};

typedef struct {
    local_bus *bus;
    bool is_stepped; /* Time advances only from Sync to Sync. */
    int module_count;
    int on_bus_count; /* modules, then duplicates */
    module_description descriptions[MAX_MODULES];
    emulated_module modules[MAX_ON_BUS];

    uint64_t now_us; /* since the start */
    uint64_t stepped_us; /* until when the joints have moved */
    bool has_sync_time;
    uint32_t sync_time_us; /* of the newest Sync, by the clock of the host */

    jm_frame outgoing[MAX_OUTGOING];
    int outgoing_count;
} robot;

/* Starts to boot all modules. In stepped time they have booted already. */
void start_robot(robot *r, local_bus *bus, bool is_stepped);

/* Advances joints and modules to a time since the start. */
void advance_robot(robot *r, uint64_t until_us);

/* Advances as if the host had sent nothing for some time. */
void advance_without_host(robot *r, double duration_s);

/* Lets the modules process a frame, and sends their answers. */
void process_frame(robot *r, const jm_frame *frame);

/* Starts or ends a fault of a joint's module. Returns false for a kind or a joint that does not exist. */
bool inject_fault(robot *r, const char *kind, const char *joint, bool is_active);

/* Sends the frames of all modules. */
void flush_robot(robot *r);

#endif
