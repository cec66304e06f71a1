/* Inverting increasing functions that a polynomial makes: Newton's method, all points of a block at a time. */
#ifndef RIGKIT_KERNELS_MONOTONE_H
#define RIGKIT_KERNELS_MONOTONE_H

#include "kernels.h"

enum {
    /* Points at a time: their polynomials stay in the first cache. */
    POINTS = 64,
    /* Newton steps from the table for all points; nearly all are done after two. The rest is bracketed: bisection alone
     * reaches double precision in so many. */
    QUICK_STEPS = 3,
    MAX_BISECTIONS = 60
};

/* Newton doubles the digits at each step: after one this small, as a share of the range, all are right. */
#define LAST_STEP_REL 1e-9
#define RELATIVE_STEP 1e-14

/* Write g(x) = linear x + factor P(x) - offset, which increases, and its slope. */
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

/* Return the root number `n` between `low` and `high`, from x: Newton kept inside the bracket. */
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

/* Write the roots of `count` <= POINTS of the functions, from the `first` on, to `x`. */
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
