// Contacts and propulsion margin of a body: see `body_contacts.py` and `margin.py`.

#include "search.h"

#include <math.h>

static double max_of(double a, double b) { return a > b ? a : b; }

static double min_of(double a, double b) { return a < b ? a : b; }

static double dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void cross(const double a[3], const double b[3], double result[3])
{
    result[0] = a[1] * b[2] - a[2] * b[1];
    result[1] = a[2] * b[0] - a[0] * b[2];
    result[2] = a[0] * b[1] - a[1] * b[0];
}

// Return the largest of the forces of three contacts that push the body with 1 N; HUGE_VAL if they cannot.
//
// Cramer's rule gives the forces of three contacts a, b, c under the drag d, with V = a . (b x c):
//
//     lambda_a = d . (b x c) / V,   lambda_b = -c . (d x a) / V,   lambda_c = b . (d x a) / V
static double find_largest_force(const Parameters* parameters, const double a[3], const double b[3], const double c[3],
                                 const double b_cross_c[3], const double d[3], const double d_cross_a[3])
{
    double volume = dot(a, b_cross_c);
    if (fabs(volume) <= parameters->min_determinant)
        return HUGE_VAL;
    double inverse = 1.0 / volume;
    double force_a = dot(d, b_cross_c) * inverse;
    double force_b = -dot(c, d_cross_a) * inverse;
    double force_c = dot(b, d_cross_a) * inverse;
    if (force_a < 0.0 || force_b < 0.0 || force_c < 0.0)
        return HUGE_VAL;
    return max_of(max_of(max_of(force_a, force_b), force_c), parameters->min_force_per_n);
}

// Return the margin of a body: the best of all sets of three contacts.
//
// wrenches: of unit pushes at the contacts. count: of the contacts. drag: for F = 1 N. All moments are scaled.
static double find_best_margin_n(const Parameters* parameters, double wrenches[MAX_CONTACTS][3], int64_t count,
                                 const double drag[3])
{
    double drag_cross[MAX_CONTACTS][3];
    for (int64_t a = 0; a < count; a++)
        cross(drag, wrenches[a], drag_cross[a]);
    double smallest_force = HUGE_VAL;
    for (int64_t b = 1; b < count; b++) {
        for (int64_t c = b + 1; c < count; c++) {
            double b_cross_c[3];
            cross(wrenches[b], wrenches[c], b_cross_c);
            for (int64_t a = 0; a < b; a++) {
                double force = find_largest_force(parameters, wrenches[a], wrenches[b], wrenches[c], b_cross_c, drag,
                                                  drag_cross[a]);
                smallest_force = min_of(smallest_force, force);
            }
        }
    }
    return parameters->max_contact_force_n / smallest_force;
}

static bool is_zero(const double vector[3]) { return vector[0] == 0.0 && vector[1] == 0.0 && vector[2] == 0.0; }

// Return what the newest contact of a body becomes when the body touches an obstacle.
static Contact merge_contacts(const Contact* newest, const Contact* touched)
{
    if (newest->obstacle != touched->obstacle || touched->gap_m < newest->gap_m)
        return *touched;
    Contact merged = *newest;
    merged.s_m = touched->s_m;
    return merged;
}

double planner_find_contact(const Search* search, double s_m, const Node* parent, const Arc* arc,
                            const double tangent[2], Candidate* candidate)
{
    const Parameters* parameters = &search->parameters;
    const Task* task = &search->task;
    const Contact* newest = &parent->contacts[MAX_CONTACTS - 1];
    candidate->has_new_slot = 0;
    candidate->newest = *newest;
    double reach_m = parameters->radius_m + parameters->contact_distance_m;
    Nearest nearest = planner_find_nearest(&search->grid, arc->middle_x_m, arc->middle_y_m, reach_m);
    if (nearest.obstacle == NO_OBSTACLE)
        return 0.0;
    double gap_m = nearest.distance_m - parameters->radius_m;
    double frontal = fabs(nearest.normal_x * tangent[0] + nearest.normal_y * tangent[1]);
    if (gap_m >= parameters->contact_distance_m || frontal >= parameters->max_frontal)
        return 0.0;
    double push = nearest.normal_x * task->goal_x + nearest.normal_y * task->goal_y;
    if (push <= parameters->min_push)
        return push;

    double skin_x_m = arc->middle_x_m - nearest.normal_x * parameters->radius_m - task->origin_x_m;
    double skin_y_m = arc->middle_y_m - nearest.normal_y * parameters->radius_m - task->origin_y_m;
    double force_x = nearest.normal_x - parameters->obstacle_friction * tangent[0];
    double force_y = nearest.normal_y - parameters->obstacle_friction * tangent[1];
    Contact touched;
    touched.obstacle = nearest.obstacle;
    touched.s_m = s_m - 0.5 * parameters->step_m;
    touched.gap_m = gap_m;
    touched.wrench[0] = force_x;
    touched.wrench[1] = force_y;
    touched.wrench[2] = skin_x_m * force_y - skin_y_m * force_x;
    candidate->has_new_slot = newest->obstacle != touched.obstacle;
    candidate->newest = merge_contacts(newest, &touched);
    return push;
}

const Contact* planner_find_older_contacts(const Node* parent, const Candidate* candidate)
{
    return candidate->has_new_slot ? parent->contacts + 1 : parent->contacts;
}

// Append the wrench of a contact, with its moment scaled, unless the contact is near an end of the body or its slot is
// empty. Return the new number of wrenches.
static int64_t append_wrench(const Search* search, const LayerLimits* limits, const Contact* contact,
                             double wrenches[MAX_CONTACTS][3], int64_t count)
{
    bool is_used = contact->s_m >= limits->first_contact_m && contact->s_m <= limits->last_contact_m;
    if (!is_used || is_zero(contact->wrench))
        return count;
    wrenches[count][0] = contact->wrench[0];
    wrenches[count][1] = contact->wrench[1];
    wrenches[count][2] = contact->wrench[2] * search->parameters.moment_scale;
    return count + 1;
}

double planner_compute_margin_n(const Search* search, const LayerLimits* limits, const Node* parent,
                                const Candidate* candidate)
{
    const Parameters* parameters = &search->parameters;
    const Contact* older = planner_find_older_contacts(parent, candidate);
    double wrenches[MAX_CONTACTS][3];
    int64_t count = 0;
    for (int64_t k = 0; k < MAX_CONTACTS - 1; k++)
        count = append_wrench(search, limits, &older[k], wrenches, count);
    count = append_wrench(search, limits, &candidate->newest, wrenches, count);

    double drag[3];
    drag[0] = candidate->drag_m[0] / parameters->body_length_m;
    drag[1] = candidate->drag_m[1] / parameters->body_length_m;
    drag[2] = candidate->drag_m[2] / parameters->body_length_m * parameters->moment_scale;
    return find_best_margin_n(parameters, wrenches, count, drag);
}
