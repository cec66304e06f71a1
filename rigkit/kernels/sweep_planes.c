/* Robust fits of planes to the surface of a sweep, over the samples around that are as bright. The definition in numpy is in
 * tests/kernels/reference/sweep.py. */
#include "kernels.h"

/* Scale of the robust loss in the first round, in levels: it is halved from round to round, down to one level. */
#define WIDEST_LOSS 4.0f

enum { ROUNDS = 4, BRIGHTNESS_STEPS = 128, STEPS_OF_ALIKE = 16, FIT_LISTS = 4 };

int64_t level_fit_memory(int64_t reach)
{
    return (FIT_LISTS + 1) * (2 * reach + 1) * (2 * reach + 1);
}

/* The samples of one fit: weights, levels above that of the middle, and rows and columns from it. */
typedef struct {
    int64_t count;
    float *weight, *level, *row, *column;
} fit_samples_t;

/* Sums of a round, with the weights of the robust loss: the upper triangle of the normal matrix, the right side, and weighted
 * squares. */
typedef struct {
    float one, r, c, rr, rc, cc, z, zr, zc, squares;
} fit_sums_t;

INLINE fit_sums_t sum_up(const fit_samples_t *s, const float plane[3], float loss)
{
    const float a = plane[0], b = plane[1], d = plane[2], narrow = 1.0f / (loss * loss);
    float one = 0.0f, r = 0.0f, c = 0.0f, rr = 0.0f, rc = 0.0f, cc = 0.0f, z = 0.0f, zr = 0.0f, zc = 0.0f, squares = 0.0f;
#pragma omp simd reduction(+ : one, r, c, rr, rc, cc, z, zr, zc, squares)
    for (int64_t k = 0; k < s->count; k++) {
        const float y = s->row[k], x = s->column[k], level = s->level[k], off = level - a - b * y - d * x;
        const float part = 1.0f / (1.0f + narrow * off * off), w = s->weight[k] * part * part;
        one += w;
        r += w * y;
        c += w * x;
        rr += w * y * y;
        rc += w * y * x;
        cc += w * x * x;
        z += w * level;
        zr += w * level * y;
        zc += w * level * x;
        squares += w * off * off;
    }
    return (fit_sums_t){one, r, c, rr, rc, cc, z, zr, zc, squares};
}

/* Solve the normal equations; a flat surface is assumed as weakly as a hundredth of a sample one step away says so. */
INLINE void solve_level_plane(const fit_sums_t *s, float plane[3])
{
    const double n00 = s->one + 1e-6, n11 = s->rr + 1e-2, n22 = s->cc + 1e-2;
    const double c00 = n11 * n22 - (double)s->rc * s->rc, c01 = (double)s->rc * s->c - n22 * s->r;
    const double c02 = (double)s->r * s->rc - n11 * s->c, c11 = n00 * n22 - (double)s->c * s->c;
    const double c12 = (double)s->r * s->c - n00 * s->rc, c22 = n00 * n11 - (double)s->r * s->r;
    const double part = 1.0 / (n00 * c00 + s->r * c01 + s->c * c02);
    plane[0] = (float)(part * (c00 * s->z + c01 * s->zr + c02 * s->zc));
    plane[1] = (float)(part * (c01 * s->z + c11 * s->zr + c12 * s->zc));
    plane[2] = (float)(part * (c02 * s->z + c12 * s->zr + c22 * s->zc));
}

/* List the known samples around (row, column) and return the sum of their weights. */
INLINE float list_samples(
    const level_grid_t *grid, int64_t row, int64_t column, const float *near, const float *faint, fit_samples_t *out)
{
    const int64_t reach = grid->reach, side = 2 * reach + 1, columns = grid->columns;
    const float here = grid->brightness[row * columns + column], steps = (float)STEPS_OF_ALIKE / (float)grid->alike;
    const double own = grid->winners[row * columns + column];
    float weights = 0.0f;
    out->count = 0;
    for (int64_t j = row < reach ? -row : -reach; j <= reach && row + j < grid->rows; j++)
        for (int64_t i = column < reach ? -column : -reach; i <= reach && column + i < columns; i++) {
            const int64_t at = (row + j) * columns + column + i;
            const float unlike = steps * fabsf(grid->brightness[at] - here);
            if (!grid->seen[at] || !(unlike < (float)BRIGHTNESS_STEPS))
                continue;
            const float weight = near[(j + reach) * side + i + reach] * faint[(int64_t)unlike];
            out->weight[out->count] = weight;
            out->level[out->count] = (float)(grid->winners[at] - own);
            out->row[out->count] = (float)j;
            out->column[out->count] = (float)i;
            out->count++;
            weights += weight;
        }
    return weights;
}

FOR_EACH_PROCESSOR void fit_level_planes(
    const level_grid_t *grid, float *memory, double *planes, double *normals, double *agreement)
{
    const int64_t reach = grid->reach, side = 2 * reach + 1;
    float faint[BRIGHTNESS_STEPS], *near = memory + FIT_LISTS * side * side;
    for (int64_t k = 0; k < BRIGHTNESS_STEPS; k++)
        faint[k] = expf(-(float)k / (float)STEPS_OF_ALIKE);
    for (int64_t k = 0; k < side * side; k++) {
        const double j = (double)(k / side - reach), i = (double)(k % side - reach);
        near[k] = (float)exp(-0.5 * (j * j + i * i) / (grid->radius * grid->radius));
    }
    fit_samples_t around = {0, memory, memory + side * side, memory + 2 * side * side, memory + 3 * side * side};
    for (int64_t n = 0; n < grid->count; n++) {
        const int64_t row = grid->samples[2 * n], column = grid->samples[2 * n + 1];
        const float weights = list_samples(grid, row, column, near, faint, &around);
        float plane[3] = {0.0f, 0.0f, 0.0f}, loss = WIDEST_LOSS;
        for (int64_t round = 0; round < ROUNDS; round++, loss = loss > 2.0f ? 0.5f * loss : 1.0f) {
            const fit_sums_t sums = sum_up(&around, plane, loss);
            solve_level_plane(&sums, plane);
        }
        const fit_sums_t last = sum_up(&around, plane, 1.0f);
        double *N = normals + 9 * n;
        planes[3 * n] = grid->winners[row * grid->columns + column] + plane[0];
        planes[3 * n + 1] = plane[1];
        planes[3 * n + 2] = plane[2];
        N[0] = last.one + 1e-6;
        N[4] = last.rr + 1e-2;
        N[8] = last.cc + 1e-2;
        N[1] = N[3] = last.r;
        N[2] = N[6] = last.c;
        N[5] = N[7] = last.rc;
        agreement[2 * n] = weights > 0.0f ? last.one / weights : 0.0;
        agreement[2 * n + 1] = last.one > 0.0f ? last.squares / last.one : 0.0;
    }
}
