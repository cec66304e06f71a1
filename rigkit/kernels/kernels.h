/* Conventions of the kernels: C-contiguous arrays, sizes as int64_t, images row by row as float (0..255), pixel (0, 0) the
 * centre of the top-left pixel. Kernels check nothing: their Python callers own types, shapes and sizes. */
#ifndef RIGKIT_KERNELS_H
#define RIGKIT_KERNELS_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "api.h"

/* On a hot function: also compiled for newer processors, chosen when the library is loaded. By what they can do:
 * "arch=haswell" would be chosen on a Haswell alone. */
#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12 && defined(__x86_64__) && defined(__GLIBC__)
#define PROCESSORS 1
#define FOR_EACH_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define PROCESSORS 0
#define FOR_EACH_PROCESSOR
#endif

#if !defined(__GNUC__) && !defined(__clang__)
#error "needs vector extensions: compile with gcc or clang (on Windows clang-cl, or the clang of the package ziglang)"
#endif

/* What a small function that hot loops call needs to be vectorised with them. */
#define INLINE static inline __attribute__((always_inline, unused))

/* Return `image` at (u, v), bilinear, the border repeated (detection.saddles.response.sample). */
INLINE float brightness_at(const image_t image, float u, float v)
{
    const int32_t width = (int32_t)image.width;
    const float max_u = (float)(image.width - 1), max_v = (float)(image.height - 1);
    u = u > 0.0f ? u : 0.0f;
    v = v > 0.0f ? v : 0.0f;
    u = u < max_u ? u : max_u;
    v = v < max_v ? v : max_v;
    int32_t left = (int32_t)u, top = (int32_t)v;
    left = left < width - 2 ? left : width - 2;
    top = top < (int32_t)image.height - 2 ? top : (int32_t)image.height - 2;
    const float right = u - (float)left, below = v - (float)top;
    const float *at = image.brightness + (ptrdiff_t)top * width + left;
    const float upper = at[0] + right * (at[1] - at[0]);
    const float lower = at[width] + right * (at[width + 1] - at[width]);
    return upper + below * (lower - upper);
}

/* Return the grey level at (u, v), bilinear, the border repeated; 0 where that is no place. */
INLINE double grey_level_at(const void *grey, int64_t bytes, int64_t width, int64_t height, double u, double v)
{
    if (!(isfinite(u) && isfinite(v)))
        return 0.0;
    u = u > 0.0 ? u : 0.0;
    v = v > 0.0 ? v : 0.0;
    u = u < (double)(width - 1) ? u : (double)(width - 1);
    v = v < (double)(height - 1) ? v : (double)(height - 1);
    int64_t left = (int64_t)u, top = (int64_t)v;
    left = left < width - 2 ? left : width - 2;
    top = top < height - 2 ? top : height - 2;
    const double right = u - (double)left, below = v - (double)top;
    const int64_t at = top * width + left;
    double a, b, c, d;
    if (bytes) {
        const uint8_t *image = (const uint8_t *)grey + at;
        a = image[0], b = image[1], c = image[width], d = image[width + 1];
    } else {
        const float *image = (const float *)grey + at;
        a = image[0], b = image[1], c = image[width], d = image[width + 1];
    }
    const double upper = a + right * (b - a), lower = c + right * (d - c);
    return upper + below * (lower - upper);
}

#define PI 3.14159265358979323846

/* Return whether at `most` or more of the `places` `along` the edge from (u, v) to (end_u, end_v) the side that should be
 * brighter (sign +1: where angles grow from u to v, seen from the start) is so by more than `weakest`
 * (reference.links.edge_contrast). */
INLINE int edge_seen(
    const image_t image, const double *along, int64_t places, int64_t min_places, double u, double v, double end_u, double end_v,
    double sign, double offset, double weakest)
{
    const double chord_u = end_u - u, chord_v = end_v - v;
    double length = sqrt(chord_u * chord_u + chord_v * chord_v);
    length = length > 1e-9 ? length : 1e-9;
    const double aside_u = -sign * offset * chord_v / length, aside_v = sign * offset * chord_u / length;
    /* Clutter is told from an edge by the first places. */
    int64_t unseen = 0;
    for (int64_t k = 0; k < places && unseen <= places - min_places; k++) {
        const double at_u = u + along[k] * chord_u, at_v = v + along[k] * chord_v;
        const float bright = brightness_at(image, (float)(at_u + aside_u), (float)(at_v + aside_v));
        const float dark = brightness_at(image, (float)(at_u - aside_u), (float)(at_v - aside_v));
        unseen += !((double)(bright - dark) > weakest);
    }
    return unseen <= places - min_places;
}

