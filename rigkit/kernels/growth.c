/* Lattices of corners: local polynomial fits, growth ring by ring. components.c makes the first ones from links.
 *
 * The definitions in numpy are in tests/kernels/reference/growth.py, the numbers in rigkit.detection.lattice. */
#include "rings.h"

enum { MAX_TERMS = 10, MAX_DEGREE = 3 };

/* The smallest ridge on any term: no exact pivot of the normal equations is smaller, so that rounding cannot make one. */
static const double MIN_PULL = 1e-12;
static const double LINEAR_PULL = 1e-9;

/* The polynomial at a cell (detection.lattice.local_fit.LocalFit). */
typedef struct {
    double pixel[2], along_column[2], along_row[2], curvature_column[2], curvature_row[2], support, gain;
} fit_t;

/* Solve the n x n symmetric `matrix` for three right-hand sides in place (LDL'). */
INLINE void solve(double matrix[MAX_TERMS][MAX_TERMS], double right[MAX_TERMS][3], const int n)
{
    for (int k = 0; k < n; k++) {
        const double pivot = matrix[k][k] > MIN_PULL ? matrix[k][k] : MIN_PULL;
        const double inverse = 1.0 / pivot;
        for (int i = k + 1; i < n; i++) {
            const double factor = matrix[k][i] * inverse;
            for (int j = i; j < n; j++)
                matrix[i][j] -= factor * matrix[k][j];
            for (int side = 0; side < 3; side++)
                right[i][side] -= factor * right[k][side];
        }
        matrix[k][k] = pivot;
    }
    for (int k = n - 1; k >= 0; k--)
        for (int side = 0; side < 3; side++) {
            double sum = right[k][side];
            for (int j = k + 1; j < n; j++)
                sum -= matrix[k][j] * right[j][side];
            right[k][side] = sum / matrix[k][k];
        }
}

/* The powers of column and row in a polynomial's terms. */
static const int POWER_C[MAX_TERMS] = {0, 1, 0, 2, 1, 0, 3, 2, 1, 0};
static const int POWER_R[MAX_TERMS] = {0, 0, 1, 0, 1, 2, 0, 1, 2, 3};

/* The sums of a fit over the cells around one: the range of cells, their weights, the moments, sums of weight * column^i * row^j,
 * and the same with the positions, which are relative to a corner `near`by to avoid cancellation. */
typedef struct {
    int64_t row, column, low_r, low_c, high_r, high_c, support;
    double moment[2 * MAX_DEGREE + 1][2 * MAX_DEGREE + 1], position[MAX_TERMS][2], near[2];
    double weights[2 * MAX_FIT_RADIUS + 1][2 * MAX_FIT_RADIUS + 1];
} surroundings_t;

/* Add the known cells of row `r`. */
INLINE void add_row(
    const double *lattice, int64_t columns, int64_t r, const int degree, const fit_rules_t *rules, const double *bell,
    surroundings_t *at)
{
    double line[2 * MAX_DEGREE + 1] = {0.0}, line_u[MAX_DEGREE + 1] = {0.0}, line_v[MAX_DEGREE + 1] = {0.0};
    const int64_t row = at->row, column = at->column;
    int64_t found = 0;
    for (int64_t c = at->low_c; c <= at->high_c; c++) {
        const double *pixel = lattice + 2 * (r * columns + c);
        const double u = pixel[0], v = pixel[1];
        const int known = u == u && !(rules->leave_out && r == row && c == column);
        double *weight = &at->weights[r - at->low_r][c - at->low_c];
        *weight = 0.0;
        if (!known)
            continue;
        if (at->support + found == 0) {
            at->near[0] = u;
            at->near[1] = v;
        }
        found++;
        const double x = (double)(c - column);
        double power = *weight = bell[r < row ? row - r : r - row] * bell[c < column ? column - c : c - column];
        for (int i = 0; i <= 2 * degree; i++) {
            line[i] += power;
            if (i <= degree) {
                line_u[i] += power * (u - at->near[0]);
                line_v[i] += power * (v - at->near[1]);
            }
            power *= x;
        }
    }
    if (!found)
        return;
    at->support += found;
    const double y = (double)(r - row);
    double powers[2 * MAX_DEGREE + 1];
    powers[0] = 1.0;
    for (int j = 1; j <= 2 * degree; j++)
        powers[j] = powers[j - 1] * y;
    for (int i = 0; i <= 2 * degree; i++)
        for (int j = 0; i + j <= 2 * degree; j++)
            at->moment[i][j] += line[i] * powers[j];
    for (int k = 0; k < (degree + 1) * (degree + 2) / 2; k++) {
        at->position[k][0] += line_u[POWER_C[k]] * powers[POWER_R[k]];
        at->position[k][1] += line_v[POWER_C[k]] * powers[POWER_R[k]];
    }
}

