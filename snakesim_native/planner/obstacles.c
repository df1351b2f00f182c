// The nearest obstacle of a point: see `obstacle_grid.py` and `outlines.py`.

#include "search.h"

#include <math.h>

static double max_of(double a, double b) { return a > b ? a : b; }

static double min_of(double a, double b) { return a < b ? a : b; }

// Return the index of the grid's cell around a point, or -1 outside of the grid.
static int64_t find_cell(const Grid* grid, double x_m, double y_m)
{
    int64_t column = (int64_t)((x_m - grid->low_x_m) / grid->cell_m + 0.5);
    int64_t row = (int64_t)((y_m - grid->low_y_m) / grid->cell_m + 0.5);
    bool is_inside = column >= 0 && row >= 0 && column < grid->columns && row < grid->rows;
    return is_inside ? column * grid->rows + row : -1;
}

// Return the distance of a point from one obstacle, and the normal there.
//
// With q = |p| - h, where p is the point in the frame of the obstacle's rectangle and h its half size, the distance is
// |max(q, 0)| + min(max(q_x, q_y), 0) - rounding. The normal points away from the nearest point of the rectangle;
// inside of the rectangle, out of its nearest edge.
static Nearest measure_distance(const Grid* grid, int64_t obstacle, double x_m, double y_m)
{
    double cosine = grid->direction[2 * obstacle];
    double sine = grid->direction[2 * obstacle + 1];
    double dx = x_m - grid->center_m[2 * obstacle];
    double dy = y_m - grid->center_m[2 * obstacle + 1];
    double local_x = cosine * dx + sine * dy;
    double local_y = cosine * dy - sine * dx;

    double over_x = fabs(local_x) - grid->half_size_m[2 * obstacle];
    double over_y = fabs(local_y) - grid->half_size_m[2 * obstacle + 1];
    double out_x = max_of(over_x, 0.0);
    double out_y = max_of(over_y, 0.0);
    double outside = hypot(out_x, out_y);
    double inside = min_of(max_of(over_x, over_y), 0.0);

    double sign_x = local_x < 0.0 ? -1.0 : 1.0;
    double sign_y = local_y < 0.0 ? -1.0 : 1.0;
    double normal_x;
    double normal_y;
    if (outside > 0.0) {
        normal_x = out_x / outside * sign_x;
        normal_y = out_y / outside * sign_y;
    } else if (over_x >= over_y) {
        normal_x = sign_x;
        normal_y = 0.0;
    } else {
        normal_x = 0.0;
        normal_y = sign_y;
    }

    Nearest nearest;
    nearest.obstacle = obstacle;
    nearest.distance_m = outside + inside - grid->rounding_m[obstacle];
    nearest.normal_x = cosine * normal_x - sine * normal_y;
    nearest.normal_y = sine * normal_x + cosine * normal_y;
    return nearest;
}

// Return the obstacle that a cell stores, exactly as seen from a point in the cell.
static Nearest find_nearest_in_cell(const Grid* grid, int64_t cell, double x_m, double y_m)
{
    if (cell < 0 || grid->nearest[cell] == NO_OBSTACLE) {
        Nearest none = {NO_OBSTACLE, grid->max_distance_m, 0.0, 0.0};
        return none;
    }
    return measure_distance(grid, grid->nearest[cell], x_m, y_m);
}

Nearest planner_find_nearest(const Grid* grid, double x_m, double y_m, double reach_m)
{
    int64_t cell = find_cell(grid, x_m, y_m);
    if (cell >= 0 && grid->distance_m[cell] > WIDER * (reach_m + grid->cell_error_m))
        cell = -1;
    return find_nearest_in_cell(grid, cell, x_m, y_m);
}

// The sine and cosine of the heading are computed only where the side of the arc decides.
bool planner_is_clear(const Search* search, int64_t curvature, double x_m, double y_m, double heading_rad)
{
    const Grid* grid = &search->grid;
    const ArcTable* table = &search->arc_table;
    int64_t cell = find_cell(grid, x_m, y_m);
    double approximate_m = cell < 0 ? grid->max_distance_m : grid->distance_m[cell];
    if (approximate_m >= table->surely_clear_m[curvature])
        return true;
    if (approximate_m < table->surely_blocked_m)
        return false;

    Nearest nearest = find_nearest_in_cell(grid, cell, x_m, y_m);
    if (nearest.distance_m >= table->needed_inside_m[curvature])
        return true;
    if (nearest.distance_m < table->needed_m)
        return false;
    double normal_to_left = cos(heading_rad) * nearest.normal_y - sin(heading_rad) * nearest.normal_x;
    double curvature_per_m = table->curvature_per_m[curvature];
    bool is_inner_side = curvature_per_m > 0.0 ? normal_to_left < 0.0 : normal_to_left > 0.0;
    return !(is_inner_side && curvature_per_m != 0.0);
}

// Write an obstacle into the cells of a window that have no nearer one. The window is within the grid.
void snakesim_planner_mark_obstacle(const Grid* grid, const Window* window, int64_t obstacle)
{
    for (int64_t column = window->first_column; column < window->last_column; column++) {
        double x_m = grid->low_x_m + grid->cell_m * (double)column;
        for (int64_t row = window->first_row; row < window->last_row; row++) {
            double y_m = grid->low_y_m + grid->cell_m * (double)row;
            int64_t cell = column * grid->rows + row;
            double distance_m = measure_distance(grid, obstacle, x_m, y_m).distance_m;
            if (distance_m < grid->distance_m[cell]) {
                grid->distance_m[cell] = distance_m;
                grid->nearest[cell] = obstacle;
            }
        }
    }
}
