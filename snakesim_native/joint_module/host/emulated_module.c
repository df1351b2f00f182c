#include "emulated_module.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "../firmware/frames.h"

enum {
    FIRMWARE_MAJOR = 1,
    FIRMWARE_MINOR = 0,
    DUPLICATE_SERIAL_MASK = 0x0D0B1E00,
    STANDARD_GRAVITY_CM_S2 = 981,
    WET_PERCENT = 100,
    REBOOT_ACTION = 5,

    /* The end of a JointState, for injected faults. */
    COUNT_BYTE = 6,
    COUNT_MASK = 0x0F,
    CHECKSUM_BYTE = 7,
    WRONG_COUNT_OFFSET = 7, /* further from the right counter than any lost frame */
    WRONG_CHECKSUM_MASK = 0x5A
};

static const double SAGGED_FRACTION = 2.0 / 3.0; /* of the minimum voltage */

static int32_t to_steps(double value, double step)
{
    return (int32_t)lround(value / step);
}

/* Measures everything, as the converters of a board do. */
static void sample_sensors(emulated_module *module)
{
    const joint_description *description = &module->description->joint;
    const simulated_joint *joint = module->measured_joint;
    jm_sensors *sensors = &module->sensors;
    double voltage_v = module->has_low_voltage ? SAGGED_FRACTION * description->min_voltage_v : description->voltage_v;
    double power_w = fmax(joint->torque_nm * joint->velocity_rad_s, 0.0);
    sensors->is_valid = true;
    sensors->angle_100urad = to_steps(joint->angle_rad, 1e-4);
    sensors->velocity_mrad_s = to_steps(joint->velocity_rad_s, 1e-3);
    sensors->torque_mnm = to_steps(joint->torque_nm, 1e-3);
    sensors->voltage_mv = to_steps(voltage_v, 1e-3);
    sensors->current_ma = to_steps(description->idle_a + power_w / voltage_v, 1e-3);
    sensors->winding_tenths_c = (int16_t)to_steps(joint->winding_c, 0.1);
    sensors->board_tenths_c = (int16_t)to_steps(compute_board_c(joint, description), 0.1);
    sensors->is_leaking = module->is_leaking;
    sensors->water_percent = module->is_leaking ? WET_PERCENT : 0;
    sensors->shaft_load_mnm = sensors->torque_mnm;
}

static jm_config make_config(const module_description *description, bool is_stepped)
{
    jm_config config;
    memset(&config, 0, sizeof config);
    config.node = (uint8_t)description->node;
    config.serial = description->serial;
    config.firmware_major = FIRMWARE_MAJOR;
    config.firmware_minor = FIRMWARE_MINOR;
    config.is_emulated = true;
    config.is_stepped = is_stepped;
    config.rated_torque_nm = (float)description->joint.rated_torque_nm;
    config.rated_speed_rad_s = (float)description->joint.rated_speed_rad_s;
    config.derate_from_tenths_c = (int16_t)to_steps(description->joint.derate_from_c, 0.1);
    config.stop_at_tenths_c = (int16_t)to_steps(description->joint.stop_at_c, 0.1);
    config.min_voltage_mv = to_steps(description->joint.min_voltage_v, 1e-3);
    return config;
}

static void start_firmware(emulated_module *module, const jm_config *config, uint64_t now_us)
{
    jm_parameters flash = jm_make_factory_parameters(config->rated_torque_nm, config->rated_speed_rad_s);
    jm_init(&module->firmware, config, &flash, now_us);
    module->sensors.has_imu = module->description->has_imu != 0.0;
    module->sensors.has_shaft_load = true;
    module->sensors.acceleration_cm_s2[2] = STANDARD_GRAVITY_CM_S2; /* The robot lies on a table. */
    sample_sensors(module);
}

void start_module(emulated_module *module, const module_description *description, bool is_stepped, uint64_t now_us)
{
    memset(module, 0, sizeof *module);
    module->description = description;
    module->has_motor = true;
    module->joint = make_joint(&description->joint);
    module->measured_joint = &module->joint;
    jm_config config = make_config(description, is_stepped);
    start_firmware(module, &config, now_us);
}

void start_duplicate(emulated_module *duplicate, emulated_module *original, uint64_t now_us)
{
    memset(duplicate, 0, sizeof *duplicate);
    duplicate->description = original->description;
    duplicate->measured_joint = &original->joint;
    jm_config config = original->firmware.config;
    config.serial ^= DUPLICATE_SERIAL_MASK;
    start_firmware(duplicate, &config, now_us);
}

/* Returns whether the bridge is on: the firmware drives the motor, and feeds the hardware watchdog. */
static bool is_bridge_on(const emulated_module *module, uint64_t now_us)
{
    double watchdog_us = 1e6 * (double)module->firmware.parameters.values[JM_WATCHDOG];
    bool is_fed = (double)(now_us - module->bridge_fed_us) <= watchdog_us;
    return jm_is_driven(&module->firmware) && is_fed;
}

