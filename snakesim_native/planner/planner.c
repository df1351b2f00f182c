// Expands a layer of the search: rates the cheapest arcs with their contacts, and keeps the best as the next layer.

#include "search.h"

#include <math.h>
#include <string.h>

static SortKey make_key(const Search* search, double cost_m, int64_t arc_row, int64_t row)
{
    const Arc* arc = &search->scratch.arcs[arc_row];
    SortKey key;
    key.cost_m = cost_m;
    key.arc_cost_m = arc->cost_m;
    key.rank = (int32_t)(arc->parent * search->arc_table.count + arc->curvature);
    key.row = (int32_t)row;
    return key;
}

// Choose the cheapest arcs as candidates, and return how many. Their order does not matter.
static int64_t pick_candidates(Search* search, int64_t arc_count)
{
    Scratch* scratch = &search->scratch;
    int64_t max_candidates = search->parameters.max_candidates;
    if (arc_count <= max_candidates) {
        for (int64_t row = 0; row < arc_count; row++)
            scratch->candidates[row].arc = row;
        return arc_count;
    }
    for (int64_t row = 0; row < arc_count; row++)
        scratch->keys[row] = make_key(search, scratch->arcs[row].cost_m, row, row);
    const SortKey* order = planner_sort(scratch, arc_count);
    for (int64_t row = 0; row < max_candidates; row++)
        scratch->candidates[row].arc = order[row].row;
    return max_candidates;
}

// Find for each parent the node to which the arc at its tail leads: one body length behind the head of a child.
//
// Return the layer of those nodes, or -1 while the tail is still on the body as it lay at first.
static int64_t find_tail_nodes(Search* search)
{
    const Layers* layers = &search->layers;
    int64_t* tail_nodes = search->scratch.tail_nodes;
    int64_t tail_layer = layers->layer_count - search->parameters.body_arcs;
    if (tail_layer <= 0)
        return -1;
    for (int64_t row = 0; row < layers->node_count; row++)
        tail_nodes[row] = row;
    for (int64_t layer = layers->layer_count - 1; layer > tail_layer; layer--) {
        const int64_t* parent = layers->parent + layer * layers->node_room;
        for (int64_t row = 0; row < layers->node_count; row++)
            tail_nodes[row] = parent[tail_nodes[row]];
    }
    return tail_layer;
}

// Return the drag (3) of the arc that the tail leaves when the head enters the next arc.
static const double* find_drag_left_behind_m(const Search* search, int64_t tail_layer, int64_t parent)
{
    const Layers* layers = &search->layers;
    if (tail_layer < 0)
        return search->task.lying_drag_m + 3 * (layers->layer_count - 1);
    return layers->arc_drag_m + 3 * (tail_layer * layers->node_room + search->scratch.tail_nodes[parent]);
}

// Compute contact, drag, margin and cost of the node at the end of an arc. left_m: drag that the tail leaves behind.
static void rate_candidate(const Search* search, const LayerLimits* limits, const Arc* arc, const double left_m[3],
                           Candidate* candidate)
{
    const Parameters* parameters = &search->parameters;
    const Node* parent = &search->layers.parents[arc->parent];
    double tangent[2];
    tangent[0] = cos(arc->middle_heading_rad);
    tangent[1] = sin(arc->middle_heading_rad);

    double push = planner_find_contact(search, limits->s_m, parent, arc, tangent, candidate);
    double push_cost = push > 0.0 ? -limits->push_reward * push : -parameters->brake_cost * push;
    candidate->cost_m = arc->cost_m + parameters->step_m * push_cost;

    double from_origin_x_m = arc->middle_x_m - search->task.origin_x_m;
    double from_origin_y_m = arc->middle_y_m - search->task.origin_y_m;
    candidate->arc_drag_m[0] = parameters->step_m * tangent[0];
    candidate->arc_drag_m[1] = parameters->step_m * tangent[1];
    candidate->arc_drag_m[2] = parameters->step_m * (from_origin_x_m * tangent[1] - from_origin_y_m * tangent[0]);
    for (int axis = 0; axis < 3; axis++)
        candidate->drag_m[axis] = parent->drag_m[axis] + (candidate->arc_drag_m[axis] - left_m[axis]);

    candidate->margin_n = planner_compute_margin_n(search, limits, parent, candidate);
    if (limits->is_within_body)
        return;
    double weakness = 1.0 - candidate->margin_n / parameters->wanted_margin_n;
    weakness = weakness > 0.0 ? weakness : 0.0;
    candidate->cost_m += limits->weak_margin_cost_m * weakness;
}

