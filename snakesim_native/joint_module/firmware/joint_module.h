/* The firmware of one joint module: protocol version 1 on CAN, as a state machine without a board.
 *
 * Frames, sensor values and times go in. Frames, and a demand for the motor, come out. Nothing here waits, allocates
 * memory, or calls an operating system. One `jm_module` is the whole state of a module, and needs no other memory.
 *
 * The specification is the page "Behavior of a joint module on CAN" of the SnakeSIM documentation.
 * How to put this on a board is explained on the page "Build a joint module".
 */
#ifndef JOINT_MODULE_H
#define JOINT_MODULE_H

#include <stdbool.h>
#include <stdint.h>

enum {
    JM_PROTOCOL_VERSION = 1,
    JM_FIRST_NODE = 1,
    JM_LAST_NODE = 62,
    JM_MAX_DATA_BYTES = 8,  /* of a frame on classic CAN */
    JM_OUTBOX_FRAMES = 16,  /* No call of this interface produces more than seven. */
    JM_PARAMETER_COUNT = 14 /* Indices on the bus are 1 to 13. Index 0 is not used. */
};

/* A data frame with an 11-bit id. */
typedef struct {
    uint16_t id;
    uint8_t length; /* bytes of `data` that are used */
    uint8_t data[JM_MAX_DATA_BYTES];
} jm_frame;

/* State of a module. Only JM_ARMED follows setpoints. Only JM_ARMED and JM_STOPPING drive the motor. */
typedef enum {
    JM_BOOT = 0,
    JM_DISARMED = 1,
    JM_ARMED = 2,
    JM_STOPPING = 3,
    JM_FAULT = 4,
    JM_EMERGENCY = 5
} jm_state;

/* Control mode of the motor. */
typedef enum {
    JM_PASSIVE = 0,
    JM_POSITION = 1,
    JM_VELOCITY = 2,
    JM_TORQUE = 3
} jm_mode;

/* Faults, as bits of a heartbeat. */
typedef enum {
    JM_FAULT_WATCHDOG = 0,
    JM_FAULT_STREAM = 1,
    JM_FAULT_OVERHEAT = 2,
    JM_FAULT_LEAK = 3,
    JM_FAULT_VOLTAGE = 4,
    JM_FAULT_SENSOR = 5,
    JM_FAULT_COUNT = 6
} jm_fault;

/* Why a module last left JM_ARMED. The values of faults follow each other in the order of `jm_fault`. */
typedef enum {
    JM_STOP_NONE = 0,
    JM_STOP_DISARM = 1,
    JM_STOP_STOP = 2,
    JM_STOP_WATCHDOG = 3,
    JM_STOP_STREAM = 4,
    JM_STOP_OVERHEAT = 5,
    JM_STOP_LEAK = 6,
    JM_STOP_VOLTAGE = 7,
    JM_STOP_SENSOR = 8,
    JM_STOP_EMERGENCY = 9,
    JM_STOP_REBOOT = 10
} jm_last_stop;

/* Index of every parameter. */
typedef enum {
    JM_STIFFNESS = 1,     /* N·m/rad */
    JM_DAMPING = 2,       /* N·m·s/rad */
    JM_VELOCITY_GAIN = 3, /* N·m·s/rad */
    JM_TORQUE_LIMIT = 4,  /* N·m */
    JM_SPEED_LIMIT = 5,   /* rad/s */
    JM_ANGLE_LIMIT = 6,   /* rad */
    JM_WATCHDOG = 7,      /* s */
    JM_STOP_MODE = 8,     /* 0 passive, 1 damp */
    JM_CONTACT_EVERY = 9, /* Syncs, 0 never */
    JM_IMU_EVERY = 10,    /* Syncs, 0 never */
    JM_TAIL = 11,         /* 1: sends TailContact, too */
    JM_RATED_TORQUE = 12, /* N·m, read-only */
    JM_RATED_SPEED = 13   /* rad/s, read-only */
} jm_parameter;

/* The values of all parameters, by index. */
typedef struct {
    float values[JM_PARAMETER_COUNT];
} jm_parameters;

/* What a module is. The manufacturer sets it, and it does not change while the module runs. */
typedef struct {
    uint8_t node;            /* JM_FIRST_NODE to JM_LAST_NODE */
    uint32_t serial;         /* unique to each module */
    uint8_t firmware_major;
    uint8_t firmware_minor;
    bool is_emulated;        /* false on a board */
    bool is_stepped;         /* false on a board */
    float rated_torque_nm;   /* of the motor, 0 to 32.767 */
    float rated_speed_rad_s; /* of the motor, 0 to 32.767 */

    /* The winding's temperatures, in tenths of a degree Celsius: the torque limit falls from the first to the second,
     * where the module stops. The first must be lower than the second. */
    int16_t derate_from_tenths_c;
    int16_t stop_at_tenths_c;
    int32_t min_voltage_mv; /* below this supply voltage the module stops */
} jm_config;

