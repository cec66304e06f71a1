/* The derivatives of the image of a whole chessboard by the nodes of its corners: the weights of nodes at places, derivatives node
 * by node in boxes of pixels, and their products. boards.c draws the image; checks are in tests/kernels/test_boards.py. */
#include "kernels.h"

enum { TAPS = 4, LANES = 16 };

/* -a of the cubic convolution kernel (Keys 1981), which approximates the spline that is 1 at a node and 0 at all others. */
#define CARDINAL 0.75

/* Set `out` to the interpolation weights, cubic or linear, of TAPS nodes at the position `at`, and return the first of these nodes.
 * Beyond the first and last node, up to a distance of `most`, the values are extrapolated from the outer three, or two. */
INLINE int64_t node_shares(double at, int64_t count, double most, int cubic, float out[TAPS])
{
    const double highest = (double)(count - 1) + most;
    at = -most > at ? -most : at > highest ? highest : at;
    const int64_t before = (int64_t)floor(at);
    const double t = at - (double)before, r = 1.0 - t;
    double weights[TAPS] = {0.0, r, t, 0.0};
    if (cubic) {
        weights[0] = -CARDINAL * t * r * r;
        weights[3] = -CARDINAL * r * t * t;
        weights[1] = ((2.0 - CARDINAL) * t - (3.0 - CARDINAL)) * t * t + 1.0;
        weights[2] = ((2.0 - CARDINAL) * r - (3.0 - CARDINAL)) * r * r + 1.0;
    }
    const int64_t last = count > TAPS ? count - TAPS : 0;
    const int64_t first = before - 1 < 0 ? 0 : before - 1 < last ? before - 1 : last;
    double sums[TAPS] = {0.0};
    for (int64_t k = 0; k < TAPS; k++) {
        const int64_t node = before - 1 + k;
        const int64_t further = node < 0 ? -node : node > count - 1 ? node - count + 1 : 0;
        const int64_t end = node < 0 ? 0 : count - 1, inwards = node < 0 ? 1 : -1;
        const double far = (double)further, part = weights[k];
        if (further && cubic) {
            sums[end - first] += 0.5 * (far + 1.0) * (far + 2.0) * part;
            sums[end + inwards - first] -= far * (far + 2.0) * part;
            sums[end + 2 * inwards - first] += 0.5 * far * (far + 1.0) * part;
        } else if (further) {
            sums[end - first] += (1.0 + far) * part;
            sums[end + inwards - first] -= far * part;
        } else {
            sums[node - first] += weights[k];
        }
    }
    for (int k = 0; k < TAPS; k++)
        out[k] = (float)sums[k];
    return first;
}

/* Set `nodes` and `weights` of the places of all pixels, and `boxes` to the pixels in which each node has a weight, with a margin;
 * empty boxes have no pixels (right -1). */
void board_shares(
    const double *places, int64_t width, int64_t height, int64_t rows, int64_t columns, double spacing, double most, int64_t cubic,
    int64_t margin, int32_t *nodes, float *weights, int64_t *boxes)
{
    for (int64_t n = 0; n < rows * columns; n++) {
        boxes[4 * n] = width;
        boxes[4 * n + 1] = height;
        boxes[4 * n + 2] = boxes[4 * n + 3] = -1;
    }
    for (int64_t v = 0; v < height; v++)
        for (int64_t u = 0; u < width; u++) {
            const int64_t k = v * width + u;
            float *along = weights + 2 * TAPS * k, *down = along + TAPS;
            memset(along, 0, 2 * TAPS * sizeof(float));
            nodes[2 * k] = nodes[2 * k + 1] = 0;
            if (!isfinite(places[2 * k]))
                continue;
            const int64_t i = node_shares(places[2 * k] / spacing, columns, most / spacing, (int)cubic, along);
            const int64_t j = node_shares(places[2 * k + 1] / spacing, rows, most / spacing, (int)cubic, down);
            nodes[2 * k] = (int32_t)i;
            nodes[2 * k + 1] = (int32_t)j;
            for (int64_t row = 0; row < TAPS; row++)
                for (int64_t column = 0; column < TAPS; column++) {
                    if (along[column] == 0.0f || down[row] == 0.0f)
                        continue;
                    int64_t *box = boxes + 4 * ((j + row) * columns + i + column);
                    box[0] = u < box[0] ? u : box[0];
                    box[1] = v < box[1] ? v : box[1];
                    box[2] = u > box[2] ? u : box[2];
                    box[3] = v > box[3] ? v : box[3];
                }
        }
    for (int64_t n = 0; n < rows * columns; n++) {
        int64_t *box = boxes + 4 * n;
        if (box[2] < box[0]) {
            box[0] = box[1] = 0;
            box[2] = box[3] = -1;
            continue;
        }
        box[0] = box[0] > margin ? box[0] - margin : 0;
        box[1] = box[1] > margin ? box[1] - margin : 0;
        box[2] = box[2] + margin < width ? box[2] + margin : width - 1;
        box[3] = box[3] + margin < height ? box[3] + margin : height - 1;
    }
}

