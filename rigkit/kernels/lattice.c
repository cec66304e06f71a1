/* Quality measures of whole lattices: regularity of their rows, scatter of their corners about smooth surfaces, offsets
 * of the edges between them.
 *
 * The definitions in numpy are in tests/kernels/reference/lattice.py, the numbers in rigkit.detection: lattice.spacing,
 * subpixel.scatter, checks.validate. */
#include "kernels.h"

/* Set `typical` to the median difference of neighbouring steps at each inner column of `rows` x `columns` pixels, with these
 * strides, and `seen` to the number of steps; return the upper median of all, NaN for none. */
static double uneven_columns(
    const double *pixels, int64_t rows, int64_t columns, int64_t row_stride, int64_t column_stride, double *scratch,
    double *typical, int64_t *seen)
{
    double *every = scratch, *here = scratch + rows * columns;
    int64_t all = 0;
    for (int64_t column = 0; column < columns - 2; column++) {
        int64_t count = 0;
        for (int64_t row = 0; row < rows; row++) {
            const double *a = pixels + row * row_stride + column * column_stride;
            const double *b = a + column_stride, *c = b + column_stride;
            const double u1 = b[0] - a[0], v1 = b[1] - a[1], u2 = c[0] - b[0], v2 = c[1] - b[1];
            const double one = u1 * u1 + v1 * v1, two = u2 * u2 + v2 * v2;
            const double bend = (u2 - u1) * (u2 - u1) + (v2 - v1) * (v2 - v1);
            const double relative = sqrt(bend / (one < two ? one : two));
            if (isfinite(relative))
                here[count++] = every[all++] = relative;
        }
        seen[column] = count;
        typical[column] = count ? quick_median(here, count) : NAN;
    }
    return all ? ranked(every, all, all / 2) : NAN;
}

/* Set `typical` and `seen` to the above for the inner columns, then for the inner rows, and `every` to the two medians of
 * all (reference.lattice.uneven_steps). `scratch` has room for twice as many numbers as there are corners. */
void uneven_steps(
    const double *pixels, int64_t rows, int64_t columns, double *scratch, int64_t all, double *typical, int64_t *seen,
    double *every)
{
    (void)all;
    const int64_t inner = columns > 2 ? columns - 2 : 0;
    every[0] = uneven_columns(pixels, rows, columns, 2 * columns, 2, scratch, typical, seen);
    every[1] = uneven_columns(pixels, columns, rows, 2, 2 * columns, scratch, typical + inner, seen + inner);
}

/* Set `out` to the distances of the neighbouring column and row lines from those through `count` cells, before and after, from
 * first and second derivatives along columns and rows (detection.lattice.local_fit.LocalFit.gaps). */
void line_gaps(const double *sides, const double *curvatures, int64_t count, double *out)
{
    for (int64_t i = 0; i < count; i++, sides += 4, curvatures += 4, out += 4) {
        const double area = sides[0] * sides[3] - sides[1] * sides[2];
        const double row = 0.5 * (sides[0] * curvatures[3] - sides[1] * curvatures[2]);
        const double column = 0.5 * (curvatures[0] * sides[3] - curvatures[1] * sides[2]);
        const double along = hypot(sides[0], sides[1]), down = hypot(sides[2], sides[3]);
        out[0] = fabs(area - row) / along;
        out[1] = fabs(area + row) / along;
        out[2] = fabs(area + column) / down;
        out[3] = fabs(area - column) / down;
    }
}

enum { PLANE = 8 };

/* A part of a sheet, one row after the other: corners, their variance, and room for four numbers for each of them. */
typedef struct {
    double *pixels, *variance, *room;
    int64_t rows, columns;
} part_t;

