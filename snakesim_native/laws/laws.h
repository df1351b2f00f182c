// The forces that MuJoCo does not compute, in C: the same laws as in `snakesim_sim_backend/laws`, which explain them.
//
// Every function here computes the same bits as its Python version: it adds and multiplies in the same order. Symbols
// are those of the equations in the Python version. All vectors are in the world frame, all quantities in SI units.
//
// Nothing here has memory of its own. Parameters are in mjModel, and what a law has to remember is in MuJoCo's
// `plugin_state`. So any number of threads may step simulations at the same time, each with its own mjData.

#ifndef SNAKESIM_LAWS_H_
#define SNAKESIM_LAWS_H_

#include <mujoco/mujoco.h>

enum {
  WORLD_BODY = 0,          // MuJoCo's number of the body that does not move
  FREE_DOFS = 6,           // degrees of freedom of the base
  WRENCH_SIZE = 6,         // a moment about the snake's center of mass in N·m, then a force in N
  CONTACTS_PER_LINK = 16,  // on average; the contacts beyond that number have no friction
};

//---------------------------------- The links -------------------------------------------------------------------------

// The links of one snake: consecutive bodies, tail to head, each the child of the one before.
typedef struct {
  int first_body;
  int link_count;
} Chain;

// Return the chain that begins at the first body of a plugin instance.
Chain find_chain(const mjModel* m, int instance);

// Return whether a body is a link.
int is_link(const Chain* chain, int body);

// Add a force at a point of a link to the link's wrench.
void add_force(const mjData* d, const Chain* chain, const mjtNum force[3], const mjtNum point[3],
               mjtNum wrench[WRENCH_SIZE]);

// Add the generalized forces of the links' wrenches, (link_count x WRENCH_SIZE), to MuJoCo's passive forces.
void apply_wrenches(const mjModel* m, mjData* d, const Chain* chain, const mjtNum* wrenches);

//---------------------------------- Directions ------------------------------------------------------------------------

// Numbers of a geom in its user data. For a foot and a surface they are coefficients with the underside of a link, for
// a link they are factors on the coefficients of a surface.
enum { FOOT_MARK, FORWARD, BACKWARD, SIDEWAYS, VISCOUS_ALONG, VISCOUS_ACROSS, SEPARATE_LIMITS, USER_NUMBERS };

// Coefficients of one contact or foot.
typedef struct {
  mjtNum largest;  // mu
  mjtNum forward;  // divided by the largest; likewise the next two
  mjtNum backward;
  mjtNum sideways;
  mjtNum viscous_along;    // s/m
  mjtNum viscous_across;   // s/m
  mjtNum separate_limits;  // 1: friction along the link and across it do not limit each other
} Coefficients;

// The link that a point of a link is nearest to besides its own, and the weight of its direction.
typedef struct {
  int body;
  mjtNum weight;  // 0 in the middle of the link, 0.5 at a joint
} Neighbor;

// Return whether a model has the numbers of directions.
int has_directions(const mjModel* m);

// Return the user data of a geom.
const mjtNum* find_directions(const mjModel* m, int geom);

// Return whether the force differs from isotropic dry friction with the largest coefficient.
int is_directional(const Coefficients* coefficients);

// Return the coefficients of a contact, none of which is lower than `min_friction`.
Coefficients combine_coefficients(mjtNum forward, mjtNum backward, mjtNum sideways, mjtNum viscous_along,
                                  mjtNum viscous_across, mjtNum min_friction, mjtNum separate_limits);

// Return the neighbor at a distance from the link's rear joint.
Neighbor find_neighbor(const mjModel* m, const Chain* chain, int body, mjtNum along);

// Return whether a surface with this normal, which points into the link, touches the underside.
int faces_underside(const mjData* d, int body, Neighbor neighbor, const mjtNum normal[3]);

// Write the direction of the underside in the plane of contact: a unit vector, or 0 if there is none.
void find_axis(const mjData* d, int body, Neighbor neighbor, const mjtNum normal[3], mjtNum axis[3]);

// Make the friction force on a link from isotropic friction with the largest coefficient.
//   slip                  of the link in the last step
//   damping_per_viscous   normal force divided by the time step
void direct_force(mjtNum force[3], const mjtNum slip[3], const mjtNum axis[3], const Coefficients* coefficients,
                  mjtNum damping_per_viscous);

// Limit the spring of a contact along the link and across it, each by its own coefficient.
//   stretch               in: with the slip of this step; out: after this step
//   slip                  of the link in the last step
//   force                 friction force on the link, which is written
//   max_friction          normal force times the largest coefficient
//   k, damping            stiffness and damping of the spring
//   damping_per_viscous   normal force divided by the time step
void limit_separately(mjtNum stretch[3], const mjtNum slip[3], const mjtNum axis[3], const Coefficients* coefficients,
                      mjtNum max_friction, mjtNum k, mjtNum damping, mjtNum damping_per_viscous, mjtNum force[3]);

//---------------------------------- Flat ground -----------------------------------------------------------------------

// What the ground remembers of a foot.
typedef struct {
  mjtNum stretch[2];    // s, of the tangential spring, m
  mjtNum position[3];   // of the center in the last step, m
  mjtNum normal_force;  // N of the last step
} Foot;

