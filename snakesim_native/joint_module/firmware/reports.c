#include "reports.h"

#include "frames.h"
#include "parameters.h"

enum {
    COUNT_MASK = 0x0F, /* a count of 4 bits */
    US_PER_MS = 1000,
    MIN_TEMPERATURE_C = -40, /* is sent as 0 */
    TENTHS_PER_DEGREE = 10,
    MAX_PERCENT = 100
};

void jm_send(jm_module *module, const jm_frame *frame)
{
    if (module->outbox_count >= JM_OUTBOX_FRAMES) {
        module->dropped_frame_count++;
        return;
    }
    uint8_t place = (uint8_t)((module->outbox_first + module->outbox_count) % JM_OUTBOX_FRAMES);
    module->outbox[place] = *frame;
    module->outbox_count++;
}

void jm_send_heartbeat(jm_module *module, uint64_t now_us)
{
    uint64_t uptime_ms = (now_us - module->boot_start_us) / US_PER_MS;
    if (uptime_ms > UINT32_MAX) {
        uptime_ms = UINT32_MAX; /* It stays at the end of its range, after 49.7 days. */
    }
    jm_frame frame = jm_make_frame(JM_OPCODE_HEARTBEAT, module->config.node, 8);
    jm_write_bits(&frame, 0, 4, (uint32_t)module->state);
    jm_write_bits(&frame, 4, 4, (uint32_t)module->demand.mode);
    jm_write_bits(&frame, 8, 8, (uint32_t)module->last_stop);
    jm_write_bits(&frame, 16, JM_FAULT_COUNT, module->faults);
    jm_write_bits(&frame, 32, 32, (uint32_t)uptime_ms);
    jm_send(module, &frame);
}

/* Returns the raw number of a temperature, rounded to the nearest degree. */
static uint32_t encode_temperature(int16_t tenths_c)
{
    int32_t above_min_tenths = (int32_t)tenths_c - MIN_TEMPERATURE_C * TENTHS_PER_DEGREE;
    int32_t degrees = (above_min_tenths + TENTHS_PER_DEGREE / 2) / TENTHS_PER_DEGREE;
    return (uint32_t)jm_clamp(degrees, 0, UINT8_MAX);
}

void jm_send_health(jm_module *module)
{
    const jm_sensors *sensors = &module->sensors;
    jm_frame frame = jm_make_frame(JM_OPCODE_HEALTH, module->config.node, 7);
    jm_write_bits(&frame, 0, 16, (uint32_t)jm_clamp(sensors->voltage_mv, 0, UINT16_MAX));
    jm_write_signed(&frame, 16, 16, sensors->current_ma);
    jm_write_bits(&frame, 32, 8, encode_temperature(sensors->winding_tenths_c));
    jm_write_bits(&frame, 40, 8, encode_temperature(sensors->board_tenths_c));
    jm_write_bits(&frame, 48, 1, sensors->is_leaking);
    jm_write_bits(&frame, 49, 7, (uint32_t)jm_clamp(sensors->water_percent, 0, MAX_PERCENT));
    jm_send(module, &frame);
}

void jm_send_identity(jm_module *module)
{
    const jm_config *config = &module->config;
    jm_frame frame = jm_make_frame(JM_OPCODE_IDENTITY, config->node, 8);
    jm_write_bits(&frame, 0, 32, config->serial);
    jm_write_bits(&frame, 32, 8, config->firmware_major);
    jm_write_bits(&frame, 40, 8, config->firmware_minor);
    jm_write_bits(&frame, 48, 8, JM_PROTOCOL_VERSION);
    jm_write_bits(&frame, 56, 1, config->is_emulated);
    jm_write_bits(&frame, 57, 1, config->is_stepped);
    jm_send(module, &frame);
}

static void send_joint_state(jm_module *module, uint8_t count)
{
    const jm_sensors *sensors = &module->sensors;
    jm_frame frame = jm_make_frame(JM_OPCODE_JOINT_STATE, module->config.node, 8);
    jm_write_signed(&frame, 0, 16, sensors->angle_100urad);
    jm_write_signed(&frame, 16, 16, sensors->velocity_mrad_s);
    jm_write_signed(&frame, 32, 16, sensors->torque_mnm);
    jm_write_bits(&frame, 48, 4, count & COUNT_MASK);
    jm_write_bits(&frame, 52, 3, (uint32_t)module->state);
    jm_write_bits(&frame, 55, 1, sensors->is_derated);
    jm_write_checksum(&frame);
    jm_send(module, &frame);
}

static void send_contact(jm_module *module, jm_opcode opcode, const jm_contact *contact, uint8_t count)
{
    jm_frame frame = jm_make_frame(opcode, module->config.node, 8);
    if (contact->is_touched) {
        jm_write_signed(&frame, 0, 13, contact->force_50mn[0]);
        jm_write_signed(&frame, 13, 13, contact->force_50mn[1]);
        jm_write_signed(&frame, 26, 13, contact->force_50mn[2]);
        jm_write_signed(&frame, 39, 10, contact->along_500um);
        jm_write_bits(&frame, 49, 8, contact->bearing_steps);
        jm_write_bits(&frame, 57, 1, 1);
    }
    jm_write_bits(&frame, 58, 4, count & COUNT_MASK);
    jm_send(module, &frame);
}

static void send_contacts(jm_module *module, uint8_t count)
{
    uint8_t every = jm_get_count(module, JM_CONTACT_EVERY);
    if (every == 0 || count % every != 0) {
        return;
    }
    send_contact(module, JM_OPCODE_CONTACT, &module->sensors.contact, count);
    if (jm_get_count(module, JM_TAIL) != 0) {
        send_contact(module, JM_OPCODE_TAIL_CONTACT, &module->sensors.tail_contact, count);
    }
}

static void send_vector(jm_module *module, jm_opcode opcode, const int32_t vector[3], uint8_t count)
{
    jm_frame frame = jm_make_frame(opcode, module->config.node, 7);
    for (uint8_t axis = 0; axis < 3; axis++) {
        jm_write_signed(&frame, (uint8_t)(16 * axis), 16, vector[axis]);
    }
    jm_write_bits(&frame, 48, 8, count);
    jm_send(module, &frame);
}

static void send_shaft_load(jm_module *module, uint8_t count)
{
    jm_frame frame = jm_make_frame(JM_OPCODE_SHAFT_LOAD, module->config.node, 3);
    jm_write_signed(&frame, 0, 16, module->sensors.shaft_load_mnm);
    jm_write_bits(&frame, 16, 8, count);
    jm_send(module, &frame);
}

/* Sends gyro, accelerometer and shaft load at every `imu_every`-th Sync. Neighbors do so at different Syncs. */
static void send_imu(jm_module *module, uint8_t count)
{
    uint8_t every = jm_get_count(module, JM_IMU_EVERY);
    if (every == 0 || (module->sync_count + module->config.node) % every != 0) {
        return;
    }
    if (module->sensors.has_imu) {
        send_vector(module, JM_OPCODE_GYRO, module->sensors.gyro_mrad_s, count);
        send_vector(module, JM_OPCODE_ACCELEROMETER, module->sensors.acceleration_cm_s2, count);
    }
    if (module->sensors.has_shaft_load) {
        send_shaft_load(module, count);
    }
}

void jm_answer_sync(jm_module *module, uint8_t count)
{
    send_joint_state(module, count);
    send_contacts(module, count);
    send_imu(module, count);
}
