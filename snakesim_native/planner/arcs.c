// All arcs that leave a layer: which are allowed, and the cost of their paths without the terms of contacts.

#include "search.h"

#include <math.h>

static const double PI = 3.14159265358979323846;
static const double FULL_TURN_RAD = 2.0 * 3.14159265358979323846;

// Return |a - b| for angles, at most pi.
static double angle_between_rad(double a_rad, double b_rad)
{
    double shifted_rad = a_rad - b_rad + PI;
    if (shifted_rad < 0.0 || shifted_rad >= FULL_TURN_RAD) {
        shifted_rad = fmod(shifted_rad, FULL_TURN_RAD);
        if (shifted_rad < 0.0)
            shifted_rad += FULL_TURN_RAD;
    }
    return fabs(shifted_rad - PI);
}

// Copy the points of failed paths that can be near the ends of a layer's arcs, and return how many.
//
// Allowed ends are within max_sideways_m of the lying body, and points farther than failed_path_m from an end cost
// nothing.
static int64_t copy_near_failed(Search* search, const LayerLimits* limits)
{
    const Task* task = &search->task;
    double* near_failed_m = search->scratch.near_failed_m;
    double reach_m = WIDER * (task->max_sideways_m + search->parameters.failed_path_m);
    int64_t count = 0;
    for (int64_t k = 0; k < task->failed_count; k++) {
        double dx = task->failed_m[2 * k] - limits->lying_x_m;
        double dy = task->failed_m[2 * k + 1] - limits->lying_y_m;
        if (dx * dx + dy * dy > reach_m * reach_m)
            continue;
        near_failed_m[2 * count] = task->failed_m[2 * k];
        near_failed_m[2 * count + 1] = task->failed_m[2 * k + 1];
        count += 1;
    }
    return count;
}

// Return how close a point is to a failed path: 1 on it, 0 from failed_path_m on.
static double find_closeness(const Search* search, const LayerLimits* limits, double x_m, double y_m)
{
    double failed_path_m = search->parameters.failed_path_m;
    double reach_m = WIDER * failed_path_m; // points farther away are not close
    const double* points_m = search->scratch.near_failed_m;
    double nearest_m = HUGE_VAL;
    for (int64_t k = 0; k < limits->near_failed_count; k++) {
        double dx = x_m - points_m[2 * k];
        double dy = y_m - points_m[2 * k + 1];
        if (dx * dx + dy * dy > reach_m * reach_m)
            continue;
        double distance_m = hypot(dx, dy);
        nearest_m = distance_m < nearest_m ? distance_m : nearest_m;
    }
    double closeness = 1.0 - nearest_m / failed_path_m;
    return closeness > 0.0 ? closeness : 0.0;
}

// Return the cost of the path to the end of an arc, without the terms of its contacts.
static double compute_path_cost_m(const Search* search, const LayerLimits* limits, const Node* parent, const Arc* arc,
                                  double sideways_m)
{
    const Parameters* parameters = &search->parameters;
    const Task* task = &search->task;
    double curvature_change = fabs(search->arc_table.curvature_per_m[arc->curvature] - parent->curvature_per_m);
    double progress_m = (arc->x_m - parent->x_m) * task->goal_x + (arc->y_m - parent->y_m) * task->goal_y;
    double cost_m = parent->cost_m + parameters->step_m + parameters->curvature_change_cost_m2 * curvature_change
                    - parameters->progress_reward * progress_m;
    if (!limits->has_lying)
        return cost_m;
    if (task->failed_count > 0)
        cost_m = cost_m + parameters->failed_path_cost_m * find_closeness(search, limits, arc->x_m, arc->y_m);
    double sideways_ratio = sideways_m / task->max_sideways_m;
    return cost_m + parameters->sideways_cost_m * (sideways_ratio * sideways_ratio);
}

