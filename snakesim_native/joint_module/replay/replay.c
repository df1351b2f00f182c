/* Runs the firmware of one module on events from its standard input, and prints what the module does.
 *
 * Tests compare the output with that of the emulator in Python. It is also a way to try the firmware by hand: see the
 * page "Build a joint module" of the SnakeSIM documentation. One line of input is one event:
 *
 *     init NODE SERIAL RATED_NM RATED_RAD_S DERATE_TENTHS_C STOP_TENTHS_C MIN_MV TIME_US
 *     flash INDEX VALUE        before `init`: a parameter that the nonvolatile memory has, other than a new module
 *     sensors VALUE ...        all fields of `jm_sensors`, in their order
 *     mailbox 0                no frame can be sent from now on, until `mailbox 1`
 *     frame TIME_US ID DATA    id and data in hexadecimal; data `-` is none
 *     poll TIME_US
 *     torque ANGLE_RAD VELOCITY_RAD_S
 *
 * Each `frame` and each `poll` answers with one line: the frames to send, and after `|` the state of the module.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../firmware/joint_module.h"

enum { LINE_BYTES = 1024, SENSOR_VALUES = 32, WRONG_INPUT = 2 };

/* A parameter in the nonvolatile memory at the next `init`. */
typedef struct {
    bool is_set;
    float value;
} saved_value;

typedef struct {
    jm_module module;
    jm_sensors sensors;
    saved_value saved[JM_PARAMETER_COUNT];
    bool is_mailbox_full;
    uint64_t due_us;
} session;

static bool read_init(session *s, const char *text)
{
    jm_config config;
    unsigned node;
    int derate_tenths_c;
    int stop_tenths_c;
    uint64_t now_us;
    memset(&config, 0, sizeof config);
    int count = sscanf(text, "%u %" SCNu32 " %f %f %d %d %" SCNd32 " %" SCNu64, &node, &config.serial,
                       &config.rated_torque_nm, &config.rated_speed_rad_s, &derate_tenths_c, &stop_tenths_c,
                       &config.min_voltage_mv, &now_us);
    if (count != 8 || node < JM_FIRST_NODE || node > JM_LAST_NODE) {
        return false;
    }
    config.node = (uint8_t)node;
    config.firmware_major = 1;
    config.is_emulated = true;
    config.derate_from_tenths_c = (int16_t)derate_tenths_c;
    config.stop_at_tenths_c = (int16_t)stop_tenths_c;
    jm_parameters flash = jm_make_factory_parameters(config.rated_torque_nm, config.rated_speed_rad_s);
    for (int index = 1; index < JM_PARAMETER_COUNT; index++) {
        if (s->saved[index].is_set) {
            flash.values[index] = s->saved[index].value;
        }
    }
    memset(s->saved, 0, sizeof s->saved);
    jm_init(&s->module, &config, &flash, now_us);
    return true;
}

static bool read_flash(session *s, const char *text)
{
    unsigned index;
    float value;
    if (sscanf(text, "%u %f", &index, &value) != 2 || index == 0 || index >= JM_PARAMETER_COUNT) {
        return false;
    }
    s->saved[index].is_set = true;
    s->saved[index].value = value;
    return true;
}

static void copy_vector(int32_t to[3], const int32_t from[3])
{
    memcpy(to, from, 3 * sizeof to[0]);
}

static jm_contact make_contact(const int32_t *values)
{
    jm_contact contact;
    contact.is_touched = values[0] != 0;
    copy_vector(contact.force_50mn, values + 1);
    contact.along_500um = values[4];
    contact.bearing_steps = (uint8_t)values[5];
    return contact;
}

static bool read_sensors(session *s, const char *text)
{
    int32_t values[SENSOR_VALUES];
    for (int i = 0; i < SENSOR_VALUES; i++) {
        char *end;
        values[i] = (int32_t)strtol(text, &end, 10);
        if (end == text) {
            return false;
        }
        text = end;
    }
    jm_sensors *sensors = &s->sensors;
    sensors->is_valid = values[0] != 0;
    sensors->angle_100urad = values[1];
    sensors->velocity_mrad_s = values[2];
    sensors->torque_mnm = values[3];
    sensors->is_derated = values[4] != 0;
    sensors->voltage_mv = values[5];
    sensors->current_ma = values[6];
    sensors->winding_tenths_c = (int16_t)values[7];
    sensors->board_tenths_c = (int16_t)values[8];
    sensors->is_leaking = values[9] != 0;
    sensors->water_percent = (uint8_t)values[10];
    sensors->contact = make_contact(values + 11);
    sensors->tail_contact = make_contact(values + 17);
    sensors->has_imu = values[23] != 0;
    copy_vector(sensors->gyro_mrad_s, values + 24);
    copy_vector(sensors->acceleration_cm_s2, values + 27);
    sensors->has_shaft_load = values[30] != 0;
    sensors->shaft_load_mnm = values[31];
    return true;
}

