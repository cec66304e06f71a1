/* The intersections of the rays of a tile's sub-samples with a plane, for painting.c: interpolated where the lens is smooth, ray
 * by ray at its rim. */
#ifndef RIGKIT_PLACES_H
#define RIGKIT_PLACES_H

#include "kernels.h"

/* Board coordinate of rays that miss a board's plane. */
#define FAR_SQUARES 1e4
/* Ratio of the smallest to the largest depth of a tile above which x and y on the plane are interpolated, not the rays: the error
 * is below 6 ** -TILE_NODES = 1e-7. */
#define SMOOTH_DEPTH_RATIO 0.5
/* Smallest depth of points in front of the camera. */
#define MIN_DEPTH 1e-9
/* Range of a cell's side, in squares or panel sides: it must not be 0, and a longer one means that the plane is seen edge-on, so
 * that differences between sub-samples are no derivatives. */
#define MIN_CELL 1e-6f
#define MAX_CELL 2.0f

/* A rectangle of a tile's sub-samples: its first row and column, and its size. */
typedef struct {
    int64_t top, left, rows, columns;
} box_t;

/* The coordinates x and y on the plane of the sub-samples of a box (`axes`), and for each of its pixels (`columns` / per_pixel in
 * a row) the longer and the shorter side of the cells and the smallest and largest coordinate of the sub-samples. */
typedef struct {
    box_t box;
    int64_t per_pixel;
    float *axes[2], *wide[2], *narrow[2], *least[2], *most[2];
} places_t;

/* Set the values at the nodes that are interpolated: x and y on the plane, or x, y and depth before the division; return the number
 * of these. */
static int set_node_values(const tile_t *tile, const double *matrix, double values[3][TILE_NODES * TILE_NODES])
{
    double nearest = INFINITY, farthest = -INFINITY;
    for (int n = 0; n < TILE_NODES * TILE_NODES; n++) {
        const double *ray = tile->nodes + 3 * n;
        for (int k = 0; k < 3; k++)
            values[k][n] = matrix[3 * k] * ray[0] + matrix[3 * k + 1] * ray[1] + matrix[3 * k + 2] * ray[2];
        nearest = values[2][n] < nearest ? values[2][n] : nearest;
        farthest = values[2][n] > farthest ? values[2][n] : farthest;
    }
    if (!(nearest > SMOOTH_DEPTH_RATIO * farthest))
        return 3;
    for (int n = 0; n < TILE_NODES * TILE_NODES; n++) {
        values[0][n] /= values[2][n];
        values[1][n] /= values[2][n];
    }
    return 2;
}

/* Set x and y on the plane of `count` sub-samples of one row, every `step`-th from `left` on. */
INLINE void set_row(
    const tile_t *tile, const double *matrix, const double values[3][TILE_NODES * TILE_NODES], int terms, int64_t row, int64_t left,
    int64_t step, int64_t count, double *restrict x, double *restrict y, double *restrict depth)
{
    if (tile->ray_rows) {
        const double *ray = tile->rays + 3 * (row * tile->columns + left);
        for (int64_t n = 0; n < count; n++, ray += 3 * step) {
            x[n] = matrix[0] * ray[0] + matrix[1] * ray[1] + matrix[2] * ray[2];
            y[n] = matrix[3] * ray[0] + matrix[4] * ray[1] + matrix[5] * ray[2];
            depth[n] = matrix[6] * ray[0] + matrix[7] * ray[1] + matrix[8] * ray[2];
        }
    } else {
        double *out[3] = {x, y, depth};
        const double *down = tile->weights_v + row * TILE_NODES;
        for (int k = 0; k < terms; k++) {
            double line[TILE_NODES] = {0.0};
            for (int i = 0; i < TILE_NODES; i++)
                for (int j = 0; j < TILE_NODES; j++)
                    line[j] += down[i] * values[k][i * TILE_NODES + j];
            const double *across = tile->weights_u + left;
            for (int64_t n = 0; n < count; n++) {
                double sum = 0.0;
                for (int j = 0; j < TILE_NODES; j++)
                    sum += line[j] * across[j * tile->columns + n * step];
                out[k][n] = sum;
            }
        }
        if (terms == 2)
            return;
    }
    for (int64_t n = 0; n < count; n++) {
        const int front = depth[n] > MIN_DEPTH;
        const double over = 1.0 / (front ? depth[n] : 1.0);
        x[n] = front ? x[n] * over : FAR_SQUARES;
        y[n] = front ? y[n] * over : FAR_SQUARES;
    }
}