/* The force on a link, in the frame of the link. All other values are ignored if `is_touched` is false. */
typedef struct {
    bool is_touched;
    int32_t force_50mn[3]; /* x, y and z, in steps of 0.05 N */
    int32_t along_500um;   /* position from the link's rear joint, in steps of 0.5 mm */
    uint8_t bearing_steps; /* angle about the x axis from y towards z, in 1/256 of a revolution */
} jm_contact;

/* The newest sensor values. Values beyond the range of their signal are sent as the end of the range. */
typedef struct {
    bool is_valid; /* false: the angle or the motor current cannot be measured, which is a fault */
    int32_t angle_100urad;
    int32_t velocity_mrad_s;
    int32_t torque_mnm; /* of the motor, at the shaft, from its current */
    bool is_derated;    /* by the control loop: see `jm_compute_torque` */

    int32_t voltage_mv; /* of the motor supply */
    int32_t current_ma; /* out of the motor supply */
    int16_t winding_tenths_c;
    int16_t board_tenths_c;
    bool is_leaking;
    uint8_t water_percent; /* of the water sensor's range */

    jm_contact contact;      /* of the link in front of the joint */
    jm_contact tail_contact; /* of the link behind the joint, only sent by the module at the tail */

    bool has_imu;
    int32_t gyro_mrad_s[3];
    int32_t acceleration_cm_s2[3];
    bool has_shaft_load;
    int32_t shaft_load_mnm;
} jm_sensors;

/* What the module demands of its motor. */
typedef struct {
    jm_mode mode;
    float target; /* rad, rad/s or N·m, by the mode */
    float torque_limit_nm;
} jm_demand;

/* The state of one module. Read the fields as you like, and change them only through the functions below. */
typedef struct {
    jm_config config;
    jm_parameters parameters;
    jm_parameters flash; /* the values after the next restart */
    bool is_flash_write_due;
    jm_sensors sensors; /* as of the newest call */

    /* State. */
    jm_state state;
    jm_state state_after_boot;
    jm_last_stop last_stop;
    uint8_t faults; /* bits of `jm_fault` */
    jm_demand demand;

    /* Setpoints. */
    bool has_pending_demand;
    jm_demand pending_demand; /* is followed from the next Sync on */
    bool has_expected_count;  /* false: the next setpoint may have any counter */
    uint8_t expected_count;
    uint8_t wrong_counts;         /* in a row */
    bool has_sync_since_setpoint; /* whether a Sync has come since the setpoint that last fed the watchdog */
    uint32_t sync_count;          /* Syncs since boot */
    bool is_bridge_feed_due;

    /* Times, in microseconds. */
    uint64_t boot_start_us;
    uint64_t watchdog_fed_us;
    uint64_t stopping_start_us;
    uint64_t next_heartbeat_us;
    uint64_t next_health_us;

    /* Frames to send, as a ring. */
    jm_frame outbox[JM_OUTBOX_FRAMES];
    uint8_t outbox_first;
    uint8_t outbox_count;

    /* Counters for a person who looks for an error. */
    uint32_t rejected_frame_count; /* received with a wrong length, checksum, counter or mode */
    uint32_t dropped_frame_count;  /* not sent, because the outbox was full */
} jm_module;

/* Returns the parameters of a new module. All gains are 0: a module that was not configured holds nothing. */
jm_parameters jm_make_factory_parameters(float rated_torque_nm, float rated_speed_rad_s);

/* Starts to boot. `flash` has the values that were saved, or those of `jm_make_factory_parameters`. Saved values that
 * are out of range are replaced by those of a new module. */
void jm_init(jm_module *module, const jm_config *config, const jm_parameters *flash, uint64_t now_us);

/* Processes one received frame. Call `jm_poll` after it.
 *
 * For a Sync, `sensors` must have been sampled at the end of that frame. `now_us` is a clock that never goes back. */
void jm_receive(jm_module *module, const jm_frame *frame, const jm_sensors *sensors, uint64_t now_us);

/* Does everything that is due now: watchdog, faults, heartbeat and Health. Returns when the next call is due.
 *
 * Call it at least once per millisecond, so that a leak or a hot winding is noticed in time. */
uint64_t jm_poll(jm_module *module, const jm_sensors *sensors, uint64_t now_us);

/* Takes the oldest frame that is to be sent. Returns false if there is none. */
bool jm_pop_frame(jm_module *module, jm_frame *frame);

/* Returns whether the motor is driven: the gate driver of the motor's bridge must be off otherwise. */
bool jm_is_driven(const jm_module *module);

/* Returns true once after each event that may feed the hardware watchdog of the motor's bridge. */
bool jm_pop_bridge_feed(jm_module *module);

/* Returns true once after parameters were saved: write `module->flash` to the nonvolatile memory now. */
bool jm_pop_flash_write(jm_module *module);

/* A torque for the motor, and whether heat limits it below the demanded one. */
typedef struct {
    float torque_nm;
    bool is_derated;
} jm_torque;

/* Returns the torque that the motor should have now. It is 0 while the motor is not driven.
 *
 * Call it in the control loop, at 1 kHz or faster, with the angle and velocity of that moment. */
jm_torque jm_compute_torque(const jm_module *module, float angle_rad, float velocity_rad_s);

#endif