static bool read_data(jm_frame *frame, const char *hex)
{
    frame->length = 0;
    if (strcmp(hex, "-") == 0) {
        return true;
    }
    size_t length = strlen(hex) / 2;
    if (length > JM_MAX_DATA_BYTES || strlen(hex) != 2 * length) {
        return false;
    }
    for (size_t i = 0; i < length; i++) {
        unsigned byte;
        if (sscanf(hex + 2 * i, "%2x", &byte) != 1) {
            return false;
        }
        frame->data[i] = (uint8_t)byte;
    }
    frame->length = (uint8_t)length;
    return true;
}

static bool receive_frame(session *s, const char *text)
{
    jm_frame frame;
    unsigned id;
    uint64_t now_us;
    char hex[2 * JM_MAX_DATA_BYTES + 1];
    memset(&frame, 0, sizeof frame);
    if (sscanf(text, "%" SCNu64 " %x %16s", &now_us, &id, hex) != 3 || !read_data(&frame, hex)) {
        return false;
    }
    frame.id = (uint16_t)id;
    jm_receive(&s->module, &frame, &s->sensors, now_us);
    return true;
}

static bool poll_module(session *s, const char *text)
{
    uint64_t now_us;
    if (sscanf(text, "%" SCNu64, &now_us) != 1) {
        return false;
    }
    s->due_us = jm_poll(&s->module, &s->sensors, now_us);
    return true;
}

static bool print_torque(const session *s, const char *text)
{
    float angle_rad;
    float velocity_rad_s;
    if (sscanf(text, "%f %f", &angle_rad, &velocity_rad_s) != 2) {
        return false;
    }
    jm_torque torque = jm_compute_torque(&s->module, angle_rad, velocity_rad_s);
    printf("%.6f %d\n", (double)torque.torque_nm, torque.is_derated);
    return true;
}

static void print_outputs(session *s)
{
    jm_module *module = &s->module;
    jm_frame frame;
    while (!s->is_mailbox_full && jm_pop_frame(module, &frame)) {
        printf("%03X#", frame.id);
        for (int i = 0; i < frame.length; i++) {
            printf("%02X", frame.data[i]);
        }
        printf(" ");
    }
    printf("| %d %d %d %d %.7f %.7f %" PRIu32 " %" PRIu32 " %d %d %" PRIu64 "\n", module->state, module->faults,
           module->last_stop, module->demand.mode, (double)module->demand.target,
           (double)module->demand.torque_limit_nm, module->rejected_frame_count, module->dropped_frame_count,
           jm_pop_bridge_feed(module), jm_pop_flash_write(module), s->due_us);
}

/* Runs one event. Returns false for a line that is no event. */
static bool run_event(session *s, char *line)
{
    char *rest = strchr(line, ' ');
    if (rest == NULL) {
        return false;
    }
    *rest = '\0';
    rest++;
    if (strcmp(line, "init") == 0) {
        return read_init(s, rest);
    }
    if (strcmp(line, "flash") == 0) {
        return read_flash(s, rest);
    }
    if (strcmp(line, "sensors") == 0) {
        return read_sensors(s, rest);
    }
    if (strcmp(line, "mailbox") == 0) {
        s->is_mailbox_full = strtol(rest, NULL, 10) == 0;
        return true;
    }
    if (strcmp(line, "torque") == 0) {
        return print_torque(s, rest);
    }
    bool is_frame = strcmp(line, "frame") == 0;
    if (!is_frame && strcmp(line, "poll") != 0) {
        return false;
    }
    bool is_event = is_frame ? receive_frame(s, rest) : poll_module(s, rest);
    if (is_event) {
        print_outputs(s);
    }
    return is_event;
}

int main(void)
{
    static session s;
    static char line[LINE_BYTES];
    while (fgets(line, sizeof line, stdin) != NULL) {
        if (!run_event(&s, line)) {
            fprintf(stderr, "replay: this line is no event: %s\n", line);
            return WRONG_INPUT;
        }
    }
    return 0;
}
