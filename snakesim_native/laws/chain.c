// Forces on the links of a snake, and what they do to its joints.

#include "laws.h"

Chain find_chain(const mjModel* m, int instance) {
  Chain chain = {0, 0};
  int body = 1;
  while (body < m->nbody && m->body_plugin[body] != instance) {
    body++;
  }
  if (body == m->nbody) {
    return chain;
  }
  chain.first_body = body;
  chain.link_count = 1;
  while (body + 1 < m->nbody && m->body_parentid[body + 1] == body) {
    body++;
    chain.link_count++;
  }
  return chain;
}

int is_link(const Chain* chain, int body) {
  return body >= chain->first_body && body < chain->first_body + chain->link_count;
}

void add_force(const mjData* d, const Chain* chain, const mjtNum force[3], const mjtNum point[3],
               mjtNum wrench[WRENCH_SIZE]) {
  const mjtNum* center = d->subtree_com + 3 * chain->first_body;  // about which MuJoCo takes moments
  mjtNum x = point[0] - center[0];
  mjtNum y = point[1] - center[1];
  mjtNum z = point[2] - center[2];
  wrench[0] += y * force[2] - z * force[1];
  wrench[1] += z * force[0] - x * force[2];
  wrench[2] += x * force[1] - y * force[0];
  wrench[3] += force[0];
  wrench[4] += force[1];
  wrench[5] += force[2];
}

// Return the work of a wrench along a degree of freedom.
static mjtNum dot_axis(const mjtNum axis[WRENCH_SIZE], const mjtNum wrench[WRENCH_SIZE]) {
  mjtNum sum = 0.0;
  for (int i = 0; i < WRENCH_SIZE; i++) {
    sum += axis[i] * wrench[i];
  }
  return sum;
}

// generalized force of a degree of freedom = its axis of motion . sum of the wrenches from there to the head
void apply_wrenches(const mjModel* m, mjData* d, const Chain* chain, const mjtNum* wrenches) {
  mjtNum sum[WRENCH_SIZE] = {0};  // of the links from this one to the head
  for (int link = chain->link_count - 1; link >= 0; link--) {
    for (int i = 0; i < WRENCH_SIZE; i++) {
      sum[i] += wrenches[WRENCH_SIZE * link + i];
    }
    int body = chain->first_body + link;
    int first_dof = m->body_dofadr[body];
    for (int dof = first_dof; dof < first_dof + m->body_dofnum[body]; dof++) {
      d->qfrc_passive[dof] += dot_axis(d->cdof + WRENCH_SIZE * dof, sum);
    }
  }
}