/* Return by how much the value at the cell grows with independent errors of the positions around it, `solved` being the
 * polynomial of the cell's own column of the inverse. */
INLINE double gain_of(const surroundings_t *at, const int degree, double solved[MAX_TERMS][3])
{
    double gain = 0.0;
    for (int64_t r = at->low_r; r <= at->high_r; r++) {
        const double y = (double)(r - at->row);
        for (int64_t c = at->low_c; c <= at->high_c; c++) {
            const double x = (double)(c - at->column);
            double lever = solved[0][2] + x * solved[1][2] + y * solved[2][2];
            if (degree > 1)
                lever += x * x * solved[3][2] + x * y * solved[4][2] + y * y * solved[5][2];
            if (degree > 2)
                lever += x * x * (x * solved[6][2] + y * solved[7][2]) + y * y * (x * solved[8][2] + y * solved[9][2]);
            lever *= at->weights[r - at->low_r][c - at->low_c];
            gain += lever * lever;
        }
    }
    return sqrt(gain);
}

/* Fit a polynomial of `degree` (known when compiling, so that all loops unroll) around the cell (row, column) of
 * `lattice` (rows, columns, 2), NaN where unknown. `bell` are the weights of steps 0, 1, ... along one direction. */
INLINE void fit_polynomial(
    const double *lattice, int64_t rows, int64_t columns, int64_t row, int64_t column, const int degree, const fit_rules_t *rules,
    const double *bell, fit_t *out)
{
    const int terms = (degree + 1) * (degree + 2) / 2;
    const int64_t radius = rules->radius;
    surroundings_t at = {
        .row = row,
        .column = column,
        .low_r = row - radius > 0 ? row - radius : 0,
        .low_c = column - radius > 0 ? column - radius : 0,
        .high_r = row + radius < rows - 1 ? row + radius : rows - 1,
        .high_c = column + radius < columns - 1 ? column + radius : columns - 1};
    for (int64_t r = at.low_r; r <= at.high_r; r++)
        add_row(lattice, columns, r, degree, rules, bell, &at);
    const double total = at.moment[0][0] > MIN_PULL ? at.moment[0][0] : MIN_PULL;
    const double centre_u = at.position[0][0] / total, centre_v = at.position[0][1] / total;
    double normal[MAX_TERMS][MAX_TERMS], solved[MAX_TERMS][3];
    const double pull[MAX_DEGREE + 1] = {MIN_PULL, LINEAR_PULL, rules->ridge[0], rules->ridge[1]};
    for (int k = 0; k < terms; k++) {
        for (int j = k; j < terms; j++)
            normal[k][j] = at.moment[POWER_C[k] + POWER_C[j]][POWER_R[k] + POWER_R[j]];
        solved[k][0] = at.position[k][0] - centre_u * normal[0][k];
        solved[k][1] = at.position[k][1] - centre_v * normal[0][k];
        solved[k][2] = k == 0;
    }
    for (int k = 0; k < terms; k++)
        normal[k][k] += pull[POWER_C[k] + POWER_R[k]];
    solve(normal, solved, terms);
    out->pixel[0] = solved[0][0] + centre_u + at.near[0];
    out->pixel[1] = solved[0][1] + centre_v + at.near[1];
    for (int side = 0; side < 2; side++) {
        out->along_column[side] = solved[1][side];
        out->along_row[side] = solved[2][side];
        out->curvature_column[side] = degree > 1 ? 2.0 * solved[3][side] : 0.0;
        out->curvature_row[side] = degree > 1 ? 2.0 * solved[5][side] : 0.0;
    }
    out->support = (double)at.support;
    out->gain = gain_of(&at, degree, solved);
}

