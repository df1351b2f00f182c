// The data of the beam search, and the functions that its files share.
//
// `snakesim_gnc/navigation/path_search/specified_growth.py` is the specification, and explains the cost. The C files compute the same
// numbers, operation by operation and in the same order, so that every path is equal to the last bit. They must be
// compiled with `-ffp-contract=off`: a fused multiplication and addition rounds once instead of twice.
//
//   obstacles.c   the nearest obstacle of a point
//   cells.c       cells of place and heading, and sorting by cost
//   arcs.c        all arcs that leave a layer, and their cost without contacts
//   contacts.c    contacts and propulsion margin of a body
//   planner.c     expands a layer, with the functions above
//
// `native_growth.py` calls `snakesim_planner_expand` once for each layer. It owns all memory and checks all sizes.
// Nothing is allocated here, and every loop is bounded by a count in the structures below.
//
// In comments, n is the number of parents, c the number of curvatures and m that of obstacles. Points are in the world
// frame. The layouts of the structures are repeated in `native_library.py`; `snakesim_planner_layout` returns their
// sizes for comparison.

#ifndef SNAKESIM_PLANNER_SEARCH_H
#define SNAKESIM_PLANNER_SEARCH_H

#include <stdbool.h>
#include <stdint.h>

#define MAX_CONTACTS 8
#define NO_OBSTACLE (-1)
#define NEW_CELL (-1) // value of an entry that was just made

// Limits that only save work are wider than needed by this factor, so that rounding cannot change a result.
#define WIDER 1.000001

// One contact of a body with an obstacle.
typedef struct {
    int64_t obstacle; // index; NO_OBSTACLE in an empty slot
    double s_m;       // arc length along the path
    double gap_m;     // between skin and obstacle
    double wrench[3]; // of a unit push: fx, fy, moment about the search's origin in m
} Contact;

// A place and heading of the head, with what its body touches.
typedef struct {
    double x_m;
    double y_m;
    double heading_rad;
    double curvature_per_m; // of the arc that led here
    double cost_m;
    double drag_m[3]; // integral of the tangent's wrench over the whole body: m, m, m^2
    Contact contacts[MAX_CONTACTS]; // the newest is last
} Node;

// The cheapest arc that ends in one cell of place and heading.
typedef struct {
    int64_t parent;    // row
    int64_t curvature; // index
    // Its end.
    double x_m;
    double y_m;
    double heading_rad;
    // Its middle.
    double middle_x_m;
    double middle_y_m;
    double middle_heading_rad;
    double cost_m; // of the path to its end, without the terms of its contact
} Arc;

// A child that may be kept: what the newest arc adds to the body of its parent.
typedef struct {
    int64_t arc;          // row of the arc
    int64_t has_new_slot; // 1 if the newest contact takes a new slot and drops the oldest, 0 if it replaces the newest
    Contact newest;
    double cost_m;
    double drag_m[3];
    double arc_drag_m[3];
    double margin_n;
} Candidate;

// A row to be sorted by cost, then by the cost without the terms of its contact, then by rank.
typedef struct {
    double cost_m;
    double arc_cost_m;
    int32_t rank; // parent * c + curvature
    int32_t row;
} SortKey;

// An entry of a hash table of cells. It is empty if its stamp is not the table's newest.
typedef struct {
    int64_t cell;
    int32_t stamp;
    int32_t value;
} CellEntry;

// The obstacles, and a grid of cells that store their nearest one: see `obstacle_grid.py` and `outlines.py`.
typedef struct {
    double low_x_m; // center of the first cell
    double low_y_m;
    double cell_m;
    double cell_error_m;   // largest difference between a cell's distance and that of a point in it
    double max_distance_m; // of cells without an obstacle, and outside of the grid
    int64_t columns;
    int64_t rows;
    int64_t* nearest;          // (columns, rows) index of the obstacle, or NO_OBSTACLE
    double* distance_m;        // (columns, rows)
    const double* center_m;    // (m, 2)
    const double* direction;   // (m, 2) cosine and sine of the yaw
    const double* half_size_m; // (m, 2)
    const double* rounding_m;  // (m)
} Grid;

