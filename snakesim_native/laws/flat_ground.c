// Flat ground under the feet. The Python version is `snakesim_sim_backend/laws/flat_ground.py`.

#include <math.h>

#include "laws.h"

static const mjtNum SINK_M = 2e-4;         // how deep a foot sinks in under its fraction of the weight
static const mjtNum MAX_PHASE_RAD = 0.7;   // the normal spring vibrates by at most this in one step
static const mjtNum DAMPING_RATIO = 0.5;   // of critical damping
static const mjtNum MIN_DIVISOR = 1e-12;   // keeps 0 / 0 out of the friction of a foot without load
static const mjtNum UP[3] = {0.0, 0.0, 1.0};  // normal of the ground
static const mjtNum FOOT = 1.0;            // first number of a geom's user data, if the geom is a foot

// Parameters of all feet.
typedef struct {
  mjtNum step;                // dt
  mjtNum gravity;             // g, the part of gravity that is normal to the ground
  mjtNum sink;                // sink
  mjtNum damping_root;        // sqrt(g / sink)
  mjtNum start_stretch[2];    // holds a foot on a slope: g_xy sink / g
  mjtNum min_friction;
  const Chain* chain;
} Ground;

// One foot in one step.
typedef struct {
  Foot after;        // what is remembered of it after the step
  mjtNum force[3];   // on the link
  mjtNum lowest[3];  // point of the foot, where the force acts
} FootStep;

static mjtNum maximum(mjtNum a, mjtNum b) { return a >= b || isnan(a) ? a : b; }

// Return the length of a vector, rounded as NumPy rounds the absolute value of a complex number.
static mjtNum compute_length(mjtNum x, mjtNum y) {
  x = fabs(x);
  y = fabs(y);
  mjtNum longer = x > y ? x : y;
  mjtNum shorter = x > y ? y : x;
  if (longer == 0.0 && shorter == 0.0) {
    return 0.0;
  }
  mjtNum ratio = shorter / longer;
  return sqrt(fma(ratio, ratio, 1.0)) * longer;
}

static Ground describe_ground(const mjModel* m, const Chain* chain, mjtNum min_friction) {
  Ground ground;
  mjtNum gravity = -m->opt.gravity[2];
  mjtNum slow = m->opt.timestep / MAX_PHASE_RAD;
  ground.step = m->opt.timestep;
  ground.gravity = gravity;
  ground.sink = SINK_M > gravity * (slow * slow) ? SINK_M : gravity * (slow * slow);
  ground.damping_root = sqrt(gravity / ground.sink);
  ground.start_stretch[0] = m->opt.gravity[0] * (ground.sink / gravity);
  ground.start_stretch[1] = m->opt.gravity[1] * (ground.sink / gravity);
  ground.min_friction = min_friction;
  ground.chain = chain;
  return ground;
}

// Return the other link that a foot belongs to: the one behind its own, if it is at a joint.
static Neighbor find_foot_neighbor(const mjModel* m, const Chain* chain, int geom) {
  int body = m->geom_bodyid[geom];
  int is_at_rear = m->geom_pos[3 * geom] == 0.0;
  if (is_at_rear && body > chain->first_body) {
    return (Neighbor){body - 1, 0.5};
  }
  return (Neighbor){body, 0.0};
}

// Return the coefficients of a foot, by how its links lie on the ground now.
static Coefficients find_foot_coefficients(const mjModel* m, const mjData* d, const Ground* ground, int geom,
                                           Neighbor neighbor) {
  mjtNum mu = m->geom_friction[3 * geom];
  if (!has_directions(m)) {
    return combine_coefficients(mu, mu, mu, 0.0, 0.0, ground->min_friction, 0.0);
  }
  const mjtNum* numbers = find_directions(m, geom);
  if (!faces_underside(d, m->geom_bodyid[geom], neighbor, UP)) {
    return combine_coefficients(mu, mu, mu, numbers[VISCOUS_ACROSS], numbers[VISCOUS_ACROSS], ground->min_friction,
                                0.0);
  }
  return combine_coefficients(numbers[FORWARD], numbers[BACKWARD], numbers[SIDEWAYS], numbers[VISCOUS_ALONG],
                              numbers[VISCOUS_ACROSS], ground->min_friction, numbers[SEPARATE_LIMITS]);
}

