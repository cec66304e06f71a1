/* The smooth map from a board's plane to an image: a homography, and polynomials for its residuals.
 *
 * The definitions in numpy are in tests/kernels/reference/surface.py, the numbers in rigkit.detection.tags. */
#include "kernels.h"

enum { ENTRIES = 9, SWEEPS = 12 };

/* Set `least` to the eigenvector of the smallest eigenvalue of the symmetric A (cyclic Jacobi: Golub and Van Loan, "Matrix
 * Computations"). */
static void min_eigenvector(double A[ENTRIES][ENTRIES], double least[ENTRIES])
{
    double V[ENTRIES][ENTRIES] = {{0.0}};
    for (int64_t i = 0; i < ENTRIES; i++)
        V[i][i] = 1.0;
    for (int64_t sweep = 0; sweep < SWEEPS; sweep++) {
        double off = 0.0, all = 0.0;
        for (int64_t p = 0; p < ENTRIES; p++) {
            all += A[p][p] * A[p][p];
            for (int64_t q = p + 1; q < ENTRIES; q++)
                off += A[p][q] * A[p][q];
        }
        if (!(off > 1e-32 * all))
            break;
        for (int64_t p = 0; p < ENTRIES; p++)
            for (int64_t q = p + 1; q < ENTRIES; q++) {
                if (A[p][q] == 0.0)
                    continue;
                const double slope = 0.5 * (A[q][q] - A[p][p]) / A[p][q];
                const double t = (slope >= 0.0 ? 1.0 : -1.0) / (fabs(slope) + sqrt(slope * slope + 1.0));
                const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
                for (int64_t k = 0; k < ENTRIES; k++) {
                    const double a = A[k][p], b = A[k][q];
                    A[k][p] = c * a - s * b;
                    A[k][q] = s * a + c * b;
                }
                for (int64_t k = 0; k < ENTRIES; k++) {
                    const double a = A[p][k], b = A[q][k];
                    A[p][k] = c * a - s * b;
                    A[q][k] = s * a + c * b;
                }
                for (int64_t k = 0; k < ENTRIES; k++) {
                    const double a = V[k][p], b = V[k][q];
                    V[k][p] = c * a - s * b;
                    V[k][q] = s * a + c * b;
                }
            }
    }
    int64_t best = 0;
    for (int64_t i = 1; i < ENTRIES; i++)
        best = A[i][i] < A[best][best] ? i : best;
    for (int64_t i = 0; i < ENTRIES; i++)
        least[i] = V[i][best];
}

/* Set `middle` and `size` to the mean of `count` points and their standard deviation, both axes together. */
static void centred(const double *points, int64_t count, double middle[2], double *size)
{
    double both = 0.0, squares = 0.0;
    middle[0] = middle[1] = 0.0;
    for (int64_t i = 0; i < count; i++) {
        middle[0] += points[2 * i] / (double)count;
        middle[1] += points[2 * i + 1] / (double)count;
    }
    both = 0.5 * (middle[0] + middle[1]);
    for (int64_t i = 0; i < 2 * count; i++)
        squares += (points[i] - both) * (points[i] - both);
    *size = sqrt(squares / (2.0 * (double)count));
    *size = *size > 1e-9 ? *size : 1e-9;
}

/* Set the columns SEEN to GAIN of `out` from the homography at each place. */
void project_places(const double *places, int64_t count, const double *homography, double *out)
{
    const double *h = homography;
    for (int64_t i = 0; i < count; i++, out += SURFACE_COLUMNS) {
        const double x = places[2 * i], y = places[2 * i + 1], per_depth = 1.0 / (h[6] * x + h[7] * y + h[8]);
        out[GAIN] = 0.0;
        for (int64_t k = 0; k < 2; k++) {
            const double at = out[SEEN + k] = (h[3 * k] * x + h[3 * k + 1] * y + h[3 * k + 2]) * per_depth;
            for (int64_t axis = 0; axis < 2; axis++) {
                const double side = out[SIDES + 2 * axis + k] = (h[3 * k + axis] - h[6 + axis] * at) * per_depth;
                out[SECOND + 2 * axis + k] = -2.0 * h[6 + axis] * per_depth * side;
            }
        }
    }
}

