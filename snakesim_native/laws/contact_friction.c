// Dry friction of the contacts that MuJoCo finds. The Python version is
// `snakesim_sim_backend/laws/contact_friction.py`.

#include <math.h>

#include "laws.h"

static const mjtNum END_MOBILITY = 4.0;   // how many times as easily a rod moves at its end as in its middle
static const mjtNum PHASE_RAD = 0.5;      // by which the springs vibrate in one physics step
static const mjtNum DAMPING_RATIO = 0.5;  // of critical damping
static const mjtNum NO_TORQUE[3] = {0.0, 0.0, 0.0};
enum { CONTACTS_PER_PAIR = 64 };  // of two geoms: more than MuJoCo makes, so that keys are unique

// A contact of a link that presses and has friction.
typedef struct {
  int number;      // in MuJoCo's contacts
  int link_geom;
  int other_geom;
  mjtNum sign;     // makes MuJoCo's normal point from the other body into the link
  mjtNum normal_force;
} Pressing;

// What a spring does in one step.
typedef struct {
  mjtNum stretch[3];  // s after the step
  mjtNum force[3];    // F, on the link
  mjtNum point[3];    // of the link, where the force acts
} Rubbing;

//---------------------------------- Vectors and frames ----------------------------------------------------------------

// Return the world coordinates of a point that is given in a body's frame.
static void to_world(const mjData* d, int body, const mjtNum point[3], mjtNum point_w[3]) {
  const mjtNum* position = d->xpos + 3 * body;
  const mjtNum* rotation = d->xmat + 9 * body;  // world_from_body, row by row
  for (int i = 0; i < 3; i++) {
    const mjtNum* row = rotation + 3 * i;
    point_w[i] = body == WORLD_BODY ? point[i] : position[i] + row[0] * point[0] + row[1] * point[1] + row[2] * point[2];
  }
}

// Return the coordinates in a body's frame of a point that is given in the world frame.
static void to_body(const mjData* d, int body, const mjtNum point_w[3], mjtNum point[3]) {
  const mjtNum* position = d->xpos + 3 * body;
  const mjtNum* rotation = d->xmat + 9 * body;
  mjtNum x = point_w[0] - position[0];
  mjtNum y = point_w[1] - position[1];
  mjtNum z = point_w[2] - position[2];
  for (int i = 0; i < 3; i++) {
    point[i] = body == WORLD_BODY ? point_w[i] : rotation[i] * x + rotation[3 + i] * y + rotation[6 + i] * z;
  }
}

// Remove the part of a vector along the unit normal n.
static void project_to_tangent(mjtNum vector[3], const mjtNum n[3]) {
  mjtNum along = vector[0] * n[0] + vector[1] * n[1] + vector[2] * n[2];
  for (int i = 0; i < 3; i++) {
    vector[i] = vector[i] - along * n[i];
  }
}

