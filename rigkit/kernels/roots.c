/* Real roots of a polynomial of degree ten, isolated by Sturm's theorem and refined by Newton's method. */
#include "roots.h"

/* A Sturm chain: coefficient d of polynomial i at [d][i], zero above its degree. */
typedef struct {
    double at[DEGREE + 1][12];
    int count;
} chain_t;

/* Set the Sturm chain of p, whose lowest coefficient comes first. */
INLINE void sturm_chain(const double *p, chain_t *chain)
{
    double poly[DEGREE + 2][DEGREE + 1];
    int degree[DEGREE + 2];
    memset(poly, 0, sizeof poly);
    memset(chain->at, 0, sizeof chain->at);
    memcpy(poly[0], p, sizeof(double) * (DEGREE + 1));
    degree[0] = DEGREE;
    while (degree[0] > 0 && poly[0][degree[0]] == 0.0)
        degree[0]--;
    for (int d = 1; d <= degree[0]; d++)
        poly[1][d - 1] = d * poly[0][d];
    degree[1] = degree[0] - 1;
    chain->count = degree[0] > 0 ? 2 : 1;
    while (degree[0] > 0 && degree[chain->count - 1] > 0) {
        const int i = chain->count;
        double *rest = poly[i];
        const double *divisor = poly[i - 1];
        memcpy(rest, poly[i - 2], sizeof poly[i]);
        for (int d = degree[i - 2]; d >= degree[i - 1]; d--) {
            const double factor = rest[d] / divisor[degree[i - 1]];
            for (int k = 0; k <= degree[i - 1]; k++)
                rest[d - degree[i - 1] + k] -= factor * divisor[k];
            rest[d] = 0.0;
        }
        double most = 0.0;
        for (int d = 0; d < degree[i - 1]; d++)
            most = fabs(rest[d]) > most ? fabs(rest[d]) : most;
        if (!(most > 1e-300))
            break;
        degree[i] = -1;
        for (int d = 0; d < degree[i - 1]; d++) {
            rest[d] = -rest[d] / most;
            /* A leading coefficient as small as rounding errors is 0: division by it would amplify them. */
            degree[i] = fabs(rest[d]) > 1e-13 ? d : degree[i];
        }
        for (int d = degree[i] + 1; d <= DEGREE; d++)
            rest[d] = 0.0;
        chain->count++;
    }
    for (int i = 0; i < chain->count; i++)
        for (int d = 0; d <= DEGREE; d++)
            chain->at[d][i] = poly[i][d];
}

/* Return the number of sign changes along the chain at x. */
INLINE int sign_changes(const chain_t *chain, double x)
{
    double value[12] = {0.0};
    for (int d = DEGREE; d >= 0; d--)
        for (int i = 0; i < 12; i++)
            value[i] = value[i] * x + chain->at[d][i];
    int changes = 0;
    double last = value[0];
    for (int i = 1; i < chain->count; i++) {
        if (value[i] == 0.0)
            continue;
        changes += (value[i] < 0.0) != (last < 0.0);
        last = value[i];
    }
    return changes;
}

/* Return the root of p between `low` and `high`, where p has different signs: Newton's method, bisection where it leaves the
 * bracket. */
INLINE double root_between(const double *p, double low, double high, int low_negative)
{
    double x = 0.5 * (low + high);
    for (int step = 0; step < 60; step++) {
        double value = p[DEGREE], slope = 0.0;
        for (int d = DEGREE - 1; d >= 0; d--) {
            slope = slope * x + value;
            value = value * x + p[d];
        }
        if (value == 0.0)
            return x;
        if ((value < 0.0) == low_negative)
            low = x;
        else
            high = x;
        double next = x - value / slope;
        if (!(next > low && next < high))
            next = 0.5 * (low + high);
        if (fabs(next - x) < 1e-13)
            return next;
        x = next;
    }
    return x;
}

INLINE double value_of(const double *p, double x)
{
    double value = p[DEGREE];
    for (int d = DEGREE - 1; d >= 0; d--)
        value = value * x + p[d];
    return value;
}

/* Append the roots of p in (-1, 1] to `roots`; return their new number. */
INLINE int roots_inside(const double *p, double *roots, int found)
{
    chain_t chain;
    sturm_chain(p, &chain);
    struct {
        double low, high;
        int at_low, at_high;
    } todo[64];
    int depth = 0;
    const int first = sign_changes(&chain, -1.0), last = sign_changes(&chain, 1.0);
    if (first > last) {
        todo[0].low = -1.0, todo[0].high = 1.0, todo[0].at_low = first, todo[0].at_high = last;
        depth = 1;
    }
    while (depth > 0 && found < MAX_ROOTS) {
        depth--;
        const double low = todo[depth].low, high = todo[depth].high, middle = 0.5 * (low + high);
        const int at_low = todo[depth].at_low, at_high = todo[depth].at_high;
        if (at_low - at_high == 1) {
            const double below = value_of(p, low), above = value_of(p, high);
            if ((below < 0.0) != (above < 0.0)) {
                roots[found++] = root_between(p, low, high, below < 0.0);
                continue;
            }
        }
        if (high - low < 1e-11) {
            /* A double root, up to rounding. */
            roots[found++] = middle;
            continue;
        }
        const int between = sign_changes(&chain, middle);
        if (between > at_high && depth < 63) {
            todo[depth].low = middle, todo[depth].high = high, todo[depth].at_low = between, todo[depth].at_high = at_high;
            depth++;
        }
        if (at_low > between && depth < 63) {
            todo[depth].low = low, todo[depth].high = middle, todo[depth].at_low = at_low, todo[depth].at_high = between;
            depth++;
        }
    }
    return found;
}

/* Set `roots` to the real roots of p and return their number: those in (-1, 1], and the others as inverses of such roots of the
 * reversed polynomial. */
FOR_EACH_PROCESSOR int real_roots(const double p[DEGREE + 1], double roots[MAX_ROOTS])
{
    double reversed[DEGREE + 1];
    for (int d = 0; d <= DEGREE; d++)
        reversed[d] = p[DEGREE - d];
    const int inside = roots_inside(p, roots, 0);
    const int all = roots_inside(reversed, roots, inside);
    int kept = inside;
    for (int i = inside; i < all; i++)
        if (fabs(roots[i]) > 1e-12)
            roots[kept++] = 1.0 / roots[i];
    return kept;
}