/* Set `out` to the homography from `places` to `pixels` (normalised direct linear transformation: Hartley and Zisserman, "Multiple
 * View Geometry", algorithm 4.2), scaled to depth 1 at the mean place; return the smallest depth of the places, -infinity if one
 * is not finite. */
FOR_EACH_PROCESSOR double fit_perspective(const double *places, const double *pixels, int64_t count, double *out)
{
    double from[2], to[2], from_size, to_size, A[ENTRIES][ENTRIES] = {{0.0}}, own[ENTRIES];
    centred(places, count, from, &from_size);
    centred(pixels, count, to, &to_size);
    for (int64_t i = 0; i < count; i++) {
        const double x = (places[2 * i] - from[0]) / from_size, y = (places[2 * i + 1] - from[1]) / from_size;
        const double u = (pixels[2 * i] - to[0]) / to_size, v = (pixels[2 * i + 1] - to[1]) / to_size;
        const double rows[2][ENTRIES] = {
            {x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u}, {0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v}};
        for (int64_t r = 0; r < 2; r++)
            for (int64_t p = 0; p < ENTRIES; p++)
                for (int64_t q = 0; q < ENTRIES; q++)
                    A[p][q] += rows[r][p] * rows[r][q];
    }
    min_eigenvector(A, own);
    for (int64_t r = 0; r < 3; r++) {
        double *row = out + 3 * r;
        for (int64_t c = 0; c < 3; c++)
            row[c] = r < 2 ? to_size * own[3 * r + c] + to[r] * own[6 + c] : own[6 + c];
        row[2] -= (row[0] * from[0] + row[1] * from[1]) / from_size;
        row[0] /= from_size;
        row[1] /= from_size;
    }
    const double middle = out[6] * from[0] + out[7] * from[1] + out[8];
    for (int64_t k = 0; k < ENTRIES; k++)
        out[k] /= middle;
    double least = INFINITY;
    for (int64_t i = 0; i < count; i++) {
        const double depth = out[6] * places[2 * i] + out[7] * places[2 * i + 1] + out[8];
        if (!isfinite(depth))
            return -INFINITY;
        least = depth < least ? depth : least;
    }
    return least;
}

/* Set `powers` to the powers 0 to SURFACE_DEGREE of x. */
INLINE void powers_of(double x, double powers[SURFACE_DEGREE + 1])
{
    powers[0] = 1.0;
    for (int64_t k = 1; k <= SURFACE_DEGREE; k++)
        powers[k] = powers[k - 1] * x;
}

/* Set `row` to the terms x^i y^j by increasing degree, within a degree by decreasing power of x. */
INLINE void terms_at(double x, double y, int64_t terms, double *row)
{
    double px[SURFACE_DEGREE + 1], py[SURFACE_DEGREE + 1];
    powers_of(x, px);
    powers_of(y, py);
    for (int64_t degree = 0, k = 0; k < terms; degree++)
        for (int64_t j = 0; j <= degree; j++, k++)
            row[k] = px[degree - j] * py[j];
}

#define TERMS_TO(degree) (((degree) + 1) * ((degree) + 2) / 2)

/* A column whose part orthogonal to the others is smaller than this, relative to its length, depends linearly on them. */
#define SAME_COLUMN 1e-9

/* Make column `k` of the `basis` orthogonal to the previous ones and of length 1, or 0 if it depends on them (modified
 * Gram-Schmidt: monomials up to degree 8 stay orthogonal to 1e-10), and subtract its part from the residuals `left`; `gain` sums
 * up the leverages. */