// Add the ground's forces on the feet to the wrenches of the links.
//   placed         0: the feet stick where they are now
//   min_friction   lowest coefficient that is used
void push_feet(const mjModel* m, const mjData* d, const Chain* chain, const Foot* feet, int placed,
               mjtNum min_friction, mjtNum* wrenches);

// Remember the feet after a step.
void update_feet(const mjModel* m, const mjData* d, const Chain* chain, Foot* feet, int placed, mjtNum min_friction);

//---------------------------------- Contact friction ------------------------------------------------------------------

// What is remembered of a contact with friction.
typedef struct {
  mjtNum key;             // of the two geoms, and of the contact among theirs
  mjtNum link_body;
  mjtNum other_body;
  mjtNum mass;            // m, that the spring has to follow
  mjtNum max_friction;    // mu N
  mjtNum normal[3];       // n, from the other body into the link
  mjtNum stretch[3];      // s, of the tangential spring
  mjtNum link_point[3];   // the contact point in the frame of the link
  mjtNum other_point[3];  // the contact point in the frame of the other body
  mjtNum force[3];        // friction force on the link in the last step; 0 for a new contact
  mjtNum number;          // in MuJoCo's contacts of the last step
  mjtNum is_new;          // 1: it had no friction force in the last step
  mjtNum forward;         // coefficient divided by mu; likewise the next two
  mjtNum backward;
  mjtNum sideways;
  mjtNum viscous_along;   // N·s/m
  mjtNum viscous_across;  // N·s/m
  mjtNum separate_limits;  // 1: friction along the link and across it do not limit each other
} RoughContact;

// Add the friction forces to the wrenches of the links, and the opposite forces to the bodies that they touch.
void rub_links(const mjModel* m, mjData* d, const Chain* chain, const RoughContact* contacts, int count,
               mjtNum* wrenches);

// Remember the contacts after a step. Returns their number.
int update_contacts(const mjModel* m, mjData* d, const Chain* chain, RoughContact* contacts, int count,
                    mjtNum min_friction);

//---------------------------------- Contacts of links with obstacles --------------------------------------------------

enum {
  OBSTACLE_GROUP = 2,          // MuJoCo's geom group of obstacles
  TOUCHES_PER_LINK = 8,        // on average; those beyond that number are left out
  MEASURED_PAIRS_PER_LINK = 4  // on average, of a link and an obstacle; those beyond that number are left out
};

// A contact of a link with an obstacle in the last step.
typedef struct {
  int link_geom;
  int obstacle_geom;
  mjtNum normal[3];          // from the obstacle into the link
  mjtNum normal_force;
  mjtNum friction_force[3];  // on the link
} ObstacleContact;

// Return whether one of MuJoCo's contacts is between a link and an obstacle, and describe it.
//   contacts   those with friction, after `update_contacts`
int find_obstacle_contact(const mjModel* m, const mjData* d, const RoughContact* contacts, int count, int number,
                          ObstacleContact* result);

// The force of a contact with an obstacle, for programs that see only the state.
typedef struct {
  mjtNum link;      // 0 at the tail
  mjtNum force[3];  // on the link
} Touch;

// Write the contacts of links with obstacles, in MuJoCo's order. Returns their number.
int find_touches(const mjModel* m, const mjData* d, const Chain* chain, const RoughContact* contacts, int count,
                 Touch* touches, int capacity);

// The forces between one link and one obstacle. The samples of the last steps follow: one number for each step.
typedef struct {
  mjtNum link_geom;
  mjtNum obstacle_geom;
  mjtNum idle_steps;  // steps since they touched
} MeasuredPair;

// The memory of the measured force. The pairs follow.
typedef struct {
  mjtNum max_mean_force;  // of the pair that pushes hardest, averaged over the window, in N
  mjtNum pair_count;
  mjtNum newest;          // index of the newest sample of every pair
} MeasuredForce;

// Return over how many steps the measured force is averaged.
int count_window_steps(const mjModel* m);

// Return how many numbers the memory of the measured force has.
int count_measured_numbers(const mjModel* m, int pair_capacity);

// Add the forces of the last step to the measured force.
void measure_forces(const mjModel* m, const mjData* d, const RoughContact* contacts, int count, MeasuredForce* memory,
                    int pair_capacity);

//---------------------------------- Obstacles that yield --------------------------------------------------------------

enum { YIELDING_DOFS = 3 };  // of one obstacle: along x, along y, and a rotation

// Return the number of obstacles of a plugin instance.
int count_yielding(const mjModel* m, int instance);

// What is remembered of an obstacle's spring.
typedef struct {
  mjtNum anchor[YIELDING_DOFS];       // a
  mjtNum next_anchor[YIELDING_DOFS];  // a after this step. At its end MuJoCo has moved q, from which it follows.
} Anchor;

// Add the forces of the obstacles' springs to MuJoCo's passive forces, and compute the next anchors.
void pull_obstacles(const mjModel* m, mjData* d, int instance, Anchor* anchors);

// Let the anchors slip after a step.
void update_anchors(Anchor* anchors, int count);

#endif  // SNAKESIM_LAWS_H_