// Compute the end of an arc, and the cost of the path to it. Return false if the arc is not allowed.
//
// An arc is allowed if the body clears all obstacles in its middle and at its end, if it leads about the right way,
// and if it stays near the lying body where the whole body is laid again.
static bool steer(const Search* search, const LayerLimits* limits, const Node* parent, double cosine, double sine,
                  Arc* arc)
{
    const ArcTable* table = &search->arc_table;
    int64_t k = arc->curvature;
    arc->heading_rad = parent->heading_rad + table->turn_rad[k];
    if (angle_between_rad(arc->heading_rad, search->task.goal_rad) >= search->parameters.max_heading_error_rad)
        return false;

    arc->x_m = parent->x_m + cosine * table->end_ahead_m[k] - sine * table->end_left_m[k];
    arc->y_m = parent->y_m + sine * table->end_ahead_m[k] + cosine * table->end_left_m[k];
    double sideways_m = 0.0;
    if (limits->has_lying) {
        sideways_m = hypot(arc->x_m - limits->lying_x_m, arc->y_m - limits->lying_y_m);
        if (sideways_m >= search->task.max_sideways_m)
            return false;
    }

    arc->middle_x_m = parent->x_m + cosine * table->middle_ahead_m[k] - sine * table->middle_left_m[k];
    arc->middle_y_m = parent->y_m + sine * table->middle_ahead_m[k] + cosine * table->middle_left_m[k];
    arc->middle_heading_rad = arc->heading_rad - table->half_turn_rad[k];
    if (!planner_is_clear(search, k, arc->x_m, arc->y_m, arc->heading_rad))
        return false;
    if (!planner_is_clear(search, k, arc->middle_x_m, arc->middle_y_m, arc->middle_heading_rad))
        return false;
    arc->cost_m = compute_path_cost_m(search, limits, parent, arc, sideways_m);
    return true;
}

// Keep the arc in row `arc_count` if it is the cheapest one in its cell; among equal ones, the first. Return the number
// of kept arcs.
static int64_t keep_cheapest(Search* search, int64_t arc_count)
{
    const Parameters* parameters = &search->parameters;
    Arc* arcs = search->scratch.arcs;
    const Arc* arc = &arcs[arc_count];
    int64_t cell =
        planner_number_cell(arc->x_m, arc->y_m, arc->heading_rad, parameters->cell_m, parameters->cell_rad);
    CellEntry* entry = planner_find_entry(&search->scratch, cell);
    if (entry->value == NEW_CELL) {
        entry->value = (int32_t)arc_count;
        return arc_count + 1;
    }
    if (arc->cost_m < arcs[entry->value].cost_m)
        arcs[entry->value] = *arc;
    return arc_count;
}

LayerLimits planner_find_limits(Search* search)
{
    const Parameters* parameters = &search->parameters;
    const Task* task = &search->task;
    LayerLimits limits;
    limits.s_m = search->layers.s_m + parameters->step_m;
    limits.first_contact_m = limits.s_m - parameters->body_length_m + parameters->unused_tail_m;
    limits.last_contact_m = limits.s_m - parameters->unused_head_m;
    limits.is_within_body = task->is_relaid && limits.s_m < parameters->body_length_m - 0.5 * parameters->step_m;
    limits.push_reward = limits.is_within_body ? parameters->push_reward_of_body : parameters->push_reward;
    bool is_near = task->is_relaid && limits.s_m < parameters->body_length_m + parameters->near_m;
    limits.weak_margin_cost_m = is_near ? parameters->weak_margin_cost_near_m : parameters->weak_margin_cost_m;

    // The start is at point 0 of the lying body, so the children of layer k are beside point k + 1.
    int64_t point = search->layers.layer_count;
    limits.has_lying = point < task->lying_count;
    limits.lying_x_m = limits.has_lying ? task->lying_m[2 * point] : 0.0;
    limits.lying_y_m = limits.has_lying ? task->lying_m[2 * point + 1] : 0.0;
    limits.near_failed_count = limits.has_lying ? copy_near_failed(search, &limits) : 0;
    return limits;
}

int64_t planner_grow_arcs(Search* search, const LayerLimits* limits)
{
    int64_t arc_count = 0;
    planner_clear_cells(&search->scratch);
    for (int64_t row = 0; row < search->layers.node_count; row++) {
        const Node* parent = &search->layers.parents[row];
        double cosine = cos(parent->heading_rad);
        double sine = sin(parent->heading_rad);
        for (int64_t k = 0; k < search->arc_table.count; k++) {
            Arc* arc = &search->scratch.arcs[arc_count];
            arc->parent = row;
            arc->curvature = k;
            if (steer(search, limits, parent, cosine, sine, arc))
                arc_count = keep_cheapest(search, arc_count);
        }
    }
    return arc_count;
}
