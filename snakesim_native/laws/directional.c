// Friction that depends on the direction in which a link slides. The Python version is
// `snakesim_sim_backend/laws/directional.py`.

#include <math.h>

#include "laws.h"

static const mjtNum UNDERSIDE_COSINE = 0.7;  // of the angle between a surface's normal and a link's z axis
static const mjtNum MIN_AXIS = 0.1;          // length of the mean of two directions; below it the body is folded
enum { X_AXIS = 0, Z_AXIS = 2 };             // columns of a rotation

int has_directions(const mjModel* m) { return m->nuser_geom >= USER_NUMBERS; }

const mjtNum* find_directions(const mjModel* m, int geom) { return m->geom_user + (size_t)geom * m->nuser_geom; }

int is_directional(const Coefficients* c) {
  return c->forward != 1.0 || c->backward != 1.0 || c->sideways != 1.0 || c->viscous_along > 0.0 ||
         c->viscous_across > 0.0;
}

static mjtNum maximum(mjtNum a, mjtNum b) { return b > a ? b : a; }

Coefficients combine_coefficients(mjtNum forward, mjtNum backward, mjtNum sideways, mjtNum viscous_along,
                                  mjtNum viscous_across, mjtNum min_friction, mjtNum separate_limits) {
  forward = maximum(forward, min_friction);
  backward = maximum(backward, min_friction);
  sideways = maximum(sideways, min_friction);
  mjtNum largest = maximum(maximum(forward, backward), sideways);
  if (largest == 0.0) {
    return (Coefficients){0.0, 1.0, 1.0, 1.0, viscous_along, viscous_across, separate_limits};
  }
  return (Coefficients){largest,       forward / largest, backward / largest, sideways / largest,
                        viscous_along, viscous_across,    separate_limits};
}

// Return the length of a link, whose first geom is its capsule.
static mjtNum find_length(const mjModel* m, int body) { return 2.0 * m->geom_size[3 * m->body_geomadr[body] + 1]; }

Neighbor find_neighbor(const mjModel* m, const Chain* chain, int body, mjtNum along) {
  mjtNum from_middle = along / find_length(m, body) - 0.5;
  int neighbor = from_middle > 0.0 ? body + 1 : body - 1;
  if (!is_link(chain, neighbor)) {
    return (Neighbor){body, 0.0};
  }
  mjtNum weight = fabs(from_middle);
  return (Neighbor){neighbor, weight > 0.5 ? 0.5 : weight};
}

// Write the weighted mean of one axis of two links.
static void mix(const mjData* d, int body, Neighbor neighbor, int column, mjtNum mean[3]) {
  const mjtNum* rotation = d->xmat + 9 * body;  // world_from_body, row by row
  const mjtNum* other = d->xmat + 9 * neighbor.body;
  mjtNum own = 1.0 - neighbor.weight;
  for (int i = 0; i < 3; i++) {
    mean[i] = own * rotation[3 * i + column] + neighbor.weight * other[3 * i + column];
  }
}

int faces_underside(const mjData* d, int body, Neighbor neighbor, const mjtNum n[3]) {
  mjtNum up[3];
  mix(d, body, neighbor, Z_AXIS, up);
  return up[0] * n[0] + up[1] * n[1] + up[2] * n[2] > UNDERSIDE_COSINE;
}

void find_axis(const mjData* d, int body, Neighbor neighbor, const mjtNum n[3], mjtNum axis[3]) {
  mix(d, body, neighbor, X_AXIS, axis);
  mjtNum along = axis[0] * n[0] + axis[1] * n[1] + axis[2] * n[2];
  for (int i = 0; i < 3; i++) {
    axis[i] = axis[i] - along * n[i];
  }
  mjtNum length = sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]);
  for (int i = 0; i < 3; i++) {
    axis[i] = length < MIN_AXIS ? 0.0 : axis[i] / length;
  }
}

//   F = -N_c ds - D u        on a link, with u pointing along the slip
void direct_force(mjtNum force[3], const mjtNum slip[3], const mjtNum axis[3], const Coefficients* c,
                  mjtNum damping_per_viscous) {
  mjtNum along = force[0] * axis[0] + force[1] * axis[1] + force[2] * axis[2];
  mjtNum slip_along = slip[0] * axis[0] + slip[1] * axis[1] + slip[2] * axis[2];
  // A force that points backward brakes a link that slides forward.
  mjtNum ratio = along < 0.0 ? c->forward : c->backward;
  mjtNum damping_along = damping_per_viscous * c->viscous_along;
  mjtNum damping_across = damping_per_viscous * c->viscous_across;
  mjtNum result_along = ratio * along - damping_along * slip_along;
  for (int i = 0; i < 3; i++) {
    mjtNum across = c->sideways * (force[i] - along * axis[i]);
    force[i] = result_along * axis[i] + across - damping_across * (slip[i] - slip_along * axis[i]);
  }
}

static mjtNum compute_length(const mjtNum v[3]) { return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// Return the factor that brings a number of this size down to the limit; 1 if it is within.
static mjtNum limit_scale(mjtNum limit, mjtNum size) { return size > limit ? limit / size : 1.0; }

//   s_i = s_i min(1, L_i / (k |s_i|))         along the link and across it, with the limit L_i = mu_i N
//   F_i = -(k s_i + d ds_i), limited to |F_i| <= L_i, and viscous friction
void limit_separately(mjtNum stretch[3], const mjtNum slip[3], const mjtNum axis[3], const Coefficients* c,
                      mjtNum max_friction, mjtNum k, mjtNum damping, mjtNum damping_per_viscous, mjtNum force[3]) {
  mjtNum stretch_along = stretch[0] * axis[0] + stretch[1] * axis[1] + stretch[2] * axis[2];
  mjtNum slip_along = slip[0] * axis[0] + slip[1] * axis[1] + slip[2] * axis[2];

  // Along the link. A stretch or a force forward belongs to a link that slides forward.
  mjtNum ratio = stretch_along > 0.0 ? c->forward : c->backward;
  mjtNum stretch_across[3];
  for (int i = 0; i < 3; i++) {
    stretch_across[i] = stretch[i] - stretch_along * axis[i];
  }
  stretch_along = limit_scale(ratio * max_friction, k * fabs(stretch_along)) * stretch_along;
  mjtNum force_along = k * stretch_along + damping * slip_along;
  ratio = force_along > 0.0 ? c->forward : c->backward;
  force_along = -limit_scale(ratio * max_friction, fabs(force_along)) * force_along;
  force_along = force_along - damping_per_viscous * c->viscous_along * slip_along;

  // Across it.
  mjtNum limit = c->sideways * max_friction;
  mjtNum scale = limit_scale(limit, k * compute_length(stretch_across));
  mjtNum slip_across[3];
  for (int i = 0; i < 3; i++) {
    stretch_across[i] = scale * stretch_across[i];
    slip_across[i] = slip[i] - slip_along * axis[i];
    force[i] = k * stretch_across[i] + damping * slip_across[i];
  }
  scale = -limit_scale(limit, compute_length(force));
  mjtNum damping_across = damping_per_viscous * c->viscous_across;
  for (int i = 0; i < 3; i++) {
    force[i] = force_along * axis[i] + (scale * force[i] - damping_across * slip_across[i]);
    stretch[i] = stretch_along * axis[i] + stretch_across[i];
  }
}