static mjtNum compute_length(const mjtNum v[3]) { return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// Return the factor that brings a vector of this size down to the limit; 1 if it is within.
static mjtNum limit_scale(mjtNum limit, mjtNum size) { return size > limit ? limit / size : 1.0; }

//---------------------------------- Forces ----------------------------------------------------------------------------

// Compute one contact in one step:
//
//   k = m (PHASE / dt)^2                         stiffness
//   d = 2 DAMPING_RATIO m PHASE / dt^2           damping, N per m of slip in one step
//   ds = motion of the link's point relative to the other body's point, without its part along the normal n
//   s  = (s + ds) min(1, mu N / (k |s + ds|))    stretch of the spring
//   F  = -(k s + d ds), limited to |F| <= mu N   friction force on the link
//
// On surfaces on which links slide more easily in one direction, directional.c changes F.
static Rubbing rub(const mjModel* m, const mjData* d, const Chain* chain, const RoughContact* contact) {
  mjtNum step = m->opt.timestep;
  mjtNum k = (PHASE_RAD / step) * (PHASE_RAD / step) * contact->mass;
  mjtNum damping = 2.0 * DAMPING_RATIO * PHASE_RAD / (step * step) * contact->mass;
  mjtNum other_point[3];
  mjtNum slip[3];
  Rubbing rubbing;

  // ds, and s + ds
  to_world(d, (int)contact->link_body, contact->link_point, rubbing.point);
  to_world(d, (int)contact->other_body, contact->other_point, other_point);
  for (int i = 0; i < 3; i++) {
    slip[i] = rubbing.point[i] - other_point[i];
  }
  project_to_tangent(slip, contact->normal);
  for (int i = 0; i < 3; i++) {
    rubbing.stretch[i] = contact->stretch[i] + slip[i];
  }
  project_to_tangent(rubbing.stretch, contact->normal);
  mjtNum stretch[3];
  mju_copy3(stretch, rubbing.stretch);

  // s, and k s + d ds
  mjtNum scale = limit_scale(contact->max_friction, k * compute_length(rubbing.stretch));
  for (int i = 0; i < 3; i++) {
    rubbing.stretch[i] = scale * rubbing.stretch[i];
    rubbing.force[i] = k * rubbing.stretch[i] + damping * slip[i];
  }

  // F
  scale = -limit_scale(contact->max_friction, compute_length(rubbing.force));
  for (int i = 0; i < 3; i++) {
    rubbing.force[i] = scale * rubbing.force[i];
  }
  Coefficients coefficients = {contact->max_friction, contact->forward,       contact->backward,
                               contact->sideways,     contact->viscous_along, contact->viscous_across,
                               contact->separate_limits};
  if (is_directional(&coefficients)) {
    int body = (int)contact->link_body;
    mjtNum axis[3];
    find_axis(d, body, find_neighbor(m, chain, body, contact->link_point[0]), contact->normal, axis);
    if (coefficients.separate_limits != 0.0) {
      limit_separately(stretch, slip, axis, &coefficients, contact->max_friction, k, damping, 1.0 / step,
                       rubbing.force);
      mju_copy3(rubbing.stretch, stretch);
    } else {
      direct_force(rubbing.force, slip, axis, &coefficients, 1.0 / step);
    }
  }
  return rubbing;
}

void rub_links(const mjModel* m, mjData* d, const Chain* chain, const RoughContact* contacts, int count,
               mjtNum* wrenches) {
  for (int i = 0; i < count; i++) {
    int link_body = (int)contacts[i].link_body;
    int other_body = (int)contacts[i].other_body;
    Rubbing rubbing = rub(m, d, chain, contacts + i);
    add_force(d, chain, rubbing.force, rubbing.point, wrenches + WRENCH_SIZE * (link_body - chain->first_body));
    if (other_body != WORLD_BODY) {
      mjtNum opposite[3] = {-rubbing.force[0], -rubbing.force[1], -rubbing.force[2]};
      mj_applyFT(m, d, opposite, NO_TORQUE, rubbing.point, other_body, d->qfrc_passive);
    }
  }
}

//---------------------------------- Memory ----------------------------------------------------------------------------

// Return by how much a force of 1 N accelerates the end of a rod of this mass; 0 for the world.
static mjtNum find_mobility(const mjModel* m, int body) {
  return m->body_mass[body] > 0.0 ? END_MOBILITY / m->body_mass[body] : 0.0;
}

// Return whether a geom has friction of any kind.
static int has_friction(const mjModel* m, int geom) {
  int found = m->geom_friction[3 * geom] > 0.0;
  for (int i = FORWARD; i < USER_NUMBERS && has_directions(m); i++) {
    found = found || find_directions(m, geom)[i] > 0.0;
  }
  return found;
}

// Return whether one of MuJoCo's contacts presses on a link and has friction, and describe it.
static int find_pressing(const mjModel* m, const mjData* d, const Chain* chain, int number, mjtNum min_friction,
                         Pressing* pressing) {
  const mjContact* contact = d->contact + number;
  int first_is_link = is_link(chain, m->geom_bodyid[contact->geom[0]]);
  pressing->number = number;
  pressing->link_geom = contact->geom[first_is_link ? 0 : 1];
  pressing->other_geom = contact->geom[first_is_link ? 1 : 0];
  pressing->sign = first_is_link ? -1.0 : 1.0;  // MuJoCo's normal is from the first geom to the second
  // A contact without a row in the solver has no force.
  pressing->normal_force = contact->efc_address >= 0 ? d->efc_force[contact->efc_address] : 0.0;
  return pressing->normal_force > 0.0 && is_link(chain, m->geom_bodyid[pressing->link_geom]) &&
         (min_friction > 0.0 || has_friction(m, pressing->other_geom));
}

// Return the contact with this key in the last step, or NULL.
static const RoughContact* find_key(const RoughContact* contacts, int count, mjtNum key) {
  for (int i = 0; i < count; i++) {
    if (contacts[i].key == key) {
      return contacts + i;
    }
  }
  return NULL;
}

// Return the coefficients of a contact.
//   along    distance of the contact from the link's rear joint
//   normal   of the surface, which points into the link
static Coefficients find_coefficients(const mjModel* m, const mjData* d, const Chain* chain, const Pressing* pressing,
                                      mjtNum along, const mjtNum normal[3], mjtNum min_friction) {
  mjtNum mu = m->geom_friction[3 * pressing->other_geom];
  if (is_link(chain, m->geom_bodyid[pressing->other_geom]) || !has_directions(m)) {
    return combine_coefficients(mu, mu, mu, 0.0, 0.0, min_friction, 0.0);
  }
  const mjtNum* surface = find_directions(m, pressing->other_geom);
  const mjtNum* factors = find_directions(m, pressing->link_geom);
  int body = m->geom_bodyid[pressing->link_geom];
  if (!faces_underside(d, body, find_neighbor(m, chain, body, along), normal)) {
    return combine_coefficients(mu, mu, mu, surface[VISCOUS_ACROSS], surface[VISCOUS_ACROSS], min_friction, 0.0);
  }
  return combine_coefficients(surface[FORWARD] * factors[FORWARD], surface[BACKWARD] * factors[BACKWARD],
                              surface[SIDEWAYS] * factors[SIDEWAYS], surface[VISCOUS_ALONG], surface[VISCOUS_ACROSS],
                              min_friction, factors[SEPARATE_LIMITS]);
}

// Write what is remembered of a contact.
//   nth      how many contacts of the same two geoms come before it
//   before   the contacts of the last step, with the stretch and the force that they have now
static RoughContact describe_contact(const mjModel* m, const mjData* d, const Chain* chain, const Pressing* pressing,
                                     int nth, const RoughContact* before, int before_count, mjtNum min_friction) {
  const mjContact* contact = d->contact + pressing->number;
  RoughContact result;
  int link_body = m->geom_bodyid[pressing->link_geom];
  int other_body = m->geom_bodyid[pressing->other_geom];
  mjtNum pair = (mjtNum)pressing->link_geom * (mjtNum)m->ngeom + pressing->other_geom;
  result.key = CONTACTS_PER_PAIR * pair + nth;
  result.number = pressing->number;
  result.link_body = link_body;
  result.other_body = other_body;
  result.mass = 0.0;  // is known when all contacts of the link are

  const RoughContact* same = find_key(before, before_count, result.key);
  result.is_new = same == NULL;
  for (int i = 0; i < 3; i++) {
    result.normal[i] = pressing->sign * contact->frame[i];
    result.stretch[i] = same ? same->stretch[i] : 0.0;
    result.force[i] = same ? same->force[i] : 0.0;
  }
  to_body(d, link_body, contact->pos, result.link_point);
  to_body(d, other_body, contact->pos, result.other_point);

  Coefficients coefficients =
      find_coefficients(m, d, chain, pressing, result.link_point[0], result.normal, min_friction);
  result.max_friction = coefficients.largest * pressing->normal_force;
  result.forward = coefficients.forward;
  result.backward = coefficients.backward;
  result.sideways = coefficients.sideways;
  result.viscous_along = coefficients.viscous_along * pressing->normal_force;
  result.viscous_across = coefficients.viscous_across * pressing->normal_force;
  result.separate_limits = coefficients.separate_limits;
  return result;
}

// Divide the mass of each link among its contacts.
static void divide_masses(const mjModel* m, RoughContact* contacts, int count) {
  for (int i = 0; i < count; i++) {
    int of_link = 0;
    for (int j = 0; j < count; j++) {
      of_link += contacts[j].link_body == contacts[i].link_body;
    }
    mjtNum mobility = find_mobility(m, (int)contacts[i].link_body) + find_mobility(m, (int)contacts[i].other_body);
    contacts[i].mass = 1.0 / (of_link * mobility);
  }
}

int update_contacts(const mjModel* m, mjData* d, const Chain* chain, RoughContact* contacts, int count,
                    mjtNum min_friction) {
  int capacity = CONTACTS_PER_LINK * chain->link_count;
  mj_markStack(d);

  // The contacts of the last step, with the stretch and the force that they have now.
  int numbers = sizeof(RoughContact) / sizeof(mjtNum);
  RoughContact* before = (RoughContact*)mj_stackAllocNum(d, (size_t)count * numbers + 1);
  for (int i = 0; i < count; i++) {
    Rubbing rubbing = rub(m, d, chain, contacts + i);
    before[i] = contacts[i];
    mju_copy3(before[i].stretch, rubbing.stretch);
    mju_copy3(before[i].force, rubbing.force);
  }

  // Contacts of one pair of geoms are distinguished by their order.
  int new_count = 0;
  for (int number = 0; number < d->ncon && new_count < capacity; number++) {
    Pressing pressing;
    if (find_pressing(m, d, chain, number, min_friction, &pressing)) {
      mjtNum first_key = CONTACTS_PER_PAIR * ((mjtNum)pressing.link_geom * m->ngeom + pressing.other_geom);
      int nth = 0;
      for (int i = 0; i < new_count; i++) {
        nth += contacts[i].key >= first_key && contacts[i].key < first_key + CONTACTS_PER_PAIR;
      }
      contacts[new_count] = describe_contact(m, d, chain, &pressing, nth, before, count, min_friction);
      new_count++;
    }
  }
  divide_masses(m, contacts, new_count);
  mj_freeStack(d);
  return new_count;
}