FOR_EACH_PROCESSOR static void add_column(
    double *basis, int64_t count, int64_t terms, int64_t k, double *triangle, double *basis_values, double *left, double *gain)
{
    double *own = basis + k * count, before = 0.0, after = 0.0, u = 0.0, v = 0.0;
#pragma omp simd reduction(+ : before)
    for (int64_t i = 0; i < count; i++)
        before += own[i] * own[i];
    for (int64_t j = 0; j < k; j++) {
        const double *other = basis + j * count;
        double along = 0.0;
#pragma omp simd reduction(+ : along)
        for (int64_t i = 0; i < count; i++)
            along += own[i] * other[i];
        triangle[j * terms + k] = along;
#pragma omp simd
        for (int64_t i = 0; i < count; i++)
            own[i] -= along * other[i];
    }
#pragma omp simd reduction(+ : after)
    for (int64_t i = 0; i < count; i++)
        after += own[i] * own[i];
    const double length = after > SAME_COLUMN * SAME_COLUMN * before ? sqrt(after) : 0.0;
    const double scale = length > 0.0 ? 1.0 / length : 0.0;
    triangle[k * terms + k] = length;
    double *left_v = left + count;
#pragma omp simd reduction(+ : u, v)
    for (int64_t i = 0; i < count; i++) {
        own[i] *= scale;
        u += own[i] * left[i];
        v += own[i] * left_v[i];
    }
    basis_values[2 * k] = u;
    basis_values[2 * k + 1] = v;
#pragma omp simd
    for (int64_t i = 0; i < count; i++) {
        left[i] -= u * own[i];
        left_v[i] -= v * own[i];
        gain[i] += own[i] * own[i];
    }
}

/* Set `columns` to the terms of a degree at all places; `powers`, of x, then of y, hold those of the lower degrees. */
INLINE void terms_of_degree(
    const double *places, int64_t count, const double unit[3], int64_t degree, double *powers, double *columns)
{
    double *px = powers + degree * count, *py = px + (SURFACE_DEGREE + 1) * count;
    for (int64_t i = 0; i < count; i++) {
        px[i] = degree > 0 ? px[i - count] * ((places[2 * i] - unit[0]) / unit[2]) : 1.0;
        py[i] = degree > 0 ? py[i - count] * ((places[2 * i + 1] - unit[1]) / unit[2]) : 1.0;
    }
    for (int64_t j = 0; j <= degree; j++) {
        const double *across = px - j * count, *down = py - (degree - j) * count;
        double *column = columns + j * count;
#pragma omp simd
        for (int64_t i = 0; i < count; i++)
            column[i] = across[i] * down[i];
    }
}

/* Fit polynomials of increasing degree to `values`, as long as leave-one-out errors decrease; return the degree with the smallest
 * median error. `unit` gets the centre and scale of the places, `misses` the median leave-one-out error of each degree, infinite
 * for those not fitted, `off` and `gain` the leave-one-out errors of the best degree and the standard deviations of its predictions
 * for values of standard deviation 1, `scatter` the median error in these terms. */
