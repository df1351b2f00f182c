#include "parameters.h"

#include "frames.h"

/* Bounds have single precision on the bus, where 0.1 becomes slightly more. So a value may be beyond a bound by this
 * fraction of the larger bound, and then becomes the bound. */
static const double RANGE_TOLERANCE = 1e-6;

static const float MAX_RATING = 32.767f; /* N·m or rad/s, as far as 16 bits reach on the bus */

typedef struct {
    double low;
    double high;
    bool is_integer;
    bool is_writable;
} parameter_range;

static const parameter_range RANGES[JM_PARAMETER_COUNT] = {
    {0.0, 0.0, false, false}, /* index 0 is not used */
    [JM_STIFFNESS] = {0.0, 1e5, false, true},
    [JM_DAMPING] = {0.0, 1e4, false, true},
    [JM_VELOCITY_GAIN] = {0.0, 1e4, false, true},
    [JM_TORQUE_LIMIT] = {0.0, 32.767, false, true},
    [JM_SPEED_LIMIT] = {0.0, 32.767, false, true},
    [JM_ANGLE_LIMIT] = {0.0, 3.2767, false, true},
    [JM_WATCHDOG] = {0.02, 0.1, false, true},
    [JM_STOP_MODE] = {0.0, 1.0, true, true},
    [JM_CONTACT_EVERY] = {0.0, 255.0, true, true},
    [JM_IMU_EVERY] = {0.0, 255.0, true, true},
    [JM_TAIL] = {0.0, 1.0, true, true},
    [JM_RATED_TORQUE] = {0.0, 32.767, false, false},
    [JM_RATED_SPEED] = {0.0, 32.767, false, false},
};

typedef enum { OPERATION_READ = 0, OPERATION_WRITE = 1, OPERATION_SAVE = 2 } operation;

typedef enum {
    RESULT_DONE = 0,
    RESULT_UNKNOWN_INDEX = 1,
    RESULT_READ_ONLY = 2,
    RESULT_OUT_OF_RANGE = 3,
    RESULT_NOT_WHILE_ARMED = 4,
    RESULT_UNKNOWN_OPERATION = 5
} result;

/* A number of single precision, and its bits. */
typedef union {
    float value;
    uint32_t bits;
} float_bits;

static const uint32_t EXPONENT_BITS = 0x7F800000; /* All are set in NaN and in an infinite number. */

static bool is_finite(float value)
{
    float_bits number = {value};
    return (number.bits & EXPONENT_BITS) != EXPONENT_BITS;
}

/* Moves a value that is just beyond a bound to the bound. Returns false if it is out of range, or no number. */
static bool clamp_to_range(const parameter_range *range, float *value)
{
    if (!is_finite(*value)) {
        return false;
    }
    double tolerance = RANGE_TOLERANCE * range->high;
    double requested = (double)*value;
    if (requested < range->low - tolerance || requested > range->high + tolerance) {
        return false;
    }
    if (requested < range->low) {
        *value = (float)range->low;
    }
    if (requested > range->high) {
        *value = (float)range->high;
    }
    /* The value is within the range of a `long` here, as far as integers are concerned. */
    return !range->is_integer || *value == (float)(long)*value;
}

jm_parameters jm_make_factory_parameters(float rated_torque_nm, float rated_speed_rad_s)
{
    jm_parameters parameters = {{0}};
    float torque_nm = rated_torque_nm < MAX_RATING ? rated_torque_nm : MAX_RATING;
    float speed_rad_s = rated_speed_rad_s < MAX_RATING ? rated_speed_rad_s : MAX_RATING;
    parameters.values[JM_TORQUE_LIMIT] = torque_nm;
    parameters.values[JM_SPEED_LIMIT] = speed_rad_s;
    parameters.values[JM_ANGLE_LIMIT] = (float)RANGES[JM_ANGLE_LIMIT].high;
    parameters.values[JM_WATCHDOG] = (float)RANGES[JM_WATCHDOG].high;
    parameters.values[JM_STOP_MODE] = 1.0f;
    parameters.values[JM_CONTACT_EVERY] = 1.0f;
    parameters.values[JM_RATED_TORQUE] = torque_nm;
    parameters.values[JM_RATED_SPEED] = speed_rad_s;
    return parameters;
}

jm_parameters jm_check_flash(const jm_parameters *flash, const jm_config *config)
{
    jm_parameters checked = jm_make_factory_parameters(config->rated_torque_nm, config->rated_speed_rad_s);
    for (int index = 1; index < JM_PARAMETER_COUNT; index++) {
        float value = flash->values[index];
        if (RANGES[index].is_writable && clamp_to_range(&RANGES[index], &value)) {
            checked.values[index] = value;
        }
    }
    return checked;
}

static result write_value(jm_module *module, uint32_t index, float value)
{
    if (!clamp_to_range(&RANGES[index], &value)) {
        return RESULT_OUT_OF_RANGE;
    }
    module->parameters.values[index] = value;
    return RESULT_DONE;
}

static result save_value(jm_module *module, uint32_t index)
{
    module->flash.values[index] = module->parameters.values[index];
    module->is_flash_write_due = true;
    return RESULT_DONE;
}

/* Writes or saves a parameter, unless it is read-only or the motor is driven. */
static result change_parameter(jm_module *module, uint32_t index, operation requested, float value)
{
    if (!RANGES[index].is_writable) {
        return RESULT_READ_ONLY;
    }
    if (jm_is_driven(module)) {
        return RESULT_NOT_WHILE_ARMED;
    }
    if (requested == OPERATION_SAVE) {
        return save_value(module, index);
    }
    return write_value(module, index, value);
}

static result execute_operation(jm_module *module, uint32_t index, uint32_t requested, float value)
{
    if (index == 0 || index >= JM_PARAMETER_COUNT) {
        return RESULT_UNKNOWN_INDEX;
    }
    switch (requested) {
    case OPERATION_READ:
        return RESULT_DONE;
    case OPERATION_WRITE:
    case OPERATION_SAVE:
        return change_parameter(module, index, (operation)requested, value);
    default:
        return RESULT_UNKNOWN_OPERATION;
    }
}

jm_frame jm_answer_parameter_request(jm_module *module, const jm_frame *request)
{
    uint32_t index = jm_read_bits(request, 0, 8);
    uint32_t requested = jm_read_bits(request, 8, 4);
    float_bits number;
    number.bits = jm_read_bits(request, 16, 32);
    result outcome = execute_operation(module, index, requested, number.value);
    number.value = 0.0f;
    if (outcome != RESULT_UNKNOWN_INDEX) {
        number.value = module->parameters.values[index];
    }
    jm_frame answer = jm_make_frame(JM_OPCODE_PARAMETER_ANSWER, module->config.node, JM_PARAMETER_BYTES);
    jm_write_bits(&answer, 0, 8, index);
    jm_write_bits(&answer, 8, 4, requested);
    jm_write_bits(&answer, 12, 4, (uint32_t)outcome);
    jm_write_bits(&answer, 16, 32, number.bits);
    return answer;
}

uint8_t jm_get_count(const jm_module *module, jm_parameter parameter)
{
    return (uint8_t)module->parameters.values[parameter];
}

uint64_t jm_get_watchdog_us(const jm_module *module)
{
    return (uint64_t)((double)module->parameters.values[JM_WATCHDOG] * 1e6 + 0.5);
}