INLINE void fit_cell(
    const double *lattice, int64_t rows, int64_t columns, int64_t row, int64_t column, const fit_rules_t *rules, const double *bell,
    fit_t *out)
{
    if (rules->degree == 1)
        fit_polynomial(lattice, rows, columns, row, column, 1, rules, bell, out);
    else if (rules->degree == 2)
        fit_polynomial(lattice, rows, columns, row, column, 2, rules, bell, out);
    else
        fit_polynomial(lattice, rows, columns, row, column, 3, rules, bell, out);
}

INLINE void fill_bell(const fit_rules_t *rules, double *bell)
{
    for (int64_t step = 0; step <= rules->radius; step++)
        bell[step] = exp(-0.5 * (double)(step * step) / (rules->width * rules->width));
}

/* reference.growth.fit for the cells marked in `cells` (rows, columns), row by row. */
FOR_EACH_PROCESSOR void fit_cells(
    const double *lattice, int64_t rows, int64_t columns, const uint8_t *cells, const fit_rules_t *rules, int64_t count,
    double *out)
{
    (void)count;
    fit_t *fits = (fit_t *)out;
    double bell[MAX_FIT_RADIUS + 1];
    fill_bell(rules, bell);
    for (int64_t row = 0; row < rows; row++)
        for (int64_t column = 0; column < columns; column++)
            if (cells[row * columns + column])
                fit_cell(lattice, rows, columns, row, column, rules, bell, fits++);
}

/* Sort the `count` > 0 points into squares, in `memory` (squares_memory). */
FOR_EACH_PROCESSOR void sort_points(const double *points, int64_t count, int32_t *memory, squares_t *out)
{
    fill_squares(points, count, 1.0, memory, out);
}

int64_t squares_memory(int64_t count)
{
    return SQUARES_MEMORY(count);
}

/* Find the (at most `most`) nearest points within `reach` of (u, v), the nearest first; return their number. */
static int64_t nearest_points(const squares_t *squares, double u, double v, double reach, int64_t most, int64_t *found)
{
    double distance[MAX_TRIED];
    int64_t count = 0;
    const int64_t low_c = square_at(u - reach, squares->left, squares->side, squares->columns);
    const int64_t high_c = square_at(u + reach, squares->left, squares->side, squares->columns);
    const int64_t low_r = square_at(v - reach, squares->top, squares->side, squares->rows);
    const int64_t high_r = square_at(v + reach, squares->top, squares->side, squares->rows);
    for (int64_t row = low_r; row <= high_r; row++) {
        const int32_t *first = squares->first + row * squares->columns;
        for (int32_t k = first[low_c]; k < first[high_c + 1]; k++) {
            const double du = squares->points[2 * squares->order[k]] - u;
            const double dv = squares->points[2 * squares->order[k] + 1] - v;
            const double here = du * du + dv * dv;
            if (!(here <= reach * reach) || (count == most && here >= distance[count - 1]))
                continue;
            int64_t at = count < most ? count++ : count - 1;
            for (; at > 0 && distance[at - 1] > here; at--) {
                distance[at] = distance[at - 1];
                found[at] = found[at - 1];
            }
            distance[at] = here;
            found[at] = squares->order[k];
        }
    }
    return count;
}

INLINE int is_known(const sheet_t *sheet, int64_t row, int64_t column)
{
    if (row < 0 || column < 0 || row >= sheet->rows || column >= sheet->columns)
        return 0;
    const double u = sheet->pixels[2 * (row * sheet->columns + column)];
    return u == u;
}

