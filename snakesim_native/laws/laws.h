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