FOR_EACH_PROCESSOR int64_t fit_polynomials(
    const double *places, const double *values, int64_t count, int64_t terms, double max_leverage, double *basis, double *scratch,
    double *unit, double *triangle, double *basis_values, double *misses, double *off, double *gain, double *scatter)
{
    double *left = scratch, *leverage = scratch + 2 * count, *missed = scratch + 3 * count, *ranked_off = scratch + 4 * count;
    double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
    for (int64_t i = 0; i < count; i++) {
        left[i] = values[2 * i];
        left[count + i] = values[2 * i + 1];
        leverage[i] = 0.0;
        for (int64_t axis = 0; axis < 2; axis++) {
            const double place = places[2 * i + axis];
            low[axis] = place < low[axis] ? place : low[axis];
            high[axis] = place > high[axis] ? place : high[axis];
        }
    }
    const double across = high[0] - low[0], down = high[1] - low[1], wide = 0.5 * (across > down ? across : down);
    unit[0] = 0.5 * (low[0] + high[0]);
    unit[1] = 0.5 * (low[1] + high[1]);
    unit[2] = wide > 1e-9 ? wide : 1e-9;
    int64_t best = 0;
    for (int64_t degree = 0, k = 0; degree <= SURFACE_DEGREE; degree++) {
        misses[degree] = INFINITY;
        /* The residuals of a homography due to a lens begin with degree 3; those of a symmetric lens have odd degrees only. */
        if (TERMS_TO(degree) > terms || degree > (best > 3 ? best + 2 : 5))
            continue;
        terms_of_degree(places, count, unit, degree, scratch + 5 * count, basis + k * count);
        for (; k < TERMS_TO(degree); k++)
            add_column(basis, count, terms, k, triangle, basis_values, left, leverage);
#pragma omp simd
        for (int64_t i = 0; i < count; i++) {
            const double rest = 1.0 - (leverage[i] < max_leverage ? leverage[i] : max_leverage);
            missed[i] = ranked_off[i] = sqrt(left[i] * left[i] + left[count + i] * left[count + i]) / rest;
        }
        misses[degree] = quick_median(ranked_off, count);
        if (degree > 0 && !(misses[degree] < misses[best]))
            continue;
        best = degree;
        memcpy(off, missed, (size_t)count * sizeof(double));
#pragma omp simd
        for (int64_t i = 0; i < count; i++) {
            const double own = leverage[i] < max_leverage ? leverage[i] : max_leverage;
            gain[i] = sqrt(own / (1.0 - own));
        }
    }
    for (int64_t i = 0; i < count; i++)
        missed[i] = off[i] / sqrt(1.0 + gain[i] * gain[i]);
    *scatter = quick_median(missed, count);
    return best;
}

/* Fit the homography from `places` to `pixels` and polynomials to its residuals; return as `fit_polynomials`, or -1 if the depth of
 * a place is not above `nearest`. `rest` (count, 2) is scratch. */
int64_t fit_map(
    const double *places, const double *pixels, int64_t count, int64_t terms, double max_leverage, double nearest, double *rest,
    double *basis, double *scratch, double *homography, double *unit, double *triangle, double *basis_values, double *misses,
    double *off, double *gain, double *scatter)
{
    const double *h = homography;
    if (!(fit_perspective(places, pixels, count, homography) > nearest))
        return -1;
    for (int64_t i = 0; i < count; i++) {
        const double x = places[2 * i], y = places[2 * i + 1], per_depth = 1.0 / (h[6] * x + h[7] * y + h[8]);
        for (int64_t k = 0; k < 2; k++)
            rest[2 * i + k] = pixels[2 * i + k] - (h[3 * k] * x + h[3 * k + 1] * y + h[3 * k + 2]) * per_depth;
    }
    return fit_polynomials(
        places, rest, count, terms, max_leverage, basis, scratch, unit, triangle, basis_values, misses, off, gain, scatter);
}

/* Set `out` to the values at a place with the terms `row`, from the degree with the smallest predicted error there, and their
 * gain. */
static void most_certain_values(
    const double *row, int64_t terms, const double *triangle, const double *basis_values, const double *misses, double out[3])
{
    double part[SURFACE_TERMS], square = 0.0, u = 0.0, v = 0.0, least = INFINITY;
    memcpy(part, row, (size_t)terms * sizeof(double));
    for (int64_t degree = 0, k = 0; degree <= SURFACE_DEGREE && isfinite(misses[degree]); degree++) {
        for (; k < TERMS_TO(degree); k++) {
            for (int64_t j = 0; j < k; j++)
                part[k] -= triangle[j * terms + k] * part[j];
            const double pivot = triangle[k * terms + k];
            part[k] = pivot > 0.0 ? part[k] / pivot : 0.0;
            square += part[k] * part[k];
            u += part[k] * basis_values[2 * k];
            v += part[k] * basis_values[2 * k + 1];
        }
        const double gain = sqrt(square), off = misses[degree] * (gain > 1.0 ? gain : 1.0);
        if (degree == 0 || off < least) {
            least = off;
            out[0] = u;
            out[1] = v;
            out[2] = gain;
        }
    }
}

