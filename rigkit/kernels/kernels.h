/* Conventions of the kernels: C-contiguous arrays, sizes as int64_t, images row by row as float (0..255), pixel (0, 0) the
 * centre of the top-left pixel. Kernels do not check their arguments: the Python callers guarantee types, shapes and sizes. */
#ifndef RIGKIT_KERNELS_H
#define RIGKIT_KERNELS_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "api.h"

/* For hot functions: compile them for these instruction sets as well; one is chosen when the library is loaded. Levels of
 * instruction sets, as "arch=haswell" would be chosen on Haswell processors alone. */
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

/* For small functions called in hot loops: these are vectorised only if the functions are inlined. */
#define INLINE static inline __attribute__((always_inline, unused))

/* Return the grey level at pixel `at` (row * width + column) of an image of bytes, or of float. */
INLINE double level_at(const void *grey, int64_t bytes, int64_t at)
{
    return bytes ? (double)((const uint8_t *)grey)[at] : (double)((const float *)grey)[at];
}

/* An image of bytes, or of float, as `level_at` reads it. */
typedef struct {
    const void *brightness;
    int64_t width, height, bytes;
} picture_t;

/* Return `image` at (u, v), interpolated bilinearly, the border repeated (detection.saddles.response.sample). */
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

/* Return the grey level at (u, v), interpolated bilinearly, the border repeated; 0 if u or v is not finite. */
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

/* Return whether the image has an edge from (u, v) to (end_u, end_v): at `min_places` or more of `places` fractions `along` it,
 * the bright side is brighter than the dark side by more than `weakest`, `offset` px from the edge. The bright side is at +90
 * degrees (from u to v) of the direction from start to end if `sign` is +1 (reference.links.edge_contrast). */
INLINE int edge_seen(
    const image_t image, const double *along, int64_t places, int64_t min_places, double u, double v, double end_u, double end_v,
    double sign, double offset, double weakest)
{
    const double chord_u = end_u - u, chord_v = end_v - v;
    double length = sqrt(chord_u * chord_u + chord_v * chord_v);
    length = length > 1e-9 ? length : 1e-9;
    const double normal_u = -sign * offset * chord_v / length, normal_v = sign * offset * chord_u / length;
    /* Most candidates that are no edge fail at the first places. */
    int64_t unseen = 0;
    for (int64_t k = 0; k < places && unseen <= places - min_places; k++) {
        const double at_u = u + along[k] * chord_u, at_v = v + along[k] * chord_v;
        const float bright = brightness_at(image, (float)(at_u + normal_u), (float)(at_v + normal_v));
        const float dark = brightness_at(image, (float)(at_u - normal_u), (float)(at_v - normal_v));
        unseen += !((double)(bright - dark) > weakest);
    }
    return unseen <= places - min_places;
}

/* Largest number of squares for `count` points: a search visits more squares if they are smaller, and more distant points if
 * they are larger. */
#define MAX_SQUARES(count) ((count) / 2 + 8)

/* Number of int32_t that `fill_squares` needs. */
#define SQUARES_MEMORY(count) (MAX_SQUARES(count) + 1 + 2 * (count))

/* Return the row or column of squares, of `count`, that `position` is in; the first or last for positions outside. */
INLINE int64_t square_at(double position, double least, double side, int64_t count)
{
    const double place = (position - least) / side;
    return place > 0.0 ? (place < (double)count ? (int64_t)place : count - 1) : 0;
}

/* Sort `count` > 0 finite points into a grid of squares with sides of `side` > 0 or more, in `memory` (SQUARES_MEMORY), which
 * must outlive `out`. */
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
    /* `first` holds the end of each square's points; filling them in from the end moves it to their start. */
    for (int64_t b = 1; b <= size; b++)
        first[b] += first[b - 1];
    for (int64_t i = count - 1; i >= 0; i--)
        order[--first[square[i]]] = (int32_t)i;
}

/* Define a function that returns the value of rank `at`, from 0, of `count` > 0 values, which it reorders (quickselect: Hoare,
 * "Algorithm 65: Find", CACM 4, 1961). */
#define DEFINE_RANKED(name, number) \
    INLINE number name(number *values, int64_t count, int64_t at) \
    { \
        int64_t low = 0, high = count - 1; \
        while (low < high) { \
            const number pivot = values[at]; \
            int64_t i = low, j = high; \
            while (i <= j) { \
                while (values[i] < pivot) \
                    i++; \
                while (pivot < values[j]) \
                    j--; \
                if (i <= j) { \
                    const number swap = values[i]; \
                    values[i++] = values[j]; \
                    values[j--] = swap; \
                } \
            } \
            low = j < at ? i : low; \
            high = at < i ? j : high; \
        } \
        return values[at]; \
    }

DEFINE_RANKED(ranked, double)
DEFINE_RANKED(ranked_float, float)

/* Return the median of `count` > 0 values, which are reordered: the mean of the middle two of an even number. */
INLINE double quick_median(double *values, int64_t count)
{
    return 0.5 * (ranked(values, count, (count - 1) / 2) + ranked(values, count, count / 2));
}

/* Return x clipped to -most ... most; NaN stays NaN. */
INLINE double limited(double x, double most)
{
    return x > most ? most : x < -most ? -most : x;
}

/* Replace the lower triangle of the symmetric `N` (n x n) by its Cholesky factor; return whether N is positive definite. */
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

/* Replace `x` by the solution of N y = x, from the factor `L` of N (`cholesky`). */
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

/* Return exp(y) for -80 <= y <= 0: 2^n times the Taylor series of the remainder, relative error below 2e-7. */
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

/* Set `out` to a blurred edge at the distance x over the blur s: the step S from -1 to 1, its first to third derivatives by x,
 * and -s dS/ds (reference.edge_model._blurred_edge). `kurtosis` is the fourth cumulant of the blur over s^4, not used if `normal`.
 * The error function is Abramowitz and Stegun's 7.1.26, with an absolute error below 1.5e-7. */
INLINE void any_edge(float x, const int normal, float kurtosis, float out[5])
{
    const float square = x * x, gauss = decay(-0.5f * square);
    const float t = 1.0f / (1.0f + (0.3275911f * 0.70710678f) * fabsf(x));
    const float tail =
        t * (0.254829592f + t * (-0.284496736f + t * (1.421413741f + t * (-1.453152027f + t * 1.061405429f)))) * gauss;
    const float error = copysignf(1.0f - tail, x);
    const float density = 0.79788456f * gauss;
    out[3] = density * (square - 1.0f);
    if (normal) {
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

/* Rows are made for CORNERS corners at a time, which fit the first-level cache. DOWN x ACROSS sums of their products are kept
 * in registers, so that rows are padded to a multiple of ACROSS. */
enum { CORNERS = 32, ACROSS = 8, DOWN = 4 };

/* Return the length of rows of `across` numbers with their padding. */
INLINE int64_t padded(int64_t across)
{
    return (across + ACROSS - 1) / ACROSS * ACROSS;
}

/* Add J^T J to `sums` (across, across), upper triangle by blocks; J are the `rows` (count, across), `across` padded. */
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
