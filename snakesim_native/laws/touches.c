// The contacts between links and obstacles. The Python version is `snakesim_sim_backend/state/contacts.py`.

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

int find_obstacle_contact(const mjModel* m, const mjData* d, const RoughContact* contacts, int count, int number,
                          ObstacleContact* result) {
  const mjContact* contact = d->contact + number;
  int first_is_obstacle = m->geom_group[contact->geom[0]] == OBSTACLE_GROUP;
  int second_is_obstacle = m->geom_group[contact->geom[1]] == OBSTACLE_GROUP;
  if (first_is_obstacle == second_is_obstacle) {
    return 0;
  }
  mjtNum sign = first_is_obstacle ? 1.0 : -1.0;  // MuJoCo's normal is from the first geom to the second
  const RoughContact* rough = find_number(contacts, count, number);
  result->obstacle_geom = contact->geom[first_is_obstacle ? 0 : 1];
  result->link_geom = contact->geom[first_is_obstacle ? 1 : 0];
  result->normal_force = contact->efc_address >= 0 ? d->efc_force[contact->efc_address] : 0.0;
  for (int i = 0; i < 3; i++) {
    result->normal[i] = sign * contact->frame[i];
    result->friction_force[i] = rough && !rough->is_new ? rough->force[i] : 0.0;
  }
  return 1;
}

int find_touches(const mjModel* m, const mjData* d, const Chain* chain, const RoughContact* contacts, int count,
                 Touch* touches, int capacity) {
  int touch_count = 0;
  for (int number = 0; number < d->ncon && touch_count < capacity; number++) {
    ObstacleContact contact;
    if (find_obstacle_contact(m, d, contacts, count, number, &contact)) {
      Touch* touch = touches + touch_count;
      touch->link = m->geom_bodyid[contact.link_geom] - chain->first_body;
      for (int i = 0; i < 3; i++) {
        touch->force[i] = contact.friction_force[i] + contact.normal_force * contact.normal[i];
      }
      touch_count++;
    }
  }
  return touch_count;
}
