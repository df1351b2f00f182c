// The laws as plugins of MuJoCo's engine, which are registered when this library is loaded:
//
//   snakesim.dry_friction   flat ground and contact friction; belongs to the tail link's body
//   snakesim.yielding       obstacles that yield; one instance belongs to the bodies of all of them
//
// Two more are no laws. They write forces between links and obstacles into the state, and belong to no body:
//
//   snakesim.touches         those of the last step, for batches
//   snakesim.measured_force  their mean over 50 ms, for contact sensors
//
// MuJoCo calls `compute` when it computes forces. That changes nothing that a later step depends on, so `mj_forward`
// may be called at any time. MuJoCo calls `advance` at the end of `mj_step`, which updates what is remembered. By then
// it has changed the positions and velocities of the joints, but not those of bodies and geoms.
//
// A model needs the integrator Euler or implicit: both compute the forces once in a step.

#include "laws.h"

enum { SUCCESS = 0 };

//---------------------------------- Dry friction ----------------------------------------------------------------------

// The memory of an instance. Feet and contacts follow: one foot more than links, then the contacts.
typedef struct {
  mjtNum placed;         // 0: the feet stick where they are now, and there are no contacts yet
  mjtNum min_friction;   // lowest coefficient that is used; above 0 only while a robot settles
  mjtNum contact_count;
} Memory;

enum {
  MEMORY_NUMBERS = sizeof(Memory) / sizeof(mjtNum),
  FOOT_NUMBERS = sizeof(Foot) / sizeof(mjtNum),
  CONTACT_NUMBERS = sizeof(RoughContact) / sizeof(mjtNum),
};

// The memory of an instance, by its parts.
typedef struct {
  Memory* memory;
  Foot* feet;
  RoughContact* contacts;
} Parts;

static Parts find_parts(const mjModel* m, const mjData* d, int instance, const Chain* chain) {
  mjtNum* state = d->plugin_state + m->plugin_stateadr[instance];
  Parts parts;
  parts.memory = (Memory*)state;
  parts.feet = (Foot*)(state + MEMORY_NUMBERS);
  parts.contacts = (RoughContact*)(state + MEMORY_NUMBERS + FOOT_NUMBERS * (chain->link_count + 1));
  return parts;
}

static int count_friction_numbers(const mjModel* m, int instance) {
  Chain chain = find_chain(m, instance);
  return MEMORY_NUMBERS + FOOT_NUMBERS * (chain.link_count + 1) +
         CONTACT_NUMBERS * CONTACTS_PER_LINK * chain.link_count;
}

static void compute_friction(const mjModel* m, mjData* d, int instance, int capability) {
  (void)capability;
  Chain chain = find_chain(m, instance);
  if (chain.link_count == 0) {
    return;
  }
  Parts parts = find_parts(m, d, instance, &chain);
  mj_markStack(d);
  mjtNum* wrenches = mj_stackAllocNum(d, (size_t)WRENCH_SIZE * chain.link_count);
  mju_zero(wrenches, WRENCH_SIZE * chain.link_count);
  rub_links(m, d, &chain, parts.contacts, (int)parts.memory->contact_count, wrenches);
  push_feet(m, d, &chain, parts.feet, parts.memory->placed != 0.0, parts.memory->min_friction, wrenches);
  apply_wrenches(m, d, &chain, wrenches);
  mj_freeStack(d);
}

static void advance_friction(const mjModel* m, mjData* d, int instance) {
  Chain chain = find_chain(m, instance);
  if (chain.link_count == 0) {
    return;
  }
  Parts parts = find_parts(m, d, instance, &chain);
  Memory* memory = parts.memory;
  update_feet(m, d, &chain, parts.feet, memory->placed != 0.0, memory->min_friction);
  memory->placed = 1.0;
  memory->contact_count =
      update_contacts(m, d, &chain, parts.contacts, (int)memory->contact_count, memory->min_friction);
}

//---------------------------------- Obstacles that yield --------------------------------------------------------------

enum { ANCHOR_NUMBERS = sizeof(Anchor) / sizeof(mjtNum) };

static int count_yielding_numbers(const mjModel* m, int instance) {
  return ANCHOR_NUMBERS * count_yielding(m, instance);
}

static Anchor* find_anchors(const mjModel* m, const mjData* d, int instance) {
  return (Anchor*)(d->plugin_state + m->plugin_stateadr[instance]);
}

static void compute_yielding(const mjModel* m, mjData* d, int instance, int capability) {
  (void)capability;
  pull_obstacles(m, d, instance, find_anchors(m, d, instance));
}

static void advance_yielding(const mjModel* m, mjData* d, int instance) {
  update_anchors(find_anchors(m, d, instance), m->plugin_statenum[instance] / ANCHOR_NUMBERS);
}

//---------------------------------- Contacts of links with obstacles --------------------------------------------------

