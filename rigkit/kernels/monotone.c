/* Inverses of lens polynomials of a radius or an angle, point by point, and the range in which they increase (cameras.monotone). */
#include "monotone.h"

/* Width of an interval, relative to x, below which a polynomial that may touch zero there has a double root: rounding can split
 * it. */
#define TOUCHING 1e-8

enum { BISECTIONS = 32 };

INLINE double value_at(const double *p, int64_t terms, double x)
{
    double value = 0.0;
    for (int64_t k = terms - 1; k >= 0; k--)
        value = value * x + p[k];
    return value;
}

/* Set `b` to the Bernstein coefficients of p from `low` to `low` + `width`; return whether all are positive, and with them p. */
INLINE int positive(const double *p, int64_t terms, double low, double width, double *b)
{
    const int64_t n = terms - 1;
    memcpy(b, p, (size_t)terms * sizeof(double));
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = n - 1; k >= i; k--)
            b[k] += low * b[k + 1];
    double scale = 1.0;
    for (int64_t k = 1; k <= n; k++) {
        /* width^k over the binomial coefficient n over k. */
        scale *= width * (double)k / (double)(n - k + 1);
        b[k] *= scale;
    }
    for (int64_t i = 1; i <= n; i++)
        for (int64_t k = n; k >= i; k--)
            b[k] += b[k - 1];
    for (int64_t k = 0; k <= n; k++)
        if (!(b[k] > 0.0))
            return 0;
    return 1;
}

/* Return the smallest root in (0, 1] of p, which is positive at zero, or 1 where there is none. */
static double root_of(const double *p, int64_t terms, double *memory)
{
    double low = 0.0, width = 1.0;
    while (low < 1.0) {
        if (positive(p, terms, low, width, memory)) {
            low += width;
            width = 2.0 * width < 1.0 - low ? 2.0 * width : 1.0 - low;
        } else if (width > TOUCHING * (low + width)) {
            width *= 0.5;
        } else {
            double high = low + width;
            if (value_at(p, terms, high) > 0.0)
                return low;
            for (int64_t step = 0; step < BISECTIONS; step++) {
                const double middle = 0.5 * (low + high);
                if (value_at(p, terms, middle) > 0.0)
                    low = middle;
                else
                    high = middle;
            }
            return high;
        }
    }
    return 1.0;
}

EXPORT FOR_EACH_PROCESSOR double smallest_root(
    const double *polynomials, int64_t count, int64_t terms, double limit, double *memory)
{
    double least = 1.0, *scaled = memory + terms;
    for (int64_t i = 0; i < count; i++) {
        /* Scaled to x in (0, 1], where the coefficients of all powers are comparable. */
        const double *p = polynomials + i * terms;
        double power = 1.0;
        for (int64_t k = 0; k < terms; k++) {
            scaled[k] = p[k] * power / p[0];
            if (!isfinite(scaled[k]))
                return NAN;
            power *= limit;
        }
        const double root = root_of(scaled, terms, memory);
        least = root < least ? root : least;
    }
    return limit * least;
}

EXPORT FOR_EACH_PROCESSOR void invert_increasing(const increasing_t *g, double *out)
{
    for (int64_t first = 0; first < g->count; first += POINTS)
        invert(g, first, g->count - first < POINTS ? g->count - first : POINTS, out + first);
}