/* Set the curvatures and heights of a place from its derivatives. */
INLINE void line_shapes(double *row)
{
    const double *x = row + SIDES, *y = x + 2, area = fabs(x[0] * y[1] - y[0] * x[1]);
    for (int64_t axis = 0; axis < 2; axis++) {
        const double *side = row + SIDES + 2 * axis, *bend = row + SECOND + 2 * axis;
        double squared = side[0] * side[0] + side[1] * side[1];
        const double length = sqrt(squared);
        squared = squared > 1e-12 ? squared : 1e-12;
        row[CURVATURE + axis] = (side[0] * bend[1] - side[1] * bend[0]) / (squared * sqrt(squared));
        row[HEIGHTS + axis] = area / (length > 1e-9 ? length : 1e-9);
    }
}

/* Add the polynomial of `degree`, with its derivatives, to the map `out` at the `wanted` places, and set curvatures and heights; if
 * `most_certain`, with the values of the degree that is most certain at each place. */
FOR_EACH_PROCESSOR void add_polynomial(
    const double *wanted, int64_t count, const double *unit, int64_t terms, int64_t degree, const double *triangle,
    const double *basis_values, const double *misses, int64_t most_certain, double *out)
{
    const double size = unit[2];
    const int64_t end = TERMS_TO(degree);
    double factors[SURFACE_TERMS][2];
    for (int64_t k = end - 1; k >= 0; k--)
        for (int64_t axis = 0; axis < 2; axis++) {
            double left = basis_values[2 * k + axis];
            for (int64_t j = k + 1; j < end; j++)
                left -= triangle[k * terms + j] * factors[j][axis];
            const double pivot = triangle[k * terms + k];
            factors[k][axis] = pivot > 0.0 ? left / pivot : 0.0;
        }
    for (int64_t i = 0; i < count; i++, out += SURFACE_COLUMNS) {
        const double x = (wanted[2 * i] - unit[0]) / size, y = (wanted[2 * i + 1] - unit[1]) / size;
        double px[SURFACE_DEGREE + 1], py[SURFACE_DEGREE + 1], sum[5][2] = {{0.0}};
        powers_of(x, px);
        powers_of(y, py);
        for (int64_t n = 0, k = 0; n <= degree; n++)
            for (int64_t j = 0; j <= n; j++, k++) {
                const int64_t m = n - j;
                const double x1 = m > 0 ? (double)m * px[m - 1] / size : 0.0;
                const double y1 = j > 0 ? (double)j * py[j - 1] / size : 0.0;
                const double x2 = m > 1 ? (double)(m * (m - 1)) * px[m - 2] / (size * size) : 0.0;
                const double y2 = j > 1 ? (double)(j * (j - 1)) * py[j - 2] / (size * size) : 0.0;
                const double part[5] = {px[m] * py[j], x1 * py[j], px[m] * y1, x2 * py[j], px[m] * y2};
                for (int64_t s = 0; s < 5; s++) {
                    sum[s][0] += part[s] * factors[k][0];
                    sum[s][1] += part[s] * factors[k][1];
                }
            }
        if (most_certain) {
            double row[SURFACE_TERMS], best[3] = {0.0};
            terms_at(x, y, terms, row);
            most_certain_values(row, terms, triangle, basis_values, misses, best);
            sum[0][0] = best[0];
            sum[0][1] = best[1];
            out[GAIN] = best[2];
        }
        for (int64_t s = 0; s < 5; s++) {
            out[2 * s] += sum[s][0];
            out[2 * s + 1] += sum[s][1];
        }
        line_shapes(out);
    }
}
