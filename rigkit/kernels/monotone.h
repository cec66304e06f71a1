/* Inverses of increasing functions with a polynomial term, by Newton's method for all points of a block at a time. */
#ifndef RIGKIT_KERNELS_MONOTONE_H
#define RIGKIT_KERNELS_MONOTONE_H

#include "kernels.h"

enum {
    /* Points at a time: their numbers fit the first-level cache. */
    POINTS = 64,
    /* Largest number of Newton steps from the table for all points, of which nearly all converge in two. The others are bracketed;
     * MAX_BISECTIONS bisections alone reach double precision. */
    QUICK_STEPS = 3,
    MAX_BISECTIONS = 60
};

/* Newton's method converges quadratically: a step this small, relative to the range, leaves double precision. */
#define LAST_STEP_REL 1e-9
/* Smallest step of a bracketed point, relative to its bracket. */
#define RELATIVE_STEP 1e-14

/* Write g(x) = linear x + factor P(x) - offset and its derivative. */
INLINE void evaluate(const increasing_t *g, int64_t first, int64_t count, const double *x, double *residual, double *slope)
{
    const double *linear = g->linear + first, *factor = g->factor + first, *offset = g->offset + first;
    for (int64_t i = 0; i < count; i++)
        residual[i] = slope[i] = 0.0;
    for (int64_t k = g->terms - 1; k >= 0; k--) {
        const double a = g->polynomial[k];
#pragma omp simd
        for (int64_t i = 0; i < count; i++) {
            slope[i] = slope[i] * x[i] + residual[i];
            residual[i] = residual[i] * x[i] + a;
        }
    }
#pragma omp simd
    for (int64_t i = 0; i < count; i++) {
        slope[i] = linear[i] + factor[i] * slope[i];
        residual[i] = linear[i] * x[i] + factor[i] * residual[i] - offset[i];
    }
}

/* Return the root of function `n` between `low` and `high`: Newton's method from x, bisection where it leaves the bracket. */
INLINE double bracketed(const increasing_t *g, int64_t n, double x, double low, double high)
{
    const double least = RELATIVE_STEP * (high - low);
    /* NaN (a slope of zero) must not be the start. */
    double at = isfinite(x) ? x : 0.5 * (low + high);
    for (int64_t step = 0; step < MAX_BISECTIONS; step++) {
        double residual, slope;
        evaluate(g, n, 1, &at, &residual, &slope);
        if (residual > 0.0)
            high = at;
        else
            low = at;
        double next = at - residual / slope;
        if (!(next >= low && next <= high))
            next = 0.5 * (low + high);
        const double moved = fabs(next - at);
        at = next;
        if (!(moved > least))
            break;
    }
    return at;
}

/* Write the roots of `count` <= POINTS functions from `first` on to `x`. */
INLINE void invert(const increasing_t *g, int64_t first, int64_t count, double *x)
{
    const double range = g->high - g->low, per_cell = (double)g->cells / (g->last - g->first);
    double residual[POINTS], slope[POINTS];
    uint8_t done[POINTS];
    for (int64_t i = 0; i < count; i++) {
        const double place = (g->target[first + i] - g->first) * per_cell;
        int64_t cell = place > 0.0 ? (int64_t)place : 0;
        cell = cell < g->cells - 1 ? cell : g->cells - 1;
        x[i] = g->table[cell] + (place - (double)cell) * (g->table[cell + 1] - g->table[cell]);
    }
    int64_t left = count;
    for (int64_t step = 0; step < QUICK_STEPS && (left || step < 2); step++) {
        evaluate(g, first, count, x, residual, slope);
        left = 0;
        for (int64_t i = 0; i < count; i++) {
            const double move = residual[i] / slope[i], to = x[i] - move;
            done[i] = fabs(move) <= LAST_STEP_REL * range;
            left += !done[i];
            x[i] = to < g->low ? g->low : to > g->high ? g->high : to;
        }
    }
    for (int64_t i = 0; i < count; i++)
        if (!done[i])
            x[i] = bracketed(g, first + i, x[i], g->low, g->high);
}

#endif
