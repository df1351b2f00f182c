// Obstacles that yield. The Python version is `snakesim_sim_backend/laws/yielding.py`.

#include <math.h>

#include "laws.h"

static const mjtNum MIN_FORCE_N = 1e-12;  // keeps 0 / 0 out of the forces of an obstacle at rest

// The order of the numbers in the user data of an obstacle's body.
enum { STIFFNESS, DAMPING, MAX_FORCE, MEAN_RADIUS, PARAMETER_COUNT };

// An obstacle's spring in one step.
typedef struct {
  mjtNum anchor[YIELDING_DOFS];             // a after the step
  mjtNum generalized_force[YIELDING_DOFS];
} Spring;

static mjtNum maximum(mjtNum a, mjtNum b) { return a >= b || isnan(a) ? a : b; }

static mjtNum minimum(mjtNum a, mjtNum b) { return a <= b || isnan(a) ? a : b; }

static mjtNum compute_length(const mjtNum v[3]) { return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// Compute one obstacle, with its displacement q (x and y in m, rotation in rad) and L = (1, 1, mean radius of the foot):
//
//   s = L (q - a)                                     stretch, m
//   s is shortened so that k |s| <= F_max, and the anchor slips: a = q - s / L
//   F = k s + d L dq/dt, shortened to |F| <= F_max
//   generalized force = -L F
static Spring pull(const mjModel* m, const mjData* d, int body, const mjtNum anchor[YIELDING_DOFS]) {
  const mjtNum* parameters = m->body_user + body * m->nuser_body;
  mjtNum k = parameters[STIFFNESS];
  mjtNum damping = parameters[DAMPING];
  mjtNum max_force = parameters[MAX_FORCE];
  mjtNum L[YIELDING_DOFS] = {1.0, 1.0, parameters[MEAN_RADIUS]};
  const mjtNum* q = d->qpos + m->jnt_qposadr[m->body_jntadr[body]];
  const mjtNum* velocity = d->qvel + m->body_dofadr[body];
  mjtNum stretch[YIELDING_DOFS];
  mjtNum force[YIELDING_DOFS];
  Spring spring;

  for (int i = 0; i < YIELDING_DOFS; i++) {
    stretch[i] = L[i] * (q[i] - anchor[i]);
  }
  mjtNum scale = minimum(1.0, max_force / maximum(k * compute_length(stretch), MIN_FORCE_N));
  for (int i = 0; i < YIELDING_DOFS; i++) {
    stretch[i] *= scale;
    spring.anchor[i] = q[i] - stretch[i] / L[i];
    force[i] = k * stretch[i] + damping * L[i] * velocity[i];
  }
  scale = minimum(1.0, max_force / maximum(compute_length(force), MIN_FORCE_N));
  for (int i = 0; i < YIELDING_DOFS; i++) {
    spring.generalized_force[i] = -(L[i] * force[i] * scale);
  }
  return spring;
}

static int is_yielding(const mjModel* m, int instance, int body) {
  return m->body_plugin[body] == instance && m->body_dofnum[body] == YIELDING_DOFS &&
         m->nuser_body >= PARAMETER_COUNT;
}

int count_yielding(const mjModel* m, int instance) {
  int count = 0;
  for (int body = 1; body < m->nbody; body++) {
    count += is_yielding(m, instance, body);
  }
  return count;
}

void pull_obstacles(const mjModel* m, mjData* d, int instance, Anchor* anchors) {
  int count = 0;
  for (int body = 1; body < m->nbody; body++) {
    if (is_yielding(m, instance, body)) {
      Spring spring = pull(m, d, body, anchors[count].anchor);
      mju_addTo3(d->qfrc_passive + m->body_dofadr[body], spring.generalized_force);
      mju_copy3(anchors[count].next_anchor, spring.anchor);
      count++;
    }
  }
}

void update_anchors(Anchor* anchors, int count) {
  for (int i = 0; i < count; i++) {
    mju_copy3(anchors[i].anchor, anchors[i].next_anchor);
  }
}