// A rectangle of cells; the last ones are not in it.
typedef struct {
    int64_t first_column;
    int64_t last_column;
    int64_t first_row;
    int64_t last_row;
} Window;

// The arcs of all curvatures, as in `search_arcs.py`. Each array has c numbers.
typedef struct {
    int64_t count;                 // c
    const double* curvature_per_m;
    const double* turn_rad;        // over a whole arc
    const double* half_turn_rad;   // over half of it
    const double* end_ahead_m;     // the arc's end in the parent's frame
    const double* end_left_m;
    const double* middle_ahead_m;  // the arc's middle in the parent's frame
    const double* middle_left_m;
    const double* needed_inside_m; // distance from an obstacle that the body needs on the inner side of the arc
    const double* surely_clear_m;  // approximate distance with which a pose is clear in any case
    double needed_m;               // distance that the body needs in any case
    double surely_blocked_m;       // approximate distance below which a pose is not clear in any case
} ArcTable;

// The robot and the costs, as in `search_parameters.py`; costs are multiplied by the length of an arc.
typedef struct {
    double step_m; // length of an arc
    double body_length_m;
    double radius_m;
    double contact_distance_m;
    double max_frontal; // |n.t| of a contact with the side of the body
    double min_push;    // n.g of a contact that counts for the margin
    double obstacle_friction;
    double unused_tail_m;
    double unused_head_m;
    double wanted_margin_n;
    double max_heading_error_rad;
    double near_m;
    // Costs.
    double push_reward;
    double push_reward_of_body;
    double brake_cost;
    double progress_reward;
    double curvature_change_cost_m2; // for 1/m of change
    double weak_margin_cost_m;       // for one arc
    double weak_margin_cost_near_m;
    double failed_path_cost_m;
    double sideways_cost_m;
    double failed_path_m; // a path farther than this from a failed one costs nothing
    // The propulsion margin: see `margin.py`.
    double max_contact_force_n;
    double min_determinant;
    double moment_scale;
    double min_force_per_n;
    // Nodes that are kept.
    double cell_m;
    double cell_rad;
    double wide_cell_m;
    double wide_cell_rad;
    int64_t max_candidates;
    int64_t kept_nodes;
    int64_t kept_per_wide_cell;
    int64_t body_arcs; // length of the body in arcs
} Parameters;

// The goal of one search, and the body from which it starts.
typedef struct {
    double origin_x_m; // moments are about it
    double origin_y_m;
    double goal_rad;
    double goal_x; // unit vector
    double goal_y;
    const double* lying_drag_m; // (body_arcs, 3) drag of each arc of the body at the start, tail to head
    // For a search of the whole body; otherwise the counts are 0.
    int64_t is_relaid;
    int64_t lying_count;
    const double* lying_m; // (lying_count, 2) where the body lies, tail to head
    double max_sideways_m; // how far the path may be from where the body lies
    int64_t failed_count;
    const double* failed_m; // (failed_count, 2) points of paths on which the body got stuck
} Task;

// The layers of the search. Rows of the history are (layer, node) with room for `node_room` nodes.
typedef struct {
    int64_t layer_count; // layers that there are already; the newest one has the parents
    int64_t layer_room;
    int64_t node_room;
    int64_t node_count; // n
    double s_m;         // arc length of the parents from the start of the path
    Node* parents;      // (node_room) the newest layer
    Node* children;     // (node_room) receives the next one
    // History.
    int64_t* parent;    // (layer_room, node_room) row in the layer before
    double* x_m;        // (layer_room, node_room)
    double* y_m;
    double* margin_n;
    double* arc_drag_m; // (layer_room, node_room, 3) drag of the arc that led to the node
} Layers;