/* Return the typical difference of `order` over the expected one, NaN for few (reference.lattice._roughness). */
static double roughness(const part_t part, int64_t order, const scatter_rules_t *rules)
{
    double factor[MAX_DIFFERENCE_ORDER + 1] = {1.0};
    for (int64_t k = 1; k <= order; k++)
        factor[k] = -factor[k - 1] * (double)(order + 1 - k) / (double)k;
    int64_t count = 0;
    for (int along_row = 0; along_row < 2; along_row++) {
        const int64_t stride = along_row ? 1 : part.columns;
        const int64_t rows = part.rows - (along_row ? 0 : order), columns = part.columns - (along_row ? order : 0);
        for (int64_t row = 0; row < rows; row++)
            for (int64_t column = 0; column < columns; column++) {
                const int64_t start = row * part.columns + column;
                double u = 0.0, v = 0.0, variance = 0.0;
                for (int64_t k = 0; k <= order; k++) {
                    const int64_t at = start + k * stride;
                    u += factor[k] * part.pixels[2 * at];
                    v += factor[k] * part.pixels[2 * at + 1];
                    variance += factor[k] * factor[k] * part.variance[at];
                }
                const double inverse = 1.0 / sqrt(variance);
                if (isfinite(u * inverse) && isfinite(v * inverse)) {
                    part.room[count++] = fabs(u * inverse);
                    part.room[count++] = fabs(v * inverse);
                }
            }
    }
    return count >= rules->min_differences ? quick_median(part.room, count) / rules->median_of_normal : NAN;
}

/* Return whether rows and columns have `least` differences of `order`, both coordinates, and both have some, or twice as many. */
static int has_differences(const double *pixels, int64_t rows, int64_t columns, int64_t order, int64_t least)
{
    int64_t counts[2] = {0};
    for (int along_row = 0; along_row < 2; along_row++)
        for (int64_t line = 0; line < (along_row ? rows : columns); line++) {
            int64_t run = 0;
            for (int64_t k = 0; k < (along_row ? columns : rows); k++) {
                run = isfinite(pixels[2 * (along_row ? line * columns + k : k * columns + line)]) ? run + 1 : 0;
                counts[along_row] += run > order ? 2 : 0;
            }
        }
    return counts[0] + counts[1] >= (counts[0] > 0 && counts[1] > 0 ? least : 2 * least);
}

INLINE double product(const double *a, const double *b, int64_t count)
{
    double sum = 0.0;
    for (int64_t i = 0; i < count; i++)
        sum += a[i] * b[i];
    return sum;
}

/* Subtract from `values` their component along the unit vector `along`. */
INLINE void take_away(double *values, const double *along, int64_t count)
{
    const double part = product(values, along, count);
    for (int64_t i = 0; i < count; i++)
        values[i] -= part * along[i];
}

/* Set `out` to the residuals of surfaces of both degrees over the corners' sigmas (rms), NaN where these fit any
 * (reference.lattice.surface_scatter), or where rows and columns have differences enough. `scratch` holds five
 * numbers and all terms for each corner. */
