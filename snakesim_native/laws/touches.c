// The forces between links and obstacles, for programs that see only a simulation's state, such as MuJoCo's batches.
// The Python version is `snakesim_sim_backend/state/contacts.py`.

#include "laws.h"

// Return the contact with friction that has this number in MuJoCo's contacts of the last step, or NULL.
static const RoughContact* find_number(const RoughContact* contacts, int count, int number) {
  for (int i = 0; i < count; i++) {
    if ((int)contacts[i].number == number) {
      return contacts + i;
    }
  }
  return NULL;
}

int find_touches(const mjModel* m, const mjData* d, const Chain* chain, const RoughContact* contacts, int count,
                 Touch* touches, int capacity) {
  int touch_count = 0;
  for (int number = 0; number < d->ncon && touch_count < capacity; number++) {
    const mjContact* contact = d->contact + number;
    int first_is_obstacle = m->geom_group[contact->geom[0]] == OBSTACLE_GROUP;
    int second_is_obstacle = m->geom_group[contact->geom[1]] == OBSTACLE_GROUP;
    if (first_is_obstacle == second_is_obstacle) {
      continue;
    }
    mjtNum sign = first_is_obstacle ? 1.0 : -1.0;  // MuJoCo's normal is from the first geom to the second
    mjtNum normal_force = contact->efc_address >= 0 ? d->efc_force[contact->efc_address] : 0.0;
    const RoughContact* rough = find_number(contacts, count, number);
    Touch* touch = touches + touch_count;
    touch->link = m->geom_bodyid[contact->geom[first_is_obstacle ? 1 : 0]] - chain->first_body;
    for (int i = 0; i < 3; i++) {
      mjtNum friction_force = rough && !rough->is_new ? rough->force[i] : 0.0;
      touch->force[i] = friction_force + normal_force * (sign * contact->frame[i]);
    }
    touch_count++;
  }
  return touch_count;
}
