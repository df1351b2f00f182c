/* What a module does with received frames and with time. The states themselves are in states.c. */
#include "joint_module.h"

#include "frames.h"
#include "parameters.h"
#include "reports.h"
#include "states.h"

enum {
    COMMAND_KEY = 0x5AAE, /* in every Command, so that no other frame can be taken for one */

    /* Counters of setpoints. */
    COUNTER_MASK = 0x0F,
    MAX_LOST_SETPOINTS = 2, /* may be missing before a setpoint */
    MAX_WRONG_COUNTS = 5,   /* in a row */

    BOOT_US = 100000,
    AT_REST_MRAD_S = 50 /* a slower joint has come to rest */
};

static const float TARGET_STEP_RAD = 1e-4f;
static const float TARGET_STEP_RAD_S = 1e-3f;
static const float TARGET_STEP_NM = 1e-3f;
static const float TORQUE_LIMIT_STEP_NM = 1e-3f;

/* --- commands ---------------------------------------------------------------------------------------------------- */

static void receive_command(jm_module *module, const jm_frame *frame, uint64_t now_us)
{
    if (frame->length != JM_COMMAND_BYTES || !jm_has_valid_checksum(frame)) {
        module->rejected_frame_count++;
        return;
    }
    if (jm_read_bits(frame, 8, 16) == COMMAND_KEY) {
        jm_execute_action(module, jm_read_bits(frame, 0, 8), now_us);
    }
}

/* --- setpoints --------------------------------------------------------------------------------------------------- */

/* Returns whether a setpoint's counter follows the one before. A few setpoints in between may be lost. */
static bool check_counter(jm_module *module, uint8_t count)
{
    bool is_first = !module->has_expected_count;
    uint8_t lost_setpoints = (uint8_t)((count - module->expected_count) & COUNTER_MASK);
    module->expected_count = (uint8_t)((count + 1) & COUNTER_MASK);
    module->has_expected_count = true;
    return is_first || lost_setpoints <= MAX_LOST_SETPOINTS;
}

static void reject_counter(jm_module *module, uint64_t now_us)
{
    module->rejected_frame_count++;
    module->wrong_counts++;
    if (module->wrong_counts >= MAX_WRONG_COUNTS) {
        jm_latch_fault(module, JM_FAULT_STREAM, now_us);
    }
}

static float clamp_angle(const jm_module *module, float angle_rad)
{
    float limit_rad = module->parameters.values[JM_ANGLE_LIMIT];
    if (angle_rad > limit_rad) {
        return limit_rad;
    }
    if (angle_rad < -limit_rad) {
        return -limit_rad;
    }
    return angle_rad;
}

/* Returns the target of a setpoint. All modes share its bits, and differ in the step. */
static float read_target(const jm_module *module, const jm_frame *frame, jm_mode mode)
{
    float steps = (float)jm_to_signed_16(jm_read_bits(frame, 8, 16));
    switch (mode) {
    case JM_PASSIVE:
        return 0.0f;
    case JM_POSITION:
        return clamp_angle(module, steps * TARGET_STEP_RAD);
    case JM_VELOCITY:
        return steps * TARGET_STEP_RAD_S;
    case JM_TORQUE:
        return steps * TARGET_STEP_NM;
    }
    return 0.0f;
}

static void store_setpoint(jm_module *module, const jm_frame *frame, jm_mode mode, uint64_t now_us)
{
    /* Without Syncs, setpoints are never followed. They must then not keep an old one active. */
    if (module->has_sync_since_setpoint) {
        module->has_sync_since_setpoint = false;
        jm_feed_watchdog(module, now_us);
    }
    module->pending_demand.mode = mode;
    module->pending_demand.target = read_target(module, frame, mode);
    module->pending_demand.torque_limit_nm = (float)jm_read_bits(frame, 24, 16) * TORQUE_LIMIT_STEP_NM;
    module->has_pending_demand = true;
}