void surface_scatter(
    const double *pixels, const double *sigma, int64_t rows, int64_t columns, const scatter_rules_t *rules, double *scratch,
    double *out)
{
    const int64_t size = rows * columns;
    double *places[2] = {scratch, scratch + size}, *weight = scratch + 2 * size;
    double *x = scratch + 3 * size, *y = scratch + 4 * size, *terms = scratch + 5 * size;
    int64_t count = 0, found = 0;
    double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY}, middle[2] = {0.0, 0.0};
    out[0] = out[1] = NAN;
    if (has_differences(pixels, rows, columns, rules->first_order, rules->min_differences))
        return;
    for (int64_t i = 0; i < size; i++) {
        if (!isfinite(pixels[2 * i]) || !isfinite(sigma[i]))
            continue;
        const double at[2] = {(double)(i % columns), (double)(i / columns)};
        for (int axis = 0; axis < 2; axis++) {
            low[axis] = at[axis] < low[axis] ? at[axis] : low[axis];
            high[axis] = at[axis] > high[axis] ? at[axis] : high[axis];
            middle[axis] += at[axis];
            places[axis][count] = pixels[2 * i + axis] / sigma[i];
        }
        x[count] = at[0];
        y[count] = at[1];
        weight[count++] = 1.0 / sigma[i];
    }
    for (int64_t i = 0; i < count; i++) {
        x[i] = 2.0 * (x[i] - middle[0] / (double)count) / (high[0] - low[0] > 1.0 ? high[0] - low[0] : 1.0);
        y[i] = 2.0 * (y[i] - middle[1] / (double)count) / (high[1] - low[1] > 1.0 ? high[1] - low[1] : 1.0);
    }
    const double least = rules->min_term * rules->min_term * product(weight, weight, count);
    for (int64_t degree = 0; degree <= rules->degrees[1]; degree++) {
        for (int64_t up = 0; up <= degree; up++) {
            double *term = terms + found * size;
            for (int64_t i = 0; i < count; i++) {
                term[i] = weight[i];
                for (int64_t k = 0; k < degree; k++)
                    term[i] *= k < up ? y[i] : x[i];
            }
            /* Twice: once leaves rounding errors of large components. */
            for (int twice = 0; twice < 2; twice++)
                for (int64_t k = 0; k < found; k++)
                    take_away(term, terms + k * size, count);
            const double left = product(term, term, count);
            /* A term that depends linearly on the previous ones, for few rows. */
            if (!(left > least))
                continue;
            for (int64_t i = 0; i < count; i++)
                term[i] /= sqrt(left);
            take_away(places[0], term, count);
            take_away(places[1], term, count);
            found++;
        }
        const double free = (double)(count - found);
        for (int k = 0; k < 2; k++)
            if (degree == rules->degrees[k] && 2.0 * free >= (double)rules->min_differences)
                out[k] = sqrt((product(places[0], places[0], count) + product(places[1], places[1], count)) / (2.0 * free));
    }
}

/* Solve `matrix` x = `right` for a positive definite matrix, of which the lower half is given, in place; return whether it
 * is so. */
static int solve(double matrix[PLANE][PLANE], double right[PLANE])
{
    for (int j = 0; j < PLANE; j++) {
        for (int i = j; i < PLANE; i++) {
            double sum = matrix[i][j];
            for (int k = 0; k < j; k++)
                sum -= matrix[i][k] * matrix[j][k];
            if (i == j && !(sum > 0.0))
                return 0;
            matrix[i][j] = i == j ? sqrt(sum) : sum / matrix[j][j];
        }
        for (int k = 0; k < j; k++)
            right[j] -= matrix[j][k] * right[k];
        right[j] /= matrix[j][j];
    }
    for (int j = PLANE - 1; j >= 0; j--) {
        for (int k = j + 1; k < PLANE; k++)
            right[j] -= matrix[k][j] * right[k];
        right[j] /= matrix[j][j];
    }
    return 1;
}