INLINE int runs_along(double angle, const double *vector, double line_sine)
{
    const double cross = cos(angle) * vector[1] - sin(angle) * vector[0];
    return fabs(cross) < line_sine * sqrt(vector[0] * vector[0] + vector[1] * vector[1]);
}

/* Return whether the saddle at `pixel` can be the corner of the cell, and set its contrast (reference.growth._fits). */
INLINE int fits(
    const sheet_t *sheet, const pyramid_level_t *level, const growth_rules_t *rules, const fit_t *fit, int64_t row, int64_t column,
    double height, const double *pixel, double *contrast)
{
    const double u = (pixel[0] - level->offset) / level->scale, v = (pixel[1] - level->offset) / level->scale;
    const double sign = (row + column) % 2 ? -sheet->sign : sheet->sign;
    double radius = rules->ring_part * height / level->scale, angles[2];
    radius = radius > rules->min_ring ? radius : rules->min_ring;
    radius = radius < rules->max_ring ? radius : rules->max_ring;
    if (!read_ring(level->image, *rules->ring, (float)u, (float)v, (float)radius, 0.0, angles, contrast))
        return 0;
    if (!runs_along(angles[0], sign > 0.0 ? fit->along_column : fit->along_row, rules->line_sine)
        || !runs_along(angles[1], sign > 0.0 ? fit->along_row : fit->along_column, rules->line_sine))
        return 0;
    static const int64_t step_c[4] = {1, 0, -1, 0}, step_r[4] = {0, 1, 0, -1};
    for (int direction = 0; direction < 4; direction++) {
        const int64_t r = row + step_r[direction], c = column + step_c[direction];
        if (!is_known(sheet, r, c))
            continue;
        const double *end = sheet->pixels + 2 * (r * sheet->columns + c);
        const double end_u = (end[0] - level->offset) / level->scale, end_v = (end[1] - level->offset) / level->scale;
        const double side = direction % 2 ? -sign : sign;
        const double there = sheet->contrast[r * sheet->columns + c];
        const double weakest = rules->contrast_ratio * (there < *contrast ? there : *contrast);
        double lateral = rules->lateral * sqrt((end_u - u) * (end_u - u) + (end_v - v) * (end_v - v));
        lateral = lateral > rules->min_lateral ? lateral : rules->min_lateral;
        lateral = lateral < rules->max_lateral ? lateral : rules->max_lateral;
        if (!edge_seen(level->image, rules->along, rules->places, rules->min_places, u, v, end_u, end_v, side, lateral, weakest))
            return 0;
    }
    return 1;
}

/* Try the saddles near the prediction of one empty cell; return whether one fits, its pixel and contrast in `out`. */
INLINE int try_cell(
    const sheet_t *sheet, const pyramid_level_t *level, const squares_t *saddles, const growth_rules_t *rules,
    const fit_rules_t *prediction, const double *bell, int64_t row, int64_t column, double out[3])
{
    fit_t fit;
    fit_cell(sheet->pixels, sheet->rows, sheet->columns, row, column, prediction, bell, &fit);
    if (fit.support < (double)rules->min_predicting)
        return 0;
    const double place_u = (fit.pixel[0] - level->offset) / level->scale;
    const double place_v = (fit.pixel[1] - level->offset) / level->scale;
    if (!(place_u > 0.0 && place_v > 0.0 && place_u < (double)(level->image.width - 1)
          && place_v < (double)(level->image.height - 1)))
        return 0;
    const double *a = fit.along_column, *b = fit.along_row;
    const double side_a = sqrt(a[0] * a[0] + a[1] * a[1]), side_b = sqrt(b[0] * b[0] + b[1] * b[1]);
    const double longest = side_a > side_b ? side_a : side_b, area = a[0] * b[1] - a[1] * b[0];
    if (!(area > rules->min_area))
        return 0;
    int64_t near[MAX_TRIED];
    double off[MAX_TRIED];
    const int64_t count = nearest_points(saddles, fit.pixel[0], fit.pixel[1], rules->reach * longest, rules->tried, near);
    for (int64_t k = 0; k < count; k++) {
        const double *at = saddles->points + 2 * near[k];
        const double du = at[0] - fit.pixel[0], dv = at[1] - fit.pixel[1];
        off[k] = hypot(du * b[1] - dv * b[0], a[0] * dv - a[1] * du) / area;
    }
    /* Try them in the order of their distances in cells. */
    for (int64_t k = 0; k < count; k++) {
        int64_t best = -1;
        for (int64_t j = 0; j < count; j++)
            if (off[j] < rules->reach && (best < 0 || off[j] < off[best]))
                best = j;
        if (best < 0)
            return 0;
        off[best] = rules->reach;
        const double *at = saddles->points + 2 * near[best];
        if (fits(sheet, level, rules, &fit, row, column, area / longest, at, &out[2])) {
            out[0] = at[0];
            out[1] = at[1];
            return 1;
        }
    }
    return 0;
}

