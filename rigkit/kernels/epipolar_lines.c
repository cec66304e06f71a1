/* Epipolar constraints on the position and the affinity of a pair of patches, for two cameras of any kind (Raposo and
 * Barreto, "Theory and practice of structure-from-motion using affine correspondences", 2016). */
#include "patch_samples.h"

/* Set the ray of image 2 at a pixel, by cubic convolution, and its derivatives by u and v; return 0 outside the field of view. */
INLINE int ray_at(const epipolar_t *g, double u, double v, double ray[3], double by_u[3], double by_v[3])
{
    const double x = u / g->spacing, y = v / g->spacing;
    if (!(x >= 1.0 && y >= 1.0 && x < (double)g->columns - 2.0 && y < (double)g->rows - 2.0))
        return 0;
    const int64_t left = (int64_t)x, top = (int64_t)y;
    double across[2][4], down[2][4];
    for (int64_t way = 0; way < 2; way++) {
        const double t = way ? y - (double)top : x - (double)left;
        double (*w)[4] = way ? down : across;
        CUBIC(t, w[0][0], w[0][1], w[0][2], w[0][3]);
        w[1][0] = -0.5 + t * (2.0 - 1.5 * t);
        w[1][1] = t * (-5.0 + 4.5 * t);
        w[1][2] = 0.5 + t * (4.0 - 4.5 * t);
        w[1][3] = t * (-1.0 + 1.5 * t);
    }
    for (int64_t n = 0; n < 3; n++)
        ray[n] = by_u[n] = by_v[n] = 0.0;
    for (int64_t j = 0; j < 4; j++) {
        for (int64_t i = 0; i < 4; i++) {
            const double *at = g->rays2 + 3 * ((top - 1 + j) * g->columns + left - 1 + i);
            for (int64_t n = 0; n < 3; n++) {
                ray[n] += down[0][j] * across[0][i] * at[n];
                by_u[n] += down[0][j] * across[1][i] * at[n];
                by_v[n] += down[1][j] * across[0][i] * at[n];
            }
        }
    }
    for (int64_t n = 0; n < 3; n++) {
        by_u[n] /= g->spacing;
        by_v[n] /= g->spacing;
    }
    return isfinite(ray[0]) && isfinite(ray[1]) && isfinite(ray[2]);
}

/* Set the unit normal n2 of a pair's epipolar line in image 2, its distance from the line, px, and the residual of its affinity,
 * n2^T A + n1 / |n2|; return 0 if there is no line. */
FOR_EACH_PROCESSOR int miss(const line_t *line, const place_t *at, double n2[2], double *distance, double off[2])
{
    double ray[3], by_u[3], by_v[3];
    if (!ray_at(line->geometry, at->u2, at->v2, ray, by_u, by_v))
        return 0;
    double c = 0.0, n1[2] = {0.0, 0.0};
    n2[0] = n2[1] = 0.0;
    for (int64_t n = 0; n < 3; n++) {
        c += ray[n] * line->line[n];
        n2[0] += by_u[n] * line->line[n];
        n2[1] += by_v[n] * line->line[n];
        n1[0] += ray[n] * line->by_pixel[n][0];
        n1[1] += ray[n] * line->by_pixel[n][1];
    }
    const double length = sqrt(n2[0] * n2[0] + n2[1] * n2[1]);
    if (!(length > 1e-12))
        return 0;
    n2[0] /= length;
    n2[1] /= length;
    *distance = c / length;
    off[0] = n2[0] * at->A[0] + n2[1] * at->A[2] + n1[0] / length;
    off[1] = n2[0] * at->A[1] + n2[1] * at->A[3] + n1[1] / length;
    return 1;
}

/* Set `known` to the equations of the epipolar line on the next step, which changes q2 by -A dq and A by -A dA, with samples
 * `scale` pixels of image 1 apart; return 0 if there is no line. */
FOR_EACH_PROCESSOR int line_knowledge(const line_t *line, const place_t *at, double scale, knowledge_t *known)
{
    double n2[2], distance, off[2];
    if (!miss(line, at, n2, &distance, off))
        return 0;
    const double across[2] = {n2[0] * at->A[0] + n2[1] * at->A[2], n2[0] * at->A[1] + n2[1] * at->A[3]};
    const double of_place = 1.0 / line->geometry->sigma, of_A = 1.0 / line->geometry->sigma_A;
    memset(known, 0, sizeof *known);
    known->rows[0][4] = across[0] * scale * of_place;
    known->rows[0][5] = across[1] * scale * of_place;
    known->values[0] = distance * of_place;
    for (int64_t k = 0; k < 2; k++) {
        known->rows[1 + k][k] = across[0] * of_A;
        known->rows[1 + k][2 + k] = across[1] * of_A;
        known->values[1 + k] = off[k] * of_A;
    }
    return 1;
}
