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
