#include "simulated_joint.h"

#include <math.h>

static const double STEP_S = STEP_US * 1e-6;
static const double INJECTED_ABOVE_STOP_K = 5.0;

simulated_joint make_joint(const joint_description *description)
{
    simulated_joint joint = {0};
    joint.angle_rad = description->start_rad;
    joint.winding_c = description->ambient_c;
    return joint;
}

/* Lets the torque follow its demand, exactly for a demand that is constant during the step. */
static void follow_demand(simulated_joint *joint, const joint_description *description, double demanded_torque_nm)
{
    double decay = 0.0;
    if (description->response_time_s > 0.0) {
        decay = exp(-STEP_S / description->response_time_s);
    }
    joint->torque_nm = demanded_torque_nm + decay * (joint->torque_nm - demanded_torque_nm);
}

/* Integrates the motion. Viscous friction is implicit. Dry friction slows a joint, and never reverses it. */
static void move(simulated_joint *joint, const joint_description *description)
{
    double step_per_nm = STEP_S / description->inertia_kg_m2;
    double velocity_rad_s = joint->velocity_rad_s + step_per_nm * joint->torque_nm;
    velocity_rad_s /= 1.0 + step_per_nm * description->viscous_nm_s_per_rad;
    double friction_step_rad_s = step_per_nm * description->friction_nm;
    velocity_rad_s -= fmax(fmin(velocity_rad_s, friction_step_rad_s), -friction_step_rad_s);
    joint->velocity_rad_s = velocity_rad_s;
    joint->angle_rad += STEP_S * velocity_rad_s;
}

static void stop_at_ends(simulated_joint *joint, const joint_description *description)
{
    if (joint->angle_rad > description->upper_rad) {
        joint->angle_rad = description->upper_rad;
        joint->velocity_rad_s = fmin(joint->velocity_rad_s, 0.0);
    }
    if (joint->angle_rad < description->lower_rad) {
        joint->angle_rad = description->lower_rad;
        joint->velocity_rad_s = fmax(joint->velocity_rad_s, 0.0);
    }
}

static void heat(simulated_joint *joint, const joint_description *description)
{
    if (joint->is_kept_hot) {
        return;
    }
    double torque_squared = joint->torque_nm * joint->torque_nm;
    double final_c = description->ambient_c + description->rise_per_torque_squared * torque_squared;
    joint->winding_c += (final_c - joint->winding_c) * STEP_S / description->time_constant_s;
}

void step_joint(simulated_joint *joint, const joint_description *description, double demanded_torque_nm)
{
    follow_demand(joint, description, demanded_torque_nm);
    move(joint, description);
    stop_at_ends(joint, description);
    heat(joint, description);
}

double compute_board_c(const simulated_joint *joint, const joint_description *description)
{
    return description->ambient_c + description->board_fraction * (joint->winding_c - description->ambient_c);
}

void set_overheated(simulated_joint *joint, const joint_description *description, bool is_hot)
{
    joint->is_kept_hot = is_hot;
    if (is_hot) {
        joint->winding_c = description->stop_at_c + INJECTED_ABOVE_STOP_K;
    }
}