/* Set `out` to the weights of node (i, j) in the pixels of the box, row by row. */
INLINE void shares(
    const int32_t *nodes, const float *weights, int64_t width, const int64_t box[4], int64_t i, int64_t j, float *out)
{
    for (int64_t v = box[1]; v <= box[3]; v++)
        for (int64_t u = box[0]; u <= box[2]; u++, out++) {
            const int64_t k = v * width + u, column = i - nodes[2 * k], row = j - nodes[2 * k + 1];
            const int there = column >= 0 && column < TAPS && row >= 0 && row < TAPS;
            *out = there ? weights[2 * TAPS * k + column] * weights[2 * TAPS * k + TAPS + row] : 0.0f;
        }
}

/* Set `out` to `count` sets of node values interpolated at the pixels. */
void board_values(
    const int32_t *nodes, const float *weights, int64_t width, int64_t height, int64_t rows, int64_t columns, const double *values,
    int64_t count, float *out)
{
    const int64_t area = width * height;
    for (int64_t k = 0; k < area; k++) {
        const float *along = weights + 2 * TAPS * k, *down = along + TAPS;
        for (int64_t n = 0; n < count; n++) {
            float sum = 0.0f;
            for (int64_t j = 0; j < TAPS; j++)
                for (int64_t i = 0; i < TAPS; i++)
                    if (along[i] != 0.0f && down[j] != 0.0f)
                        sum += along[i] * down[j] * (float)values[(n * rows + nodes[2 * k + 1] + j) * columns + nodes[2 * k] + i];
            out[n * area + k] = sum;
        }
    }
}

/* Blur `wide` x `high` values of `from` into `to`; values outside are 0. */
FOR_EACH_PROCESSOR
static void blur_box(const float *from, int64_t wide, int64_t high, const float *taps, int64_t radius, float *between, float *to)
{
    for (int64_t v = 0; v < high; v++) {
        float *row = between + v * wide;
        memset(row, 0, (size_t)wide * sizeof(float));
        for (int64_t down = -radius; down <= radius; down++) {
            if (v + down < 0 || v + down >= high)
                continue;
            const float tap = taps[down + radius], *beside = from + (v + down) * wide;
            for (int64_t u = 0; u < wide; u++)
                row[u] += tap * beside[u];
        }
    }
    for (int64_t v = 0; v < high; v++) {
        float *row = to + v * wide;
        memset(row, 0, (size_t)wide * sizeof(float));
        for (int64_t over = -radius; over <= radius; over++) {
            const int64_t first = over < 0 ? -over : 0, last = over > 0 ? wide - over : wide;
            const float tap = taps[over + radius], *beside = between + v * wide + over;
            for (int64_t u = first; u < last; u++)
                row[u] += tap * beside[u];
        }
    }
}

/* Set the derivatives of the image by both coordinates of each node, in its box: minus its weight times the gradient, blurred with
 * `taps` and multiplied by the pixels' `weight`. */
void move_blocks(
    const int32_t *nodes, const float *weights, int64_t width, int64_t height, int64_t rows, int64_t columns, const float *gradient,
    const float *weight, const float *taps, int64_t radius, const int64_t *boxes, const int64_t *starts, int64_t room,
    float *scratch, int64_t size, float *data)
{
    (void)size;
    float *share = scratch, *sharp = scratch + room, *between = scratch + 2 * room;
    for (int64_t n = 0; n < rows * columns; n++) {
        const int64_t *box = boxes + 4 * n, wide = box[2] - box[0] + 1, high = box[3] - box[1] + 1;
        if (wide <= 0)
            continue;
        shares(nodes, weights, width, box, n % columns, n / columns, share);
        for (int axis = 0; axis < 2; axis++) {
            float *to = data + starts[n] + axis * wide * high;
            const float *slope = gradient + axis * width * height;
            for (int64_t v = 0; v < high; v++) {
                const float *row = slope + (v + box[1]) * width + box[0];
                for (int64_t u = 0; u < wide; u++)
                    sharp[v * wide + u] = -share[v * wide + u] * row[u];
            }
            blur_box(sharp, wide, high, taps, radius, between, to);
            for (int64_t v = 0; v < high; v++) {
                const float *row = weight + (v + box[1]) * width + box[0];
                for (int64_t u = 0; u < wide; u++)
                    to[v * wide + u] *= row[u];
            }
        }
    }
}

