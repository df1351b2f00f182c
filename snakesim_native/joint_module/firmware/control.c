/* The torque of the motor: the laws of all modes, and the limits. */
#include "joint_module.h"

/* Full torque is available up to 9/10 of the speed limit, and none at the limit. */
static const float ROLL_OFF_STEEPNESS = 10.0f;

/* The fraction of its rated torque that the hottest winding may still use. */
static const float MIN_TORQUE_FRACTION = 0.2f;

static float get_smaller(float a, float b)
{
    return a < b ? a : b;
}

static float clamp_to(float value, float low, float high)
{
    if (value < low) {
        return low;
    }
    if (value > high) {
        return high;
    }
    return value;
}

static float compute_demanded_torque_nm(const jm_module *module, float angle_rad, float velocity_rad_s)
{
    const float *values = module->parameters.values;
    float target = module->demand.target;
    switch (module->demand.mode) {
    case JM_PASSIVE:
        return 0.0f;
    case JM_POSITION:
        return values[JM_STIFFNESS] * (target - angle_rad) - values[JM_DAMPING] * velocity_rad_s;
    case JM_VELOCITY:
        return values[JM_VELOCITY_GAIN] * (target - velocity_rad_s);
    case JM_TORQUE:
        return target;
    }
    return 0.0f;
}

/* Reduces a torque that would accelerate the motor beyond its speed limit. */
static float limit_by_speed(const jm_module *module, float torque_nm, float velocity_rad_s)
{
    float speed_limit_rad_s = module->parameters.values[JM_SPEED_LIMIT];
    if (speed_limit_rad_s <= 0.0f) {
        return 0.0f;
    }
    float stall_torque_nm = ROLL_OFF_STEEPNESS * module->parameters.values[JM_RATED_TORQUE];
    float reduction_nm = stall_torque_nm * velocity_rad_s / speed_limit_rad_s;
    return clamp_to(torque_nm, -stall_torque_nm - reduction_nm, stall_torque_nm - reduction_nm);
}

/* Returns the torque that the winding's temperature allows. */
static float compute_derated_limit_nm(const jm_module *module)
{
    float from_c = (float)module->config.derate_from_tenths_c;
    float to_c = (float)module->config.stop_at_tenths_c;
    float progress = clamp_to(((float)module->sensors.winding_tenths_c - from_c) / (to_c - from_c), 0.0f, 1.0f);
    return module->parameters.values[JM_RATED_TORQUE] * (1.0f - (1.0f - MIN_TORQUE_FRACTION) * progress);
}

jm_torque jm_compute_torque(const jm_module *module, float angle_rad, float velocity_rad_s)
{
    jm_torque output = {0.0f, false};
    if (!jm_is_driven(module)) {
        return output;
    }
    float demanded_nm = compute_demanded_torque_nm(module, angle_rad, velocity_rad_s);
    float commanded_limit_nm = get_smaller(
        module->demand.torque_limit_nm,
        get_smaller(module->parameters.values[JM_TORQUE_LIMIT], module->parameters.values[JM_RATED_TORQUE]));
    float derated_limit_nm = compute_derated_limit_nm(module);
    float requested_nm = clamp_to(
        limit_by_speed(module, demanded_nm, velocity_rad_s), -commanded_limit_nm, commanded_limit_nm);
    output.torque_nm = clamp_to(requested_nm, -derated_limit_nm, derated_limit_nm);
    output.is_derated = output.torque_nm != requested_nm;
    return output;
}
