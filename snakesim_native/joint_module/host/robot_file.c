#include "robot_file.h"

#include <errno.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LINE_BYTES = 4096 };

static const char SEPARATORS[] = " \t\n";

typedef struct {
    const char *key;
    size_t offset; /* of a double in a `module_description` */
} field;

#define JOINT_FIELD(name) {#name, offsetof(module_description, joint) + offsetof(joint_description, name)}

static const field FIELDS[] = {
    {"has_imu", offsetof(module_description, has_imu)},
    JOINT_FIELD(rated_torque_nm),
    JOINT_FIELD(rated_speed_rad_s),
    JOINT_FIELD(response_time_s),
    JOINT_FIELD(inertia_kg_m2),
    JOINT_FIELD(viscous_nm_s_per_rad),
    JOINT_FIELD(friction_nm),
    JOINT_FIELD(lower_rad),
    JOINT_FIELD(upper_rad),
    JOINT_FIELD(start_rad),
    JOINT_FIELD(ambient_c),
    JOINT_FIELD(rise_per_torque_squared),
    JOINT_FIELD(time_constant_s),
    JOINT_FIELD(board_fraction),
    JOINT_FIELD(derate_from_c),
    JOINT_FIELD(stop_at_c),
    JOINT_FIELD(voltage_v),
    JOINT_FIELD(min_voltage_v),
    JOINT_FIELD(idle_a),
};

enum { FIELD_COUNT = sizeof FIELDS / sizeof FIELDS[0] };

static bool set_field(module_description *description, const char *key, double value)
{
    if (strcmp(key, "node") == 0) {
        description->node = (unsigned)value;
        return value >= JM_FIRST_NODE && value <= JM_LAST_NODE;
    }
    if (strcmp(key, "serial") == 0) {
        description->serial = (uint32_t)value;
        return value >= 0.0 && value <= (double)UINT32_MAX;
    }
    for (int i = 0; i < FIELD_COUNT; i++) {
        if (strcmp(key, FIELDS[i].key) == 0) {
            memcpy((char *)description + FIELDS[i].offset, &value, sizeof value);
            return true;
        }
    }
    return false;
}

/* Returns whether the numbers make a joint that can be simulated. */
static bool is_possible(const module_description *description)
{
    const joint_description *joint = &description->joint;
    return description->node >= JM_FIRST_NODE && joint->inertia_kg_m2 > 0.0 && joint->time_constant_s > 0.0 &&
           joint->voltage_v > 0.0 && joint->stop_at_c > joint->derate_from_c && joint->upper_rad > joint->lower_rad;
}

static bool read_line(module_description *description, char *line)
{
    memset(description, 0, sizeof *description);
    char *name = strtok(line, SEPARATORS);
    if (name == NULL || strlen(name) >= MAX_NAME_BYTES) {
        return false;
    }
    strcpy(description->name, name);
    char *key = strtok(NULL, SEPARATORS);
    while (key != NULL) {
        char *number = strtok(NULL, SEPARATORS);
        char *end = NULL;
        double value = number == NULL ? 0.0 : strtod(number, &end);
        if (number == NULL || end == number || *end != '\0' || !set_field(description, key, value)) {
            fprintf(stderr, "%s: `%s` is no key with a possible number\n", name, key);
            return false;
        }
        key = strtok(NULL, SEPARATORS);
    }
    return is_possible(description);
}

int read_robot_file(const char *path, module_description *descriptions, int max_modules)
{
    static char line[LINE_BYTES];
    FILE *file = fopen(path, "r");
    if (file == NULL) {
        fprintf(stderr, "%s: %s\n", path, strerror(errno));
        return 0;
    }
    int count = 0;
    while (fgets(line, sizeof line, file) != NULL) {
        if (count >= max_modules || !read_line(&descriptions[count], line)) {
            fprintf(stderr, "%s, line %d: this is no module of a robot with at most %d modules\n", path, count + 1,
                    max_modules);
            count = 0;
            break;
        }
        count++;
    }
    fclose(file);
    return count;
}