/* Set `wide_by` blocks for each node, in its box: its weight times each of the `planes`. */
void share_blocks(
    const int32_t *nodes, const float *weights, int64_t width, int64_t height, int64_t rows, int64_t columns, const float *planes,
    int64_t wide_by, const int64_t *boxes, const int64_t *starts, int64_t room, float *scratch, int64_t size, float *data)
{
    (void)size;
    for (int64_t n = 0; n < rows * columns; n++) {
        const int64_t *box = boxes + 4 * n, wide = box[2] - box[0] + 1, high = box[3] - box[1] + 1;
        if (wide <= 0)
            continue;
        shares(nodes, weights, width, box, n % columns, n / columns, scratch);
        for (int64_t plane = 0; plane < wide_by; plane++)
            for (int64_t v = 0; v < high; v++) {
                const float *row = planes + (plane * height + v + box[1]) * width + box[0];
                float *to = data + starts[n] + (plane * high + v) * wide;
                for (int64_t u = 0; u < wide; u++)
                    to[u] = scratch[v * wide + u] * row[u];
            }
    }
    (void)room;
}

/* Return the sum of the products of two boxes of `high` rows of `wide` values, with the row strides `next_a` and `next_b`. */
INLINE double box_product(const float *a, int64_t next_a, const float *b, int64_t next_b, int64_t wide, int64_t high)
{
    float sums[LANES] = {0.0f};
    double total = 0.0;
    for (int64_t v = 0; v < high; v++, a += next_a, b += next_b) {
        int64_t k = 0;
        for (; k + LANES <= wide; k += LANES)
            for (int lane = 0; lane < LANES; lane++)
                sums[lane] += a[k + lane] * b[k + lane];
        float rest = 0.0f;
        for (; k < wide; k++)
            rest += a[k] * b[k];
        total += (double)rest;
    }
    for (int lane = 0; lane < LANES; lane++)
        total += (double)sums[lane];
    return total;
}

/* Set `N` and `right` to the products of all blocks with each other and with the residuals `rest`. */
FOR_EACH_PROCESSOR
void block_products(
    const int64_t *boxes, const int64_t *starts, const int64_t *wide_by, const int64_t *first, int64_t count, int64_t size,
    const float *data, const float *rest, int64_t width, int64_t height, int64_t unknowns, double *N, double *right)
{
    (void)size;
    (void)height;
    memset(N, 0, (size_t)(unknowns * unknowns) * sizeof(double));
    memset(right, 0, (size_t)unknowns * sizeof(double));
    for (int64_t n = 0; n < count; n++) {
        const int64_t *a = boxes + 4 * n, wide_a = a[2] - a[0] + 1, high_a = a[3] - a[1] + 1;
        for (int64_t p = 0; p < wide_by[n]; p++)
            right[first[n] + p] =
                box_product(data + starts[n] + p * high_a * wide_a, wide_a, rest + a[1] * width + a[0], width, wide_a, high_a);
        for (int64_t m = 0; m <= n; m++) {
            const int64_t *b = boxes + 4 * m, wide_b = b[2] - b[0] + 1, high_b = b[3] - b[1] + 1;
            const int64_t left = a[0] > b[0] ? a[0] : b[0], end = a[2] < b[2] ? a[2] : b[2];
            const int64_t top = a[1] > b[1] ? a[1] : b[1], bottom = a[3] < b[3] ? a[3] : b[3];
            if (end < left || bottom < top)
                continue;
            for (int64_t p = 0; p < wide_by[n]; p++)
                for (int64_t q = 0; q < wide_by[m]; q++) {
                    const double sum = box_product(
                        data + starts[n] + (p * high_a + top - a[1]) * wide_a + left - a[0], wide_a,
                        data + starts[m] + (q * high_b + top - b[1]) * wide_b + left - b[0], wide_b, end - left + 1,
                        bottom - top + 1);
                    N[(first[n] + p) * unknowns + first[m] + q] = N[(first[m] + q) * unknowns + first[n] + p] = sum;
                }
        }
    }
}
