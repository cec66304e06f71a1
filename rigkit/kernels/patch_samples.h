/* The samples of a patch, interpolated by cubic convolution (Catmull-Rom; Keys, "Cubic convolution interpolation for digital image
 * processing", 1981, with a = -1/2). */
#ifndef RIGKIT_PATCH_SAMPLES_H
#define RIGKIT_PATCH_SAMPLES_H

#include "patches.h"

typedef float four_t __attribute__((vector_size(16), aligned(4)));

/* Write the weights of four neighbours for the fraction t from the second to the third. */
#define CUBIC(t, w0, w1, w2, w3) \
    do { \
        (w0) = (t) * (-0.5f + (t) * (1.0f - 0.5f * (t))); \
        (w1) = 1.0f + (t) * (t) * (-2.5f + 1.5f * (t)); \
        (w2) = (t) * (0.5f + (t) * (2.0f - 1.5f * (t))); \
        (w3) = (t) * (t) * (-0.5f + 0.5f * (t)); \
    } while (0)

/* Read `image` at the `count` positions (u, v) + A (x, y), which are at least a pixel inside; count is a multiple of 16. */
INLINE void read_samples(
    const image_t image, float u, float v, const float A[4], const float *x, const float *y, int64_t count, float *out)
{
    int32_t at[MAX_SAMPLES];
    float across[4][MAX_SAMPLES], down[4][MAX_SAMPLES], sums[4 * MAX_SAMPLES];
    const int32_t width = (int32_t)image.width;
#pragma omp simd
    for (int64_t n = 0; n < count; n++) {
        const float place_u = u + A[0] * x[n] + A[1] * y[n], place_v = v + A[2] * x[n] + A[3] * y[n];
        const int32_t left = (int32_t)place_u, top = (int32_t)place_v;
        const float s = place_u - (float)left, t = place_v - (float)top;
        at[n] = (top - 1) * width + left - 1;
        CUBIC(s, across[0][n], across[1][n], across[2][n], across[3][n]);
        CUBIC(t, down[0][n], down[1][n], down[2][n], down[3][n]);
    }
    for (int64_t n = 0; n < count; n++) {
        const float *from = image.brightness + at[n];
        four_t row, sum;
        memcpy(&row, from, sizeof row);
        sum = down[0][n] * row;
        memcpy(&row, from + width, sizeof row);
        sum += down[1][n] * row;
        memcpy(&row, from + 2 * (ptrdiff_t)width, sizeof row);
        sum += down[2][n] * row;
        memcpy(&row, from + 3 * (ptrdiff_t)width, sizeof row);
        sum += down[3][n] * row;
        memcpy(sums + 4 * n, &sum, sizeof sum);
    }
#pragma omp simd
    for (int64_t n = 0; n < count; n++)
        out[n] = (across[0][n] * sums[4 * n] + across[1][n] * sums[4 * n + 1])
            + (across[2][n] * sums[4 * n + 2] + across[3][n] * sums[4 * n + 3]);
}

/* Read `image` at side x side positions a pixel apart from (u, v) on, at least a pixel inside. */
INLINE void read_square(const image_t image, float u, float v, int64_t side, float *out)
{
    enum { MAX_LINE = MAX_SIDE + 2 };
    const int32_t left = (int32_t)u, top = (int32_t)v;
    const float s = u - (float)left, t = v - (float)top;
    float across[4], down[4], lines[(MAX_LINE + 3) * MAX_LINE];
    CUBIC(s, across[0], across[1], across[2], across[3]);
    CUBIC(t, down[0], down[1], down[2], down[3]);
    for (int64_t j = 0; j < side + 3; j++) {
        const float *from = image.brightness + (ptrdiff_t)(top - 1 + j) * (ptrdiff_t)image.width + (left - 1);
        for (int64_t i = 0; i < side; i++)
            lines[j * side + i] = across[0] * from[i] + across[1] * from[i + 1] + across[2] * from[i + 2] + across[3] * from[i + 3];
    }
    for (int64_t j = 0; j < side; j++)
        for (int64_t i = 0; i < side; i++)
            out[j * side + i] = down[0] * lines[j * side + i] + down[1] * lines[(j + 1) * side + i]
                + down[2] * lines[(j + 2) * side + i] + down[3] * lines[(j + 3) * side + i];
}

/* Return whether cubic convolution at (u, v) reads pixels at least `margin` inside the image only. */
INLINE int is_inside(const image_t image, double u, double v, double margin)
{
    return u >= 1.0 + margin && v >= 1.0 + margin && u < (double)image.width - 2.0 - margin
        && v < (double)image.height - 2.0 - margin;
}

#endif
