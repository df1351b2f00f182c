/* A simulated joint behind a module: its motor, an inertia of its own with friction and end stops, and a winding that
 * warms up. It has no gravity, no ground and no neighbors. All values are those at the shaft of the module.
 */
#ifndef SIMULATED_JOINT_H
#define SIMULATED_JOINT_H

#include <stdbool.h>

enum { STEP_US = 1000 }; /* duration of a simulation step */

/* What a joint is. */
typedef struct {
    /* Motor. */
    double rated_torque_nm;
    double rated_speed_rad_s;
    double response_time_s; /* the torque follows its demand as a lag of this time constant */

    /* Body. */
    double inertia_kg_m2;
    double viscous_nm_s_per_rad;
    double friction_nm;
    double lower_rad;
    double upper_rad;
    double start_rad;

    /* Heat. */
    double ambient_c;
    double rise_per_torque_squared; /* final temperature rise of the winding, K/(N·m)^2 */
    double time_constant_s;
    double board_fraction; /* temperature rise of the board as a fraction of the winding's */
    double derate_from_c;
    double stop_at_c;

    /* Supply. */
    double voltage_v;
    double min_voltage_v;
    double idle_a;
} joint_description;

/* The present state of a joint. */
typedef struct {
    double angle_rad;
    double velocity_rad_s;
    double torque_nm;
    double winding_c;
    bool is_kept_hot; /* by an injected fault */
} simulated_joint;

/* Returns a joint at rest, at its start angle and the ambient temperature. */
simulated_joint make_joint(const joint_description *description);

/* Advances a joint by one step under a demanded torque. */
void step_joint(simulated_joint *joint, const joint_description *description, double demanded_torque_nm);

/* Returns the temperature of the electronics. */
double compute_board_c(const simulated_joint *joint, const joint_description *description);

/* Heats the winding to 5 K above the temperature at which the module stops, or lets it cool down. */
void set_overheated(simulated_joint *joint, const joint_description *description, bool is_hot);

#endif