/* Return the derivative by index k of `count` > 1 values: the central difference, one-sided at the ends. */
INLINE double difference(const double *value, int64_t k, int64_t count, int64_t stride)
{
    if (k == 0)
        return value[stride] - value[0];
    return k == count - 1 ? value[0] - value[-stride] : 0.5 * (value[stride] - value[-stride]);
}

/* Set `box` to the pixels whose sub-samples can be on the rectangle, with a margin of one pixel; return whether there are any.
 * `coarse` (2, height, width) are x and y of the first sub-sample of every pixel. */
static int set_box(const double *coarse, int64_t height, int64_t width, const surface_t *surface, int64_t per_pixel, box_t *box)
{
    int64_t top = height, bottom = -1, left = width, right = -1;
    for (int64_t v = 0; v < height; v++)
        for (int64_t u = 0; u < width; u++) {
            int near = 1;
            for (int k = 0; k < 2; k++) {
                const double *at = coarse + (k * height + v) * width + u;
                const double down = difference(at, v, height, width), across = difference(at, u, width, 1);
                /* A rectangle narrower than a pixel may lie between the samples: search a pixel further along each axis. */
                const double step = sqrt(down * down + across * across);
                near &= *at >= surface->ends[k] - step && *at <= surface->ends[2 + k] + step;
            }
            if (!near)
                continue;
            top = v < top ? v : top;
            bottom = v;
            left = u < left ? u : left;
            right = u > right ? u : right;
        }
    if (bottom < 0)
        return 0;
    top = top > 0 ? top - 1 : 0;
    left = left > 0 ? left - 1 : 0;
    bottom = bottom < height - 1 ? bottom + 1 : bottom;
    right = right < width - 1 ? right + 1 : right;
    *box = (box_t){top * per_pixel, left * per_pixel, (bottom - top + 1) * per_pixel, (right - left + 1) * per_pixel};
    return 1;
}

/* Set the sides of the cells of each pixel of the box from `coarse`. */
static void set_cells(const double *coarse, int64_t height, int64_t width, const places_t *places)
{
    const int64_t across = places->box.columns / places->per_pixel, down = places->box.rows / places->per_pixel;
    const int64_t top = places->box.top / places->per_pixel, left = places->box.left / places->per_pixel;
    for (int k = 0; k < 2; k++)
        for (int64_t i = 0; i < down; i++)
            for (int64_t j = 0; j < across; j++) {
                const int64_t v = top + i, u = left + j;
                const double *at = coarse + (k * height + v) * width + u;
                float one = (float)(fabs(difference(at, v, height, width)) / (double)places->per_pixel);
                float other = (float)(fabs(difference(at, u, width, 1)) / (double)places->per_pixel);
                one = one < MIN_CELL ? MIN_CELL : one > MAX_CELL ? MAX_CELL : one;
                other = other < MIN_CELL ? MIN_CELL : other > MAX_CELL ? MAX_CELL : other;
                places->wide[k][i * across + j] = one > other ? one : other;
                places->narrow[k][i * across + j] = one > other ? other : one;
            }
}

/* Set x and y of all sub-samples of the box, and their smallest and largest values in each pixel. */
INLINE void set_axes(const tile_t *tile, const double *matrix, const places_t *places, double *memory)
{
    const int64_t columns = places->box.columns, per_pixel = places->per_pixel, across = columns / per_pixel;
    double values[3][TILE_NODES * TILE_NODES];
    const int terms = tile->ray_rows ? 3 : set_node_values(tile, matrix, values);
    double *rows[3] = {memory, memory + columns, memory + 2 * columns};
    for (int64_t v = 0; v < places->box.rows; v++) {
        set_row(tile, matrix, values, terms, places->box.top + v, places->box.left, 1, columns, rows[0], rows[1], rows[2]);
        for (int k = 0; k < 2; k++) {
            float *axis = places->axes[k] + v * columns;
            for (int64_t u = 0; u < columns; u++)
                axis[u] = (float)rows[k][u];
            float *least = places->least[k] + v / per_pixel * across, *most = places->most[k] + v / per_pixel * across;
            for (int64_t q = 0; q < across; q++) {
                float low = v % per_pixel ? least[q] : axis[q * per_pixel], high = v % per_pixel ? most[q] : low;
                for (int64_t u = q * per_pixel; u < (q + 1) * per_pixel; u++) {
                    low = axis[u] < low ? axis[u] : low;
                    high = axis[u] > high ? axis[u] : high;
                }
                least[q] = low;
                most[q] = high;
            }
        }
    }
}

#endif