static void rate_candidates(Search* search, const LayerLimits* limits, int64_t candidate_count)
{
    int64_t tail_layer = find_tail_nodes(search);
    for (int64_t row = 0; row < candidate_count; row++) {
        Candidate* candidate = &search->scratch.candidates[row];
        const Arc* arc = &search->scratch.arcs[candidate->arc];
        const double* left_m = find_drag_left_behind_m(search, tail_layer, arc->parent);
        rate_candidate(search, limits, arc, left_m, candidate);
    }
}

// Write a candidate as a node of the next layer, and into the history.
static void keep_child(Search* search, int64_t child_row, const Candidate* candidate)
{
    Layers* layers = &search->layers;
    const Arc* arc = &search->scratch.arcs[candidate->arc];
    const Node* parent = &layers->parents[arc->parent];
    Node* child = &layers->children[child_row];
    child->x_m = arc->x_m;
    child->y_m = arc->y_m;
    child->heading_rad = arc->heading_rad;
    child->curvature_per_m = search->arc_table.curvature_per_m[arc->curvature];
    child->cost_m = candidate->cost_m;
    memcpy(child->drag_m, candidate->drag_m, sizeof(child->drag_m));
    memcpy(child->contacts, planner_find_older_contacts(parent, candidate), (MAX_CONTACTS - 1) * sizeof(Contact));
    child->contacts[MAX_CONTACTS - 1] = candidate->newest;

    int64_t place = layers->layer_count * layers->node_room + child_row;
    layers->parent[place] = arc->parent;
    layers->x_m[place] = arc->x_m;
    layers->y_m[place] = arc->y_m;
    layers->margin_n[place] = candidate->margin_n;
    memcpy(layers->arc_drag_m + 3 * place, candidate->arc_drag_m, sizeof(candidate->arc_drag_m));
}

// Keep the cheapest candidates, with a limited number in each wide cell. Return how many.
static int64_t thin_out(Search* search, int64_t candidate_count)
{
    const Parameters* parameters = &search->parameters;
    Scratch* scratch = &search->scratch;
    for (int64_t row = 0; row < candidate_count; row++) {
        const Candidate* candidate = &scratch->candidates[row];
        scratch->keys[row] = make_key(search, candidate->cost_m, candidate->arc, row);
    }
    const SortKey* order = planner_sort(scratch, candidate_count);

    int64_t kept_count = 0;
    planner_clear_cells(scratch);
    for (int64_t place = 0; place < candidate_count && kept_count < parameters->kept_nodes; place++) {
        const Candidate* candidate = &scratch->candidates[order[place].row];
        const Arc* arc = &scratch->arcs[candidate->arc];
        int64_t cell = planner_number_cell(arc->x_m, arc->y_m, arc->heading_rad, parameters->wide_cell_m,
                                           parameters->wide_cell_rad);
        CellEntry* entry = planner_find_entry(scratch, cell);
        if (entry->value == NEW_CELL)
            entry->value = 0; // cheaper candidates in the cell
        if (entry->value < parameters->kept_per_wide_cell) {
            keep_child(search, kept_count, candidate);
            kept_count += 1;
        }
        entry->value += 1;
    }
    return kept_count;
}

// Expand the newest layer into the next one, and make that the newest. Return its number of nodes.
//
// Return 0, and change nothing, if no arc is free. Return -1, and change nothing, if there is no room for a layer.
int64_t snakesim_planner_expand(Search* search)
{
    Layers* layers = &search->layers;
    if (layers->layer_count >= layers->layer_room)
        return -1;
    LayerLimits limits = planner_find_limits(search);
    int64_t arc_count = planner_grow_arcs(search, &limits);
    if (arc_count == 0)
        return 0;
    int64_t candidate_count = pick_candidates(search, arc_count);
    rate_candidates(search, &limits, candidate_count);
    int64_t child_count = thin_out(search, candidate_count);

    Node* former_parents = layers->parents;
    layers->parents = layers->children;
    layers->children = former_parents;
    layers->node_count = child_count;
    layers->layer_count += 1;
    layers->s_m = limits.s_m;
    return child_count;
}

// Write the sizes in bytes of the structures: of those that the caller lays out itself, then of those whose memory it
// only provides.
void snakesim_planner_layout(Layout* layout)
{
    layout->search = sizeof(Search);
    layout->node = sizeof(Node);
    layout->contact = sizeof(Contact);
    layout->arc = sizeof(Arc);
    layout->sort_key = sizeof(SortKey);
    layout->candidate = sizeof(Candidate);
    layout->cell_entry = sizeof(CellEntry);
}