INLINE int has_neighbour(const sheet_t *sheet, int64_t row, int64_t column)
{
    return is_known(sheet, row - 1, column) || is_known(sheet, row, column - 1) || is_known(sheet, row + 1, column)
        || is_known(sheet, row, column + 1);
}

static int touches_border(const sheet_t *sheet)
{
    for (int64_t c = 0; c < sheet->columns; c++)
        if (is_known(sheet, 0, c) || is_known(sheet, sheet->rows - 1, c))
            return 1;
    for (int64_t r = 0; r < sheet->rows; r++)
        if (is_known(sheet, r, 0) || is_known(sheet, r, sheet->columns - 1))
            return 1;
    return 0;
}

/* Grow one lattice in place by at most `rings` rings (reference.growth.grown). `fresh` (rows * columns, 3) and `where`
 * (rows * columns) are scratch. Return the number of rings left if it needs a larger sheet to continue, -1 if it is complete. */
FOR_EACH_PROCESSOR int64_t grow_lattice(
    sheet_t *sheet, const pyramid_level_t *level, const squares_t *saddles, const growth_rules_t *rules, int64_t rings,
    double *fresh, int64_t *where)
{
    const int64_t rows = sheet->rows, columns = sheet->columns;
    for (; rings > 0; rings--) {
        if (touches_border(sheet))
            return rings;
        int64_t count = 0;
        for (int way = 0; way < 2 && count == 0; way++) {
            const fit_rules_t *prediction = &rules->predictions[way];
            double bell[MAX_FIT_RADIUS + 1];
            fill_bell(prediction, bell);
            for (int64_t row = 0; row < rows; row++)
                for (int64_t column = 0; column < columns; column++) {
                    const int64_t cell = row * columns + column;
                    if (!sheet->due[way * rows * columns + cell] || is_known(sheet, row, column)
                        || !has_neighbour(sheet, row, column))
                        continue;
                    sheet->due[way * rows * columns + cell] = 0;
                    if (try_cell(sheet, level, saddles, rules, prediction, bell, row, column, fresh + 3 * count))
                        where[count++] = cell;
                }
        }
        if (!count)
            return -1;
        for (int64_t k = 0; k < count; k++) {
            sheet->pixels[2 * where[k]] = fresh[3 * k];
            sheet->pixels[2 * where[k] + 1] = fresh[3 * k + 1];
            sheet->contrast[where[k]] = fresh[3 * k + 2];
            /* Predictions that failed before may have changed within the reach of the fits. */
            const int64_t row = where[k] / columns, column = where[k] % columns;
            for (int64_t r = row - MAX_FIT_RADIUS; r <= row + MAX_FIT_RADIUS; r++)
                for (int64_t c = column - MAX_FIT_RADIUS; c <= column + MAX_FIT_RADIUS; c++)
                    if (r >= 0 && c >= 0 && r < rows && c < columns)
                        sheet->due[r * columns + c] = sheet->due[(rows + r) * columns + c] = 1;
        }
    }
    return -1;
}