/* At most so many squares for so many points: smaller ones leave more of them to look into, larger ones more points that
 * are too far. */
#define MAX_SQUARES(count) ((count) / 2 + 8)

/* int32_t that `fill_squares` needs. */
#define SQUARES_MEMORY(count) (MAX_SQUARES(count) + 1 + 2 * (count))

INLINE int64_t square_at(double position, double least, double side, int64_t count)
{
    const double place = (position - least) / side;
    return place > 0.0 ? (place < (double)count ? (int64_t)place : count - 1) : 0;
}

/* Sort `count` > 0 points into squares of at least `side`, in `memory` (SQUARES_MEMORY), which must outlive `out`. */
INLINE void fill_squares(const double *points, int64_t count, double side, int32_t *memory, squares_t *out)
{
    double left = points[0], right = left, top = points[1], bottom = top;
    for (int64_t i = 1; i < count; i++) {
        const double u = points[2 * i], v = points[2 * i + 1];
        left = u < left ? u : left;
        right = u > right ? u : right;
        top = v < top ? v : top;
        bottom = v > bottom ? v : bottom;
    }
    while (((right - left) / side + 1.0) * ((bottom - top) / side + 1.0) > (double)MAX_SQUARES(count))
        side *= 1.4;
    const int64_t columns = (int64_t)((right - left) / side) + 1, rows = (int64_t)((bottom - top) / side) + 1;
    const int64_t size = columns * rows;
    const squares_t squares = {points, memory, memory + size + 1, columns, rows, left, top, side};
    *out = squares;
    int32_t *first = squares.first, *order = squares.order, *square = order + count;
    memset(first, 0, (size_t)(size + 1) * sizeof(int32_t));
    for (int64_t i = 0; i < count; i++) {
        square[i] =
            (int32_t)(square_at(points[2 * i + 1], top, side, rows) * columns + square_at(points[2 * i], left, side, columns));
        first[square[i]]++;
    }
    /* The end of each square; filling it from there moves that to its start. */
    for (int64_t b = 1; b <= size; b++)
        first[b] += first[b - 1];
    for (int64_t i = count - 1; i >= 0; i--)
        order[--first[square[i]]] = (int32_t)i;
}

/* Return what `at` of the `values` are not above and the others not below; the values change places (Hoare's FIND). */
INLINE double ranked(double *values, int64_t count, int64_t at)
{
    int64_t low = 0, high = count - 1;
    while (low < high) {
        const double pivot = values[at];
        int64_t i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot)
                i++;
            while (pivot < values[j])
                j--;
            if (i <= j) {
                const double swap = values[i];
                values[i++] = values[j];
                values[j--] = swap;
            }
        }
        low = j < at ? i : low;
        high = at < i ? j : high;
    }
    return values[at];
}

INLINE double quick_median(double *values, int64_t count)
{
    return 0.5 * (ranked(values, count, (count - 1) / 2) + ranked(values, count, count / 2));
}

INLINE double limited(double x, double most)
{
    return x > most ? most : x < -most ? -most : x;
}

/* Add a residual `off` with its derivatives `row` to the lower triangle of `N` (n x n) and to `right`. */
INLINE void add_residual(double *N, double *right, const double *row, int n, double off)
{
    for (int i = 0; i < n; i++) {
        right[i] += row[i] * off;
        for (int j = 0; j <= i; j++)
            N[i * n + j] += row[i] * row[j];
    }
}

