// The force that a contact sensor measures: the mean over 50 ms, of the link and the obstacle that push each other hardest.
// The Python version is `MeasuredForce` in `snakesim_hal/model/measured_force.py`, which gets the sums of
// `snakesim_sim_backend/state/contacts.py` in every step.

#include <math.h>

#include "laws.h"

static const mjtNum WINDOW_S = 0.05;
enum { PAIR_NUMBERS = sizeof(MeasuredPair) / sizeof(mjtNum), MEMORY_NUMBERS = sizeof(MeasuredForce) / sizeof(mjtNum) };

int count_window_steps(const mjModel* m) {
  int steps = (int)rint(WINDOW_S / m->opt.timestep);
  return steps > 1 ? steps : 1;
}

int count_measured_numbers(const mjModel* m, int pair_capacity) {
  return MEMORY_NUMBERS + (PAIR_NUMBERS + count_window_steps(m)) * pair_capacity;
}

static MeasuredPair* find_pair(MeasuredForce* memory, int window, int index) {
  return (MeasuredPair*)((mjtNum*)(memory + 1) + (PAIR_NUMBERS + window) * index);
}

static mjtNum* find_samples(MeasuredPair* pair) { return (mjtNum*)(pair + 1); }

// Begin a sample of 0 N for every pair, and forget the pairs that have no other samples any more.
static void begin_samples(MeasuredForce* memory, int window) {
  int newest = ((int)memory->newest + 1) % window;
  memory->newest = newest;
  int kept = 0;
  for (int i = 0; i < (int)memory->pair_count; i++) {
    MeasuredPair* pair = find_pair(memory, window, i);
    pair->idle_steps += 1.0;
    find_samples(pair)[newest] = 0.0;
    if (pair->idle_steps < window) {
      if (kept < i) {
        mju_copy((mjtNum*)find_pair(memory, window, kept), (mjtNum*)pair, PAIR_NUMBERS + window);
      }
      kept++;
    }
  }
  memory->pair_count = kept;
}

// Return the pair of a contact, new if it has not touched lately; NULL if there is no memory for it.
static MeasuredPair* find_or_add_pair(MeasuredForce* memory, int window, int capacity, const ObstacleContact* contact) {
  int count = (int)memory->pair_count;
  for (int i = 0; i < count; i++) {
    MeasuredPair* pair = find_pair(memory, window, i);
    if ((int)pair->link_geom == contact->link_geom && (int)pair->obstacle_geom == contact->obstacle_geom) {
      return pair;
    }
  }
  if (count == capacity) {
    return NULL;
  }
  memory->pair_count += 1.0;
  MeasuredPair* pair = find_pair(memory, window, count);
  pair->link_geom = contact->link_geom;
  pair->obstacle_geom = contact->obstacle_geom;
  mju_zero(find_samples(pair), window);
  return pair;
}

static mjtNum compute_force(const ObstacleContact* contact) {
  mjtNum n = contact->normal_force;
  const mjtNum* f = contact->friction_force;
  return sqrt(n * n + f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
}

// Return the largest sum of a pair's samples. They are added in the order of time.
static mjtNum find_max_sum(MeasuredForce* memory, int window) {
  mjtNum max_sum = 0.0;
  for (int i = 0; i < (int)memory->pair_count; i++) {
    const mjtNum* samples = find_samples(find_pair(memory, window, i));
    mjtNum sum = 0.0;
    for (int age = window - 1; age >= 0; age--) {
      sum += samples[((int)memory->newest + window - age) % window];
    }
    max_sum = sum > max_sum ? sum : max_sum;
  }
  return max_sum;
}

void measure_forces(const mjModel* m, const mjData* d, const RoughContact* contacts, int count, MeasuredForce* memory,
                    int pair_capacity) {
  int window = count_window_steps(m);
  begin_samples(memory, window);
  for (int number = 0; number < d->ncon; number++) {
    ObstacleContact contact;
    if (find_obstacle_contact(m, d, contacts, count, number, &contact) && contact.normal_force > 0.0) {
      MeasuredPair* pair = find_or_add_pair(memory, window, pair_capacity, &contact);
      if (pair) {
        pair->idle_steps = 0.0;
        find_samples(pair)[(int)memory->newest] += compute_force(&contact);
      }
    }
  }
  memory->max_mean_force = find_max_sum(memory, window) / window;
}