// Memory for the work on one layer.
typedef struct {
    int64_t entry_room;    // a power of two, more than 5/4 of node_room * c
    int32_t stamp;         // of the newest use of the hash table
    Arc* arcs;             // (node_room * c)
    SortKey* keys;         // (node_room * c)
    SortKey* spare_keys;   // (node_room * c)
    Candidate* candidates; // (node_room * c)
    CellEntry* entries;    // (entry_room)
    int64_t* tail_nodes;   // (node_room) row of the node at the tail of each parent's body
    double* near_failed_m; // (failed_count, 2)
} Scratch;

typedef struct {
    Grid grid;
    ArcTable arc_table;
    Parameters parameters;
    Task task;
    Layers layers;
    Scratch scratch;
} Search;

// An obstacle as seen from a point.
typedef struct {
    int64_t obstacle; // NO_OBSTACLE if none is near; then the normal is zero
    double distance_m;
    double normal_x; // unit vector from the obstacle to the point
    double normal_y;
} Nearest;

// The limits of one layer, which are the same for all its nodes.
typedef struct {
    double s_m;             // arc length of the children
    double first_contact_m; // arc lengths between which a contact counts for the margin
    double last_contact_m;
    double push_reward;
    double weak_margin_cost_m;
    bool is_within_body; // the margin has no meaning yet, and costs nothing
    // Where the body lies at this arc length; only if the whole body is laid again.
    bool has_lying;
    double lying_x_m;
    double lying_y_m;
    int64_t near_failed_count;
} LayerLimits;

// The sizes of the structures in bytes.
typedef struct {
    int64_t search;
    int64_t node;
    int64_t contact;
    int64_t arc;
    int64_t sort_key;
    int64_t candidate;
    int64_t cell_entry;
} Layout;

// ---- obstacles.c ----

// Return the obstacle that is nearest to a point. One farther away than reach_m may count as none.
Nearest planner_find_nearest(const Grid* grid, double x_m, double y_m, double reach_m);

// Return whether the body clears all obstacles at a pose on an arc.
//
// Straight links cut the corners of the path, so the inner side of an arc needs more room.
bool planner_is_clear(const Search* search, int64_t curvature, double x_m, double y_m, double heading_rad);

// ---- cells.c ----

// Return a number that poses in the same cell of place and heading share.
int64_t planner_number_cell(double x_m, double y_m, double heading_rad, double size_m, double size_rad);

// Empty the hash table of cells.
void planner_clear_cells(Scratch* scratch);

// Return the entry of a cell. One that is just made has the value NEW_CELL.
CellEntry* planner_find_entry(Scratch* scratch, int64_t cell);

// Sort the keys. Return the array that holds the result.
const SortKey* planner_sort(Scratch* scratch, int64_t count);

// ---- arcs.c ----

// Return the limits of the next layer, and collect the points of failed paths near it.
LayerLimits planner_find_limits(Search* search);

// Steer from every parent with every curvature, and store the cheapest allowed arc in each cell. Return their number.
int64_t planner_grow_arcs(Search* search, const LayerLimits* limits);

// ---- contacts.c ----

// Find the newest contact of a candidate's body: what it touches in the middle of its arc, or the one of its parent.
//
// A body slides along an obstacle over several arcs. That is one contact, stored where the gap is smallest; its arc
// length is that of the newest arc. A contact with another obstacle takes a new slot and drops the oldest.
//
// s_m: arc length at the end of the arc. tangent: (2) of the arc in its middle.
// Return the push towards the goal n.g of the contact in the middle of the arc, 0 without one.
double planner_find_contact(const Search* search, double s_m, const Node* parent, const Arc* arc,
                            const double tangent[2], Candidate* candidate);

// Return the contacts (MAX_CONTACTS - 1) of a candidate's body except for the newest one.
const Contact* planner_find_older_contacts(const Node* parent, const Candidate* candidate);

// Return the propulsion margin of a parent's body after the step along a candidate's arc.
double planner_compute_margin_n(const Search* search, const LayerLimits* limits, const Node* parent,
                                const Candidate* candidate);

#endif