static void receive_setpoint(jm_module *module, const jm_frame *frame, uint64_t now_us)
{
    if (module->state != JM_ARMED) {
        return;
    }
    if (frame->length != JM_SET_POINT_BYTES || !jm_has_valid_checksum(frame)) {
        module->rejected_frame_count++;
        return;
    }
    if (!check_counter(module, (uint8_t)jm_read_bits(frame, 4, 4))) {
        reject_counter(module, now_us);
        return;
    }
    module->wrong_counts = 0;
    uint32_t mode = jm_read_bits(frame, 0, 4);
    if (mode > JM_TORQUE) {
        module->rejected_frame_count++;
        return;
    }
    store_setpoint(module, frame, (jm_mode)mode, now_us);
}

/* Answers a Sync with the sensor values of that moment, then follows the newest setpoint. */
static void receive_sync(jm_module *module, const jm_frame *frame)
{
    if (frame->length != JM_SYNC_BYTES) {
        module->rejected_frame_count++;
        return;
    }
    jm_answer_sync(module, (uint8_t)jm_read_bits(frame, 0, 8));
    module->sync_count++;
    module->has_sync_since_setpoint = true;
    if (module->has_pending_demand) {
        module->demand = module->pending_demand;
        module->has_pending_demand = false;
    }
}

static void receive_parameter_request(jm_module *module, const jm_frame *frame)
{
    if (frame->length != JM_PARAMETER_BYTES) {
        module->rejected_frame_count++;
        return;
    }
    jm_frame answer = jm_answer_parameter_request(module, frame);
    jm_send(module, &answer);
}

/* --- interface --------------------------------------------------------------------------------------------------- */

void jm_init(jm_module *module, const jm_config *config, const jm_parameters *flash, uint64_t now_us)
{
    *module = (jm_module){0};
    module->config = *config;
    module->flash = jm_check_flash(flash, config);
    module->last_stop = JM_STOP_NONE;
    jm_start_boot(module, now_us);
}

/* Returns whether a frame of the host is for this module. */
static bool is_addressed(const jm_module *module, uint32_t opcode, uint32_t node)
{
    switch (opcode) {
    case JM_OPCODE_SYNC:
        return node == JM_BROADCAST;
    case JM_OPCODE_EMERGENCY:
    case JM_OPCODE_COMMAND:
        return node == JM_BROADCAST || node == module->config.node;
    case JM_OPCODE_SET_POINT:
    case JM_OPCODE_PARAMETER_REQUEST:
        return node == module->config.node;
    default: /* It comes from another module, or from a later protocol. */
        return false;
    }
}

void jm_receive(jm_module *module, const jm_frame *frame, const jm_sensors *sensors, uint64_t now_us)
{
    uint32_t opcode = (uint32_t)frame->id >> JM_NODE_BITS;
    module->sensors = *sensors;
    if (frame->id > JM_LAST_ID || frame->length > JM_MAX_DATA_BYTES) {
        return;
    }
    if (!is_addressed(module, opcode, frame->id & JM_NODE_MASK)) {
        return;
    }
    if (opcode == JM_OPCODE_EMERGENCY) { /* It is valid at any length, and while the module boots. */
        jm_enter_emergency(module, now_us);
        return;
    }
    if (module->state == JM_BOOT) {
        return;
    }
    switch (opcode) {
    case JM_OPCODE_COMMAND:
        receive_command(module, frame, now_us);
        break;
    case JM_OPCODE_SYNC:
        receive_sync(module, frame);
        break;
    case JM_OPCODE_SET_POINT:
        receive_setpoint(module, frame, now_us);
        break;
    case JM_OPCODE_PARAMETER_REQUEST:
        receive_parameter_request(module, frame);
        break;
    default:
        break;
    }
}