void step_module(emulated_module *module, uint64_t now_us)
{
    if (!module->has_motor) {
        return;
    }
    simulated_joint *joint = &module->joint;
    jm_torque torque = {0.0f, false};
    if (is_bridge_on(module, now_us)) {
        torque = jm_compute_torque(&module->firmware, (float)joint->angle_rad, (float)joint->velocity_rad_s);
    }
    step_joint(joint, &module->description->joint, (double)torque.torque_nm);
    module->sensors.is_derated = torque.is_derated;
}

static void feed_bridge(emulated_module *module, uint64_t now_us)
{
    if (jm_pop_bridge_feed(&module->firmware)) {
        module->bridge_fed_us = now_us;
    }
}

/* A frozen main loop leaves the newest joint state in a transmit mailbox, which is sent at each Sync. */
static void repeat_joint_state(emulated_module *module, const jm_frame *frame)
{
    bool is_sync = frame->id >> JM_NODE_BITS == JM_OPCODE_SYNC;
    jm_module *firmware = &module->firmware;
    if (is_sync && module->last_joint_state.length > 0 && firmware->outbox_count < JM_OUTBOX_FRAMES) {
        firmware->outbox[(firmware->outbox_first + firmware->outbox_count) % JM_OUTBOX_FRAMES] =
            module->last_joint_state;
        firmware->outbox_count++;
    }
}

void deliver_frame(emulated_module *module, const jm_frame *frame, uint64_t now_us)
{
    if (module->is_frozen) {
        repeat_joint_state(module, frame);
        return;
    }
    sample_sensors(module);
    jm_receive(&module->firmware, frame, &module->sensors, now_us);
    feed_bridge(module, now_us);
}

void poll_emulated_module(emulated_module *module, uint64_t now_us)
{
    if (!module->is_frozen) {
        sample_sensors(module);
        jm_poll(&module->firmware, &module->sensors, now_us);
        feed_bridge(module, now_us);
    }
    bool is_torque_on = module->has_motor && is_bridge_on(module, now_us);
    if (is_torque_on != module->is_torque_on) {
        module->is_torque_on = is_torque_on;
        printf("%.6f %s torque %s\n", (double)now_us * 1e-6, module->description->name, is_torque_on ? "on" : "off");
        fflush(stdout);
    }
}

static void corrupt_joint_state(const emulated_module *module, jm_frame *frame)
{
    if (module->has_wrong_counter) {
        uint8_t count_byte = frame->data[COUNT_BYTE];
        uint8_t wrong_count = (uint8_t)((count_byte + WRONG_COUNT_OFFSET) & COUNT_MASK);
        frame->data[COUNT_BYTE] = (uint8_t)((count_byte & ~COUNT_MASK) | wrong_count);
        jm_write_checksum(frame);
    }
    if (module->has_wrong_checksum) {
        frame->data[CHECKSUM_BYTE] ^= WRONG_CHECKSUM_MASK;
    }
}

bool pop_sent_frame(emulated_module *module, jm_frame *frame)
{
    while (jm_pop_frame(&module->firmware, frame)) {
        if (frame->id >> JM_NODE_BITS == JM_OPCODE_JOINT_STATE) {
            module->last_joint_state = *frame;
            corrupt_joint_state(module, frame);
        }
        if (!module->is_mute) {
            return true;
        }
    }
    return false;
}

/* Restarts the firmware by a Command, as a brownout restarts a board. */
static void restart_firmware(emulated_module *module, uint64_t now_us)
{
    jm_frame reboot = jm_make_frame(JM_OPCODE_COMMAND, module->firmware.config.node, JM_COMMAND_BYTES);
    jm_write_bits(&reboot, 0, 8, REBOOT_ACTION);
    jm_write_bits(&reboot, 8, 16, 0x5AAE);
    jm_write_checksum(&reboot);
    jm_receive(&module->firmware, &reboot, &module->sensors, now_us);
}

bool set_module_fault(emulated_module *module, const char *kind, bool is_active, uint64_t now_us)
{
    if (strcmp(kind, "mute") == 0) {
        module->is_mute = is_active;
    } else if (strcmp(kind, "freeze") == 0) {
        module->is_frozen = is_active;
    } else if (strcmp(kind, "counter") == 0) {
        module->has_wrong_counter = is_active;
    } else if (strcmp(kind, "checksum") == 0) {
        module->has_wrong_checksum = is_active;
    } else if (strcmp(kind, "leak") == 0) {
        module->is_leaking = is_active;
    } else if (strcmp(kind, "undervoltage") == 0) {
        module->has_low_voltage = is_active;
    } else if (strcmp(kind, "overheat") == 0) {
        set_overheated(&module->joint, &module->description->joint, is_active);
    } else if (strcmp(kind, "babble") == 0) {
        module->is_babbling = is_active;
        module->babbled_us = now_us;
    } else if (strcmp(kind, "reboot") == 0) {
        if (is_active) {
            restart_firmware(module, now_us);
        }
    } else {
        return false;
    }
    return true;
}