/* Take from the corners where those of the best flat board through a pinhole would be (reference.lattice._best_plane). */
static void flatten(const part_t part)
{
    const int64_t size = part.rows * part.columns;
    double mean[2] = {0.0}, spread = 0.0, count = 0.0;
    for (int64_t i = 0; i < size; i++)
        if (isfinite(part.pixels[2 * i])) {
            mean[0] += part.pixels[2 * i];
            mean[1] += part.pixels[2 * i + 1];
            count += 1.0;
        }
    mean[0] /= count;
    mean[1] /= count;
    for (int64_t i = 0; i < size; i++)
        if (isfinite(part.pixels[2 * i]))
            spread += fabs(part.pixels[2 * i] - mean[0]) + fabs(part.pixels[2 * i + 1] - mean[1]);
    const double unit = spread / count;
    double normal[PLANE][PLANE] = {{0.0}}, found[PLANE] = {0.0};
    for (int64_t i = 0; i < size; i++) {
        if (!isfinite(part.pixels[2 * i]))
            continue;
        const double x = 2.0 * (double)(i % part.columns) / (double)part.columns - 1.0;
        const double y = 2.0 * (double)(i / part.columns) / (double)part.rows - 1.0;
        for (int axis = 0; axis < 2; axis++) {
            const double p = (part.pixels[2 * i + axis] - mean[axis]) / unit;
            double row[PLANE] = {0.0};
            row[3 * axis] = x;
            row[3 * axis + 1] = y;
            row[3 * axis + 2] = 1.0;
            row[6] = -p * x;
            row[7] = -p * y;
            for (int j = 0; j < PLANE; j++) {
                for (int k = 0; k <= j; k++)
                    normal[j][k] += row[j] * row[k];
                found[j] += row[j] * p;
            }
        }
    }
    const int solved = solve(normal, found);
    for (int64_t i = 0; i < size; i++) {
        const double x = 2.0 * (double)(i % part.columns) / (double)part.columns - 1.0;
        const double y = 2.0 * (double)(i / part.columns) / (double)part.rows - 1.0;
        const double depth = found[6] * x + found[7] * y + 1.0;
        for (int axis = 0; axis < 2; axis++) {
            const double *h = found + 3 * axis;
            const double flat = (h[0] * x + h[1] * y + h[2]) / depth * unit + mean[axis];
            part.pixels[2 * i + axis] -= solved ? flat : NAN;
        }
    }
}

/* Set `out` to the scatter of the corners of each of `count` parts of a sheet, `width` corners wide, over that predicted by their
 * sigmas (reference.lattice.excess_scatter). `parts` are top, left, rows, columns; `scratch` has room for seven numbers
 * for each corner of a part. */
void excess_scatter(
    const double *pixels, const double *sigma, int64_t height, int64_t width, const int64_t *parts, int64_t count,
    const scatter_rules_t *rules, double *scratch, double *out)
{
    (void)height;
    for (int64_t n = 0; n < count; n++) {
        const int64_t *at = parts + 4 * n, size = at[2] * at[3];
        const part_t part = {scratch, scratch + 2 * size, scratch + 3 * size, at[2], at[3]};
        int64_t known = 0;
        for (int64_t i = 0; i < size; i++) {
            const int64_t cell = (at[0] + i / at[3]) * width + at[1] + i % at[3];
            part.pixels[2 * i] = pixels[2 * cell];
            part.pixels[2 * i + 1] = pixels[2 * cell + 1];
            part.variance[i] = sigma[cell] * sigma[cell];
            known += isfinite(pixels[2 * cell]) != 0;
        }
        double calmest = known < rules->min_corners ? 1.0 : INFINITY;
        for (int flat = 0; flat < 2; flat++)
            for (int64_t order = rules->first_order; order <= rules->last_order && calmest > rules->unexplained; order++) {
                if (flat && order == rules->first_order)
                    flatten(part);
                calmest = fmin(calmest, roughness(part, order, rules));
            }
        out[n] = calmest > rules->unexplained && isfinite(calmest) ? calmest : 1.0;
    }
}

/* A square's four corners at (row, column) and after it, in pixels of the level; return whether all are known. */
static int square_of(
    const double *pixels, int64_t columns, int64_t row, int64_t column, double scale, double offset, double out[4][2])
{
    double sum = 0.0;
    for (int k = 0; k < 4; k++) {
        const double *at = pixels + 2 * ((row + k / 2) * columns + column + k % 2);
        for (int axis = 0; axis < 2; axis++)
            sum += out[k][axis] = (at[axis] - offset) / scale;
    }
    return isfinite(sum);
}