/* Ends the states that end by themselves. */
static void check_times(jm_module *module, uint64_t now_us)
{
    uint64_t watchdog_us = jm_get_watchdog_us(module);
    int32_t velocity_mrad_s = module->sensors.velocity_mrad_s;
    bool is_at_rest = velocity_mrad_s > -AT_REST_MRAD_S && velocity_mrad_s < AT_REST_MRAD_S;
    switch (module->state) {
    case JM_ARMED:
        if (now_us >= module->watchdog_fed_us + watchdog_us) {
            jm_latch_fault(module, JM_FAULT_WATCHDOG, now_us);
        }
        break;
    case JM_STOPPING:
        if (is_at_rest || now_us >= module->stopping_start_us + watchdog_us) {
            jm_finish_stop(module, now_us);
        }
        break;
    case JM_BOOT:
    case JM_DISARMED:
    case JM_FAULT:
    case JM_EMERGENCY:
        break;
    }
}

/* Returns when a report is due that was due at `due_us`. After a long pause, one report makes up for several. */
static uint64_t get_next_report_us(uint64_t due_us, uint64_t period_us, uint64_t now_us)
{
    uint64_t next_us = due_us + period_us;
    return next_us > now_us ? next_us : now_us;
}

static void send_due_reports(jm_module *module, uint64_t now_us)
{
    if (now_us >= module->next_heartbeat_us) {
        module->next_heartbeat_us = get_next_report_us(module->next_heartbeat_us, JM_HEARTBEAT_US, now_us);
        jm_send_heartbeat(module, now_us);
    }
    if (now_us >= module->next_health_us) {
        module->next_health_us = get_next_report_us(module->next_health_us, JM_HEALTH_US, now_us);
        jm_send_health(module);
    }
}

static uint64_t get_earlier(uint64_t a_us, uint64_t b_us)
{
    return a_us < b_us ? a_us : b_us;
}

static uint64_t get_next_due_us(const jm_module *module, uint64_t now_us)
{
    uint64_t report_us = get_earlier(module->next_heartbeat_us, module->next_health_us);
    switch (module->state) {
    case JM_BOOT:
        return module->boot_start_us + BOOT_US;
    case JM_ARMED:
        return get_earlier(report_us, module->watchdog_fed_us + jm_get_watchdog_us(module));
    case JM_STOPPING:
        return now_us;
    case JM_DISARMED:
    case JM_FAULT:
    case JM_EMERGENCY:
        return report_us;
    }
    return now_us;
}

uint64_t jm_poll(jm_module *module, const jm_sensors *sensors, uint64_t now_us)
{
    module->sensors = *sensors;
    if (module->state == JM_BOOT) {
        if (now_us < module->boot_start_us + BOOT_US) {
            return get_next_due_us(module, now_us);
        }
        jm_finish_boot(module, now_us);
    }
    jm_latch_new_faults(module, now_us);
    check_times(module, now_us);
    send_due_reports(module, now_us);
    return get_next_due_us(module, now_us);
}

bool jm_pop_frame(jm_module *module, jm_frame *frame)
{
    if (module->outbox_count == 0) {
        return false;
    }
    *frame = module->outbox[module->outbox_first];
    module->outbox_first = (uint8_t)((module->outbox_first + 1) % JM_OUTBOX_FRAMES);
    module->outbox_count--;
    return true;
}

bool jm_is_driven(const jm_module *module)
{
    switch (module->state) {
    case JM_ARMED:
    case JM_STOPPING:
        return true;
    case JM_BOOT:
    case JM_DISARMED:
    case JM_FAULT:
    case JM_EMERGENCY:
        return false;
    }
    return false;
}

bool jm_pop_bridge_feed(jm_module *module)
{
    bool is_due = module->is_bridge_feed_due;
    module->is_bridge_feed_due = false;
    return is_due;
}

bool jm_pop_flash_write(jm_module *module)
{
    bool is_due = module->is_flash_write_due;
    module->is_flash_write_due = false;
    return is_due;
}