/* Return whether the lower triangle of the symmetric `N` (n x n) could be made its Cholesky factor. */
INLINE int cholesky(double *N, int n)
{
    for (int j = 0; j < n; j++) {
        double left = N[j * n + j];
        for (int k = 0; k < j; k++)
            left -= N[j * n + k] * N[j * n + k];
        if (!(left > 1e-12 * fabs(N[j * n + j])) || !(left > 0.0))
            return 0;
        N[j * n + j] = sqrt(left);
        for (int i = j + 1; i < n; i++) {
            double rest = N[i * n + j];
            for (int k = 0; k < j; k++)
                rest -= N[i * n + k] * N[j * n + k];
            N[i * n + j] = rest / N[j * n + j];
        }
    }
    return 1;
}

/* Set `x` to the solution of N x = `x`, `L` being what `cholesky` made of N. */
INLINE void cholesky_solve(const double *L, int n, double *x)
{
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++)
            x[i] -= L[i * n + k] * x[k];
        x[i] /= L[i * n + i];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++)
            x[i] -= L[k * n + i] * x[k];
        x[i] /= L[i * n + i];
    }
}

/* Return exp(y) for -80 <= y <= 0: 2^n times Taylor's series of the rest, relative error below 2e-7. */
INLINE float decay(float y)
{
    const int32_t n = (int32_t)(y * 1.44269504f - 0.5f);
    const float r = (y - (float)n * 0.693359375f) + (float)n * 2.12194440e-4f;
    const float series =
        1.0f + r * (1.0f + r * (0.5f + r * (1.0f / 6.0f + r * (1.0f / 24.0f + r * (1.0f / 120.0f + r * (1.0f / 720.0f))))));
    const int32_t bits = (n + 127) * (1 << 23);
    float power;
    memcpy(&power, &bits, sizeof power);
    return series * power;
}

/* reference.edge_model._blurred_edge, with the error function of Abramowitz and Stegun 7.1.26, right to 1.5e-7; `round` where
 * the fourth cumulant is 0. */
INLINE void any_edge(float x, const int round, float kurtosis, float out[5])
{
    const float square = x * x, gauss = decay(-0.5f * square);
    const float t = 1.0f / (1.0f + (0.3275911f * 0.70710678f) * fabsf(x));
    const float tail =
        t * (0.254829592f + t * (-0.284496736f + t * (1.421413741f + t * (-1.453152027f + t * 1.061405429f)))) * gauss;
    const float error = copysignf(1.0f - tail, x);
    const float density = 0.79788456f * gauss;
    out[3] = density * (square - 1.0f);
    if (round) {
        out[0] = error;
        out[1] = density;
        out[2] = -density * x;
        out[4] = x * density;
        return;
    }
    const float part = kurtosis * (1.0f / 24.0f), third = part * x * (square - 3.0f) * density;
    const float slope = density * (1.0f + part * (square * (square - 6.0f) + 3.0f));
    out[0] = error - third;
    out[1] = slope;
    out[2] = -density * x * (1.0f + part * (square * (square - 10.0f) + 15.0f));
    out[4] = x * slope - 4.0f * third;
}

INLINE void blurred_edge(float x, float kurtosis, float out[5])
{
    any_edge(x, 0, kurtosis, out);
}

/* Rows of corners are made so many at a time: they stay in the first cache. Of their products four rows by eight stay in
 * registers, so that rows are padded to a multiple of eight. */
enum { CORNERS = 32, ACROSS = 8, DOWN = 4 };

INLINE int64_t padded(int64_t across)
{
    return (across + ACROSS - 1) / ACROSS * ACROSS;
}

/* Add to the upper triangle of `sums` (across, across), by blocks, the products of `count` rows. */
INLINE void add_products(const double *rows, int64_t count, int64_t across, double *sums)
{
    for (int64_t i = 0; i < across; i += DOWN)
        for (int64_t j = i - i % ACROSS; j < across; j += ACROSS) {
            double block[DOWN][ACROSS] = {{0.0}};
            for (int64_t r = 0; r < count; r++) {
                const double *left = rows + r * across + i, *right = rows + r * across + j;
                for (int64_t a = 0; a < DOWN; a++)
#pragma omp simd
                    for (int64_t b = 0; b < ACROSS; b++)
                        block[a][b] += left[a] * right[b];
            }
            for (int64_t a = 0; a < DOWN; a++)
                for (int64_t b = 0; b < ACROSS; b++)
                    sums[(i + a) * across + j + b] += block[a][b];
        }
}

#endif
