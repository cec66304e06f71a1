/* A damped step of the normal equations of global parameters and poses: the poses are eliminated one by one (Schur complement), the
 * rest is solved by Cholesky factorisation (Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6.1).
 * tests/kernels/test_schur.py compares it with the dense system. */
#include "kernels.h"

INLINE double damped(double diagonal, double damping)
{
    return diagonal + damping * (diagonal > 0.0 ? diagonal : 1.0);
}

/* Replace the upper triangle of A (n x n, rows `across` apart) by its factor U with A = U' U, and `right` (n, columns) by U'^-1
 * `right`; return whether A is positive definite. */
INLINE int factored(double *A, int64_t n, int64_t across, double *right, int64_t columns)
{
    for (int64_t k = 0; k < n; k++) {
        double *row = A + k * across, *along = right + k * columns;
        if (!(row[k] > 0.0) || !(row[k] < INFINITY))
            return 0;
        const double scale = 1.0 / sqrt(row[k]);
        for (int64_t j = k; j < n; j++)
            row[j] *= scale;
        for (int64_t j = 0; j < columns; j++)
            along[j] *= scale;
        for (int64_t i = k + 1; i < n; i++) {
            const double factor = row[i];
            double *other = A + i * across, *there = right + i * columns;
            for (int64_t j = i; j < n; j++)
                other[j] -= factor * row[j];
            for (int64_t j = 0; j < columns; j++)
                there[j] -= factor * along[j];
        }
    }
    return 1;
}

/* Replace x by U^-1 x. */
INLINE void substituted(const double *U, int64_t n, int64_t across, double *x)
{
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t j = i + 1; j < n; j++)
            x[i] -= U[i * across + j] * x[j];
        x[i] /= U[i * across + i];
    }
}

int64_t schur_memory(int64_t globals, int64_t views)
{
    const int64_t across = padded(globals + 1);
    return across * across + views * POSE * (across + POSE);
}

EXPORT FOR_EACH_PROCESSOR int64_t
solve_schur(const normal_equations_t *n, double damping, double *memory, double *step_g, double *step_p, double *predicted)
{
    const int64_t G = n->globals, V = n->views, across = padded(G + 1), size = POSE * across;
    double *sums = memory, *rows = sums + across * across, *factors = rows + V * size;
    memset(memory, 0, (size_t)(across * across + V * size) * sizeof(double));
    for (int64_t v = 0; v < V; v++) {
        /* [pp | gp' p] is replaced by [U | Y]; gp pp^-1 [gp' p] = Y' Y. */
        double *U = factors + v * POSE * POSE, *Y = rows + v * size;
        memcpy(U, n->pp + v * POSE * POSE, POSE * POSE * sizeof(double));
        for (int64_t k = 0; k < POSE; k++) {
            U[k * POSE + k] = damped(U[k * POSE + k], damping);
            for (int64_t j = 0; j < G; j++)
                Y[k * across + j] = n->gp[(v * G + j) * POSE + k];
            Y[k * across + G] = n->p[v * POSE + k];
        }
        if (!factored(U, POSE, POSE, Y, across))
            return 0;
    }
    for (int64_t v = 0; v < V; v += CORNERS / POSE)
        add_products(rows + v * size, POSE * (V - v < CORNERS / POSE ? V - v : CORNERS / POSE), across, sums);
    for (int64_t i = 0; i < G; i++) {
        for (int64_t j = i; j < G; j++)
            sums[i * across + j] = n->gg[i * G + j] - sums[i * across + j];
        sums[i * across + i] += damped(n->gg[i * G + i], damping) - n->gg[i * G + i];
        step_g[i] = n->g[i] - sums[i * across + G];
    }
    if (!factored(sums, G, across, step_g, 1))
        return 0;
    substituted(sums, G, across, step_g);
    double gain = 0.0;
    for (int64_t i = 0; i < G; i++)
        gain += step_g[i] * ((damped(n->gg[i * G + i], damping) - n->gg[i * G + i]) * step_g[i] + n->g[i]);
    for (int64_t v = 0; v < V; v++) {
        double *step = step_p + v * POSE;
        for (int64_t k = 0; k < POSE; k++) {
            const double *Y = rows + v * size + k * across;
            step[k] = Y[G];
            for (int64_t j = 0; j < G; j++)
                step[k] -= Y[j] * step_g[j];
        }
        substituted(factors + v * POSE * POSE, POSE, POSE, step);
        for (int64_t k = 0; k < POSE; k++) {
            const double diagonal = n->pp[(v * POSE + k) * POSE + k];
            gain += step[k] * ((damped(diagonal, damping) - diagonal) * step[k] + n->p[v * POSE + k]);
        }
    }
    *predicted = gain;
    return isfinite(gain) != 0;
}