// Compute one foot in one step:
//
//   N = max(0, k (r - h) - d dh)                 normal force; dh: rise since the last step
//   ds = dx + dt r (-w_y, w_x)                   slip of the lowest point since the last step
//   s  = (s + ds) min(1, mu N / (k |s + ds|))    stretch of the tangential spring, limited by friction
//   F  = -(k s + d ds), limited to |F| <= mu N   friction force
//
// On ground on which links slide more easily in one direction, directional.c changes F.
static FootStep compute_foot(const mjModel* m, const mjData* d, const Ground* ground, int geom, mjtNum carried_kg,
                             const Foot* before, int placed) {
  const mjtNum* position = d->geom_xpos + 3 * geom;
  const mjtNum* w = d->cvel + 6 * m->geom_bodyid[geom];
  const mjtNum* last = placed ? before->position : position;
  mjtNum r = m->geom_size[3 * geom];
  mjtNum k = carried_kg * ground->gravity / ground->sink;
  mjtNum damping = 2.0 * DAMPING_RATIO * carried_kg * ground->damping_root / ground->step;
  FootStep foot;

  // N
  mjtNum height = position[2] - r;
  mjtNum normal_force = (position[2] - last[2]) * -damping + -k * height;
  normal_force = maximum(normal_force, 0.0);
  int body = m->geom_bodyid[geom];
  Neighbor neighbor = find_foot_neighbor(m, ground->chain, geom);
  Coefficients coefficients = find_foot_coefficients(m, d, ground, geom, neighbor);
  mjtNum max_friction = coefficients.largest * normal_force;
  mjtNum divisor = maximum(max_friction, MIN_DIVISOR);

  // ds, and s + ds
  mjtNum roll = r * ground->step;
  mjtNum slip_x = w[1] * -roll + (position[0] - last[0]);
  mjtNum slip_y = w[0] * roll + (position[1] - last[1]);
  mjtNum stretch_x = (placed ? before->stretch[0] : ground->start_stretch[0]) + slip_x;
  mjtNum stretch_y = (placed ? before->stretch[1] : ground->start_stretch[1]) + slip_y;

  mjtNum stretch[3] = {stretch_x, stretch_y, 0.0};

  // s
  mjtNum scale = max_friction / maximum(k * compute_length(stretch_x, stretch_y), divisor);
  stretch_x *= scale;
  stretch_y *= scale;

  // F
  mjtNum pull_x = -k * stretch_x + slip_x * -damping;
  mjtNum pull_y = -k * stretch_y + slip_y * -damping;
  scale = max_friction / maximum(compute_length(pull_x, pull_y), divisor);
  foot.force[0] = pull_x * scale;
  foot.force[1] = pull_y * scale;
  foot.force[2] = 0.0;
  if (is_directional(&coefficients)) {
    mjtNum slip[3] = {slip_x, slip_y, 0.0};
    mjtNum axis[3];
    find_axis(d, body, neighbor, UP, axis);
    if (coefficients.separate_limits != 0.0) {
      limit_separately(stretch, slip, axis, &coefficients, max_friction, k, damping, normal_force / ground->step,
                       foot.force);
      stretch_x = stretch[0];
      stretch_y = stretch[1];
    } else {
      direct_force(foot.force, slip, axis, &coefficients, normal_force / ground->step);
    }
  }
  foot.force[2] = normal_force;

  foot.lowest[0] = position[0];
  foot.lowest[1] = position[1];
  foot.lowest[2] = height;
  foot.after = (Foot){{stretch_x, stretch_y}, {position[0], position[1], position[2]}, normal_force};
  return foot;
}

// Return the mass that a foot carries when the snake lies straight: half of each link that it ends.
static mjtNum find_carried_kg(const mjModel* m, const Chain* chain, int foot) {
  const mjtNum* mass = m->body_mass + chain->first_body;
  mjtNum ahead = foot < chain->link_count ? mass[foot] : 0.0;
  mjtNum behind = foot > 0 ? mass[foot - 1] : 0.0;
  return 0.5 * (ahead + behind);
}

static int is_foot(const mjModel* m, int geom) {
  return m->nuser_geom > 0 && m->geom_user[geom * m->nuser_geom] == FOOT;
}

void push_feet(const mjModel* m, const mjData* d, const Chain* chain, const Foot* feet, int placed,
               mjtNum min_friction, mjtNum* wrenches) {
  Ground ground = describe_ground(m, chain, min_friction);
  int count = 0;
  for (int link = 0; link < chain->link_count; link++) {
    int body = chain->first_body + link;
    int end = m->body_geomadr[body] + m->body_geomnum[body];
    mjtNum wrench[WRENCH_SIZE] = {0};  // of this link's feet
    for (int geom = m->body_geomadr[body]; geom < end; geom++) {
      if (is_foot(m, geom) && count <= chain->link_count) {
        FootStep foot = compute_foot(m, d, &ground, geom, find_carried_kg(m, chain, count), feet + count, placed);
        add_force(d, chain, foot.force, foot.lowest, wrench);
        count++;
      }
    }
    for (int i = 0; i < WRENCH_SIZE; i++) {
      wrenches[WRENCH_SIZE * link + i] += wrench[i];
    }
  }
}

void update_feet(const mjModel* m, const mjData* d, const Chain* chain, Foot* feet, int placed, mjtNum min_friction) {
  Ground ground = describe_ground(m, chain, min_friction);
  int last_body = chain->first_body + chain->link_count - 1;
  int end = m->body_geomadr[last_body] + m->body_geomnum[last_body];
  int count = 0;
  for (int geom = m->body_geomadr[chain->first_body]; geom < end; geom++) {
    if (is_foot(m, geom) && count <= chain->link_count) {
      mjtNum carried_kg = find_carried_kg(m, chain, count);
      feet[count] = compute_foot(m, d, &ground, geom, carried_kg, feet + count, placed).after;
      count++;
    }
  }
}
