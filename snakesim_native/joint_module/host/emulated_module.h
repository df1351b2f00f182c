/* One module on the bus: its firmware, the simulated joint that it moves, and injected faults. */
#ifndef EMULATED_MODULE_H
#define EMULATED_MODULE_H

#include "../firmware/joint_module.h"
#include "simulated_joint.h"

enum { MAX_NAME_BYTES = 32 };

/* What a module is, by the file with the robot's modules. */
typedef struct {
    char name[MAX_NAME_BYTES]; /* of its joint */
    unsigned node;
    uint32_t serial;
    double has_imu; /* 0 or 1 */
    joint_description joint;
} module_description;

/* One module. */
typedef struct {
    const module_description *description;
    jm_module firmware;
    jm_sensors sensors;
    simulated_joint joint;

    /* The hardware watchdog of the motor's bridge. */
    uint64_t bridge_fed_us;
    bool is_torque_on; /* as it was printed */

    /* A duplicate has the node id of another module, and moves nothing. */
    bool has_motor;
    simulated_joint *measured_joint; /* `joint`, or that of the other module */

    /* Injected faults. */
    bool is_mute;
    bool is_frozen; /* The main loop of the firmware hangs. */
    bool is_leaking;
    bool has_low_voltage;
    bool has_wrong_counter;
    bool has_wrong_checksum;
    bool is_babbling;
    uint64_t babbled_us; /* until when its heartbeats have filled the bus */
    jm_frame last_joint_state;
} emulated_module;

/* Starts to boot a module that moves a joint of its own. */
void start_module(emulated_module *module, const module_description *description, bool is_stepped, uint64_t now_us);

/* Starts to boot a module with the node id of another one. */
void start_duplicate(emulated_module *duplicate, emulated_module *original, uint64_t now_us);

/* Lets a step pass: motor and joint. */
void step_module(emulated_module *module, uint64_t now_us);

/* Lets the firmware process a frame. */
void deliver_frame(emulated_module *module, const jm_frame *frame, uint64_t now_us);

/* Lets the firmware do what is due. Prints when the torque is switched on or off. */
void poll_emulated_module(emulated_module *module, uint64_t now_us);

/* Takes a frame that the module sends, with its injected faults. Returns false if there is none. */
bool pop_sent_frame(emulated_module *module, jm_frame *frame);

/* Starts or ends an injected fault of the module alone. Returns false for a kind that it does not have. */
bool set_module_fault(emulated_module *module, const char *kind, bool is_active, uint64_t now_us);

#endif