enum { TOUCH_NUMBERS = sizeof(Touch) / sizeof(mjtNum) };

// Return the instance of dry friction, or -1.
static int find_friction_instance(const mjModel* m) {
  for (int instance = 0; instance < m->nplugin; instance++) {
    if (mjp_getPluginAtSlot(m->plugin[instance])->advance == advance_friction) {
      return instance;
    }
  }
  return -1;
}

// Return the number of links; 0 without the plugin of dry friction.
static int count_links(const mjModel* m) {
  int friction = find_friction_instance(m);
  return friction < 0 ? 0 : find_chain(m, friction).link_count;
}

// The number of touches comes first, then the touches.
static int count_touch_numbers(const mjModel* m, int instance) {
  (void)instance;
  return 1 + TOUCH_NUMBERS * TOUCHES_PER_LINK * count_links(m);
}

static int count_measured_force_numbers(const mjModel* m, int instance) {
  (void)instance;
  return count_measured_numbers(m, MEASURED_PAIRS_PER_LINK * count_links(m));
}

static void compute_nothing(const mjModel* m, mjData* d, int instance, int capability) {
  (void)m;
  (void)d;
  (void)instance;
  (void)capability;
}

// Is called after dry friction has advanced, whose instance has a lower number.
static void advance_touches(const mjModel* m, mjData* d, int instance) {
  int friction = find_friction_instance(m);
  if (friction < 0) {
    return;
  }
  Chain chain = find_chain(m, friction);
  Parts parts = find_parts(m, d, friction, &chain);
  mjtNum* state = d->plugin_state + m->plugin_stateadr[instance];
  int capacity = TOUCHES_PER_LINK * chain.link_count;
  state[0] = find_touches(m, d, &chain, parts.contacts, (int)parts.memory->contact_count, (Touch*)(state + 1), capacity);
}

// Is called after dry friction has advanced, too.
static void advance_measured_force(const mjModel* m, mjData* d, int instance) {
  int friction = find_friction_instance(m);
  if (friction < 0) {
    return;
  }
  Chain chain = find_chain(m, friction);
  Parts parts = find_parts(m, d, friction, &chain);
  MeasuredForce* memory = (MeasuredForce*)(d->plugin_state + m->plugin_stateadr[instance]);
  int capacity = MEASURED_PAIRS_PER_LINK * chain.link_count;
  measure_forces(m, d, parts.contacts, (int)parts.memory->contact_count, memory, capacity);
}

//---------------------------------- Registration ----------------------------------------------------------------------

static int init(const mjModel* m, mjData* d, int instance) {
  (void)m;
  (void)d;
  (void)instance;
  return SUCCESS;
}

static void reset(const mjModel* m, mjtNum* plugin_state, void* plugin_data, int instance) {
  (void)plugin_data;
  mju_zero(plugin_state, m->plugin_statenum[instance]);
}

static mjpPlugin describe_plugin(const char* name) {
  mjpPlugin plugin;
  mjp_defaultPlugin(&plugin);
  plugin.name = name;
  plugin.capabilityflags = mjPLUGIN_PASSIVE;
  plugin.init = init;
  plugin.reset = reset;
  return plugin;
}

mjPLUGIN_LIB_INIT(snakesim_laws) {
  mjpPlugin friction = describe_plugin("snakesim.dry_friction");
  friction.nstate = count_friction_numbers;
  friction.compute = compute_friction;
  friction.advance = advance_friction;
  mjp_registerPlugin(&friction);

  mjpPlugin yielding = describe_plugin("snakesim.yielding");
  yielding.nstate = count_yielding_numbers;
  yielding.compute = compute_yielding;
  yielding.advance = advance_yielding;
  mjp_registerPlugin(&yielding);

  mjpPlugin touches = describe_plugin("snakesim.touches");
  touches.nstate = count_touch_numbers;
  touches.compute = compute_nothing;
  touches.advance = advance_touches;
  mjp_registerPlugin(&touches);

  mjpPlugin measured_force = describe_plugin("snakesim.measured_force");
  measured_force.nstate = count_measured_force_numbers;
  measured_force.compute = compute_nothing;
  measured_force.advance = advance_measured_force;
  mjp_registerPlugin(&measured_force);
}

// Change the memory of all laws as `mj_step` does at its end, for a program that calls `mj_forward` alone. A force is
// measured over time, so it changes in `mj_step` only.
void snakesim_advance(const mjModel* m, mjData* d);

void snakesim_advance(const mjModel* m, mjData* d) {
  for (int instance = 0; instance < m->nplugin; instance++) {
    const mjpPlugin* plugin = mjp_getPluginAtSlot(m->plugin[instance]);
    if (plugin->advance == advance_friction || plugin->advance == advance_yielding ||
        plugin->advance == advance_touches) {
      plugin->advance(m, d, instance);
    }
  }
}