/* Add the brightness at `steps` + 1 places to `sums`, from (u - across_u, v - across_v) to (u + across_u, v + across_v). */
INLINE void add_profile(
    const image_t image, double u, double v, double across_u, double across_v, int64_t steps, double *restrict sums)
{
    const double each = 2.0 / (double)steps, reach_u = fabs(across_u), reach_v = fabs(across_v);
    /* Within the image nothing needs to be clipped, and the loop is vectorised. */
    if (u - reach_u > 0.0 && v - reach_v > 0.0 && u + reach_u < (double)(image.width - 2)
        && v + reach_v < (double)(image.height - 2)) {
        const int32_t width = (int32_t)image.width;
        const float *restrict pixels = image.brightness;
        for (int64_t s = 0; s <= steps; s++) {
            const double step = each * (double)s - 1.0;
            const float at_u = (float)(u + step * across_u), at_v = (float)(v + step * across_v);
            const int32_t left = (int32_t)at_u, top = (int32_t)at_v, at = top * width + left;
            const float right = at_u - (float)left, below = at_v - (float)top;
            const float upper = pixels[at] + right * (pixels[at + 1] - pixels[at]);
            const float lower = pixels[at + width] + right * (pixels[at + width + 1] - pixels[at + width]);
            sums[s] += (double)(upper + below * (lower - upper));
        }
        return;
    }
    for (int64_t s = 0; s <= steps; s++) {
        const double step = each * (double)s - 1.0;
        sums[s] += (double)brightness_at(image, (float)(u + step * across_u), (float)(v + step * across_v));
    }
}

/* Set `out` to the offsets of the edges of a lattice to the dark side of the line of their corners, at `parts` places `along` it,
 * each within its own `reach` (reference.lattice.shifts_of_edges). `sign` is that of the first corner; `sums` has room for parts x (steps + 1). */
FOR_EACH_PROCESSOR
void edge_shifts(
    const double *pixels, int64_t rows, int64_t columns, double sign, const image_t image, double scale, double offset,
    const double *reach, const double *along, int64_t parts, int64_t steps, int64_t most, double *sums, double *out)
{
    double corner[4][2];
    int64_t count = 0, next = 0;
    for (int64_t row = 0; row + 1 < rows; row++)
        for (int64_t column = 0; column + 1 < columns; column++)
            count += 2 * square_of(pixels, columns, row, column, scale, offset, corner);
    const int64_t every = count / most > 1 ? count / most : 1;
    memset(sums, 0, (size_t)(parts * (steps + 1)) * sizeof(double));
    for (int down = 0; down < 2; down++)
        for (int64_t row = 0; row + 1 < rows; row++)
            for (int64_t column = 0; column + 1 < columns; column++) {
                if (!square_of(pixels, columns, row, column, scale, offset, corner) || next++ % every)
                    continue;
                /* The first edge of the square along this axis, and the opposite one. */
                const double *start = corner[0], *end = corner[1 + down], *lateral = corner[2 - down], *last = corner[3];
                const double side = 0.5 * ((row + column) % 2 ? -sign : sign);
                const double across_u = side * (lateral[0] + last[0] - start[0] - end[0]);
                const double across_v = side * (lateral[1] + last[1] - start[1] - end[1]);
                for (int64_t k = 0; k < parts; k++) {
                    const double u = start[0] + along[k] * (end[0] - start[0]);
                    const double v = start[1] + along[k] * (end[1] - start[1]);
                    add_profile(image, u, v, reach[k] * across_u, reach[k] * across_v, steps, sums + k * (steps + 1));
                }
            }
    for (int64_t k = 0; k < parts; k++) {
        /* The mean of a step from dark to bright determines its position, independently of its blur. */
        const double *sum = sums + k * (steps + 1), dark = sum[0], bright = sum[steps];
        const double middle = 0.5 * (dark + bright), contrast = bright - dark > 1e-9 ? bright - dark : 1e-9;
        double mean = -middle;
        for (int64_t s = 0; s <= steps; s++)
            mean += sum[s];
        out[k] = 2.0 * reach[k] * (mean / (double)steps - middle) / contrast;
    }
}
