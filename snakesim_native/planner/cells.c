// Cells of place and heading in a hash table, and sorting by cost.

#include "search.h"

#include <string.h>

// Return the largest whole number that is not above a number. `floor` would be a call on processors without SSE 4.1.
static int64_t floor_of(double number)
{
    int64_t towards_zero = (int64_t)number;
    return towards_zero - (number < (double)towards_zero);
}

int64_t planner_number_cell(double x_m, double y_m, double heading_rad, double size_m, double size_rad)
{
    int64_t column = floor_of(x_m / size_m);
    int64_t row = floor_of(y_m / size_m);
    int64_t sector = floor_of(heading_rad / size_rad);
    return (column * 100003 + row) * 1009 + sector;
}

// An entry counts only with the newest stamp, so a new stamp empties the table.
void planner_clear_cells(Scratch* scratch) { scratch->stamp += 1; }

// The table is never full, so the loop ends at the cell's entry or at an empty one.
CellEntry* planner_find_entry(Scratch* scratch, int64_t cell)
{
    uint64_t mask = (uint64_t)scratch->entry_room - 1;
    uint64_t hash = (uint64_t)cell * UINT64_C(0x9E3779B97F4A7C15); // 2^64 / golden ratio: spreads neighbors
    uint64_t place = (hash >> 32) & mask;
    CellEntry* entry = &scratch->entries[place];
    for (int64_t tries = 1; tries < scratch->entry_room; tries++) {
        if (entry->stamp != scratch->stamp || entry->cell == cell)
            break;
        place = (place + 1) & mask;
        entry = &scratch->entries[place];
    }
    if (entry->stamp != scratch->stamp) {
        entry->stamp = scratch->stamp;
        entry->cell = cell;
        entry->value = NEW_CELL;
    }
    return entry;
}

static bool is_before(const SortKey* a, const SortKey* b)
{
    if (a->cost_m != b->cost_m)
        return a->cost_m < b->cost_m;
    if (a->arc_cost_m != b->arc_cost_m)
        return a->arc_cost_m < b->arc_cost_m;
    return a->rank < b->rank;
}

static int64_t min_of(int64_t a, int64_t b) { return a < b ? a : b; }

// Merge two sorted runs, [first, middle) and [middle, last), into the same places of another array.
static void merge_runs(const SortKey* from, SortKey* to, int64_t first, int64_t middle, int64_t last)
{
    int64_t left = first;
    int64_t right = middle;
    int64_t place = first;
    for (; left < middle && right < last; place++) {
        bool is_right_next = is_before(&from[right], &from[left]);
        to[place] = from[is_right_next ? right : left];
        right += is_right_next;
        left += !is_right_next;
    }
    memcpy(to + place, from + left, (size_t)(middle - left) * sizeof(SortKey));
    place += middle - left;
    memcpy(to + place, from + right, (size_t)(last - right) * sizeof(SortKey));
}

// A merge sort from the bottom up: it doubles the length of the sorted runs until one run is left.
const SortKey* planner_sort(Scratch* scratch, int64_t count)
{
    SortKey* keys = scratch->keys;
    SortKey* merged = scratch->spare_keys;
    for (int64_t width = 1; width < count; width *= 2) {
        for (int64_t first = 0; first < count; first += 2 * width) {
            int64_t middle = min_of(first + width, count);
            int64_t last = min_of(first + 2 * width, count);
            merge_runs(keys, merged, first, middle, last);
        }
        SortKey* emptied = keys;
        keys = merged;
        merged = emptied;
    }
    return keys;
}
