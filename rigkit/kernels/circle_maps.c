/* The map from the plane of a lattice of circles to the image around each place: a homography through the circles beside it, and a
 * polynomial through its residuals. The definition in numpy is in tests/kernels/reference/circle_maps.py, the numbers in
 * rigkit.detection.circles.local_map. */
#include "kernels.h"

/* Unknowns of a homography: offset and matrix of u, of v, and the two terms of perspective. */
enum { HOMOGRAPHY = 8, DEGREE = 4 };

/* The circles beside a place: their weights (0 where there is none), and positions relative to their mean. */
typedef struct {
    double weight[MAX_PREDICTORS], u[MAX_PREDICTORS], v[MAX_PREDICTORS], middle[2];
    uint64_t known;
    int64_t count;
} around_t;

/* The factor of the normal equations of the polynomial for one pattern of circles, and the standard deviations that follow. */
typedef struct {
    double factor[PREDICTED_TERMS * PREDICTED_TERMS], gain, slope_gain;
    uint64_t known;
    int solved;
} pattern_t;

/* Read the circles beside a place of the table; return the sum of the squares of their positions. */
INLINE double look_around(
    const double *table, int64_t columns, const int64_t *place, const int64_t *offsets, const double *weights, int64_t near,
    int64_t leave_out, around_t *out)
{
    double total[2] = {0.0, 0.0}, squares = 0.0;
    out->known = 0;
    out->count = 0;
    for (int64_t k = 0; k < near; k++) {
        const double *at = table + 2 * ((place[0] + offsets[2 * k]) * columns + place[1] + offsets[2 * k + 1]);
        const int here = offsets[2 * k] == 0 && offsets[2 * k + 1] == 0, known = isfinite(at[0]) && !(here && leave_out);
        out->weight[k] = known ? weights[k] : 0.0;
        out->u[k] = known ? at[0] : 0.0;
        out->v[k] = known ? at[1] : 0.0;
        total[0] += out->u[k];
        total[1] += out->v[k];
        out->known |= (uint64_t)known << k;
        out->count += known;
    }
    out->middle[0] = total[0] / (double)(out->count > 0 ? out->count : 1);
    out->middle[1] = total[1] / (double)(out->count > 0 ? out->count : 1);
    for (int64_t k = 0; k < near; k++) {
        const int known = out->known >> k & 1;
        out->u[k] = known ? out->u[k] - out->middle[0] : 0.0;
        out->v[k] = known ? out->v[k] - out->middle[1] : 0.0;
        squares += out->u[k] * out->u[k] + out->v[k] * out->v[k];
    }
    return squares;
}

/* Fit x' (1 + g . w) = c + A w, which is linear in c, A and g; replace the positions by their residuals, and write the derivatives
 * of order 0 to 2 at the place. Return whether the circles determine the homography. */
INLINE int without_homography(around_t *at, const double *plane, int64_t near, const prediction_rules_t *rules, double own[6][2])
{
    double N[HOMOGRAPHY * HOMOGRAPHY] = {0.0}, h[HOMOGRAPHY] = {0.0}, all = 0.0;
    for (int64_t k = 0; k < near; k++) {
        const double w = at->weight[k], u = at->u[k], v = at->v[k], x = plane[2 * k], y = plane[2 * k + 1];
        const double one[HOMOGRAPHY] = {1.0, x, y, 0.0, 0.0, 0.0, -u * x, -u * y};
        const double two[HOMOGRAPHY] = {0.0, 0.0, 0.0, 1.0, x, y, -v * x, -v * y};
        for (int i = 0; i < HOMOGRAPHY; i++) {
            h[i] += w * (one[i] * u + two[i] * v);
            for (int j = 0; j <= i; j++)
                N[i * HOMOGRAPHY + j] += w * (one[i] * one[j] + two[i] * two[j]);
        }
        all += w * (u * u + v * v);
    }
    const double scale = 0.5 * all / (double)near;
    for (int i = 0; i < HOMOGRAPHY; i++)
        N[i * HOMOGRAPHY + i] += i < 6 ? rules->min_ridge : rules->slight * (scale > 1e-9 ? scale : 1e-9);
    if (!cholesky(N, HOMOGRAPHY))
        return 0;
    cholesky_solve(N, HOMOGRAPHY, h);
    for (int64_t k = 0; k < near; k++) {
        if (!(at->known >> k & 1))
            continue;
        const double x = plane[2 * k], y = plane[2 * k + 1], below = 1.0 + h[6] * x + h[7] * y;
        /* Near a horizon nothing can be predicted. */
        const double per_below = 1.0 / (below > rules->min_below ? below : rules->min_below);
        at->u[k] -= (h[0] + h[1] * x + h[2] * y) * per_below;
        at->v[k] -= (h[3] + h[4] * x + h[5] * y) * per_below;
    }
    for (int axis = 0; axis < 2; axis++) {
        const double c = h[3 * axis], by_x = h[3 * axis + 1] - c * h[6], by_y = h[3 * axis + 2] - c * h[7];
        const double derivatives[6] = {c, by_x, by_y, -2.0 * by_x * h[6], -by_x * h[7] - by_y * h[6], -2.0 * by_y * h[7]};
        for (int i = 0; i < 6; i++)
            own[i][axis] = derivatives[i];
    }
    return 1;
}

/* Set the terms x^i y^j / (i! j!) of the polynomial, order by order. */
INLINE void set_terms(const double *plane, int64_t near, double terms[MAX_PREDICTORS][PREDICTED_TERMS])
{
    for (int64_t k = 0; k < near; k++)
        for (int order = 0, term = 0; order <= DEGREE; order++)
            for (int j = 0; j <= order; j++, term++) {
                double value = 1.0;
                for (int n = 1; n <= order - j; n++)
                    value *= plane[2 * k] / n;
                for (int n = 1; n <= j; n++)
                    value *= plane[2 * k + 1] / n;
                terms[k][term] = value;
            }
}

/* Factorise the normal equations of the circles beside a place, with the prior `ridge` of each term. */
INLINE void set_pattern(
    const around_t *at, double terms[MAX_PREDICTORS][PREDICTED_TERMS], const double ridge[PREDICTED_TERMS], int64_t near,
    pattern_t *out)
{
    double *N = out->factor, squares[3] = {0.0};
    memset(N, 0, sizeof out->factor);
    out->known = at->known;
    for (int64_t k = 0; k < near; k++)
        for (int i = 0; i < PREDICTED_TERMS && at->weight[k] > 0.0; i++)
            for (int j = 0; j <= i; j++)
                N[i * PREDICTED_TERMS + j] += at->weight[k] * terms[k][i] * terms[k][j];
    for (int i = 0; i < PREDICTED_TERMS; i++)
        N[i * PREDICTED_TERMS + i] += ridge[i];
    out->solved = cholesky(N, PREDICTED_TERMS);
    /* Weights of each circle in the first three terms, the value and its derivatives. */
    for (int i = 0; i < 3 && out->solved; i++) {
        double row[PREDICTED_TERMS] = {0.0};
        row[i] = 1.0;
        cholesky_solve(N, PREDICTED_TERMS, row);
        for (int64_t k = 0; k < near; k++) {
            double sum = 0.0;
            for (int j = 0; j < PREDICTED_TERMS; j++)
                sum += row[j] * terms[k][j];
            squares[i] += at->weight[k] * sum * at->weight[k] * sum;
        }
    }
    out->gain = sqrt(squares[0]);
    out->slope_gain = sqrt(0.5 * (squares[1] + squares[2]));
}

/* Write the map around a place. */
INLINE void write_map(
    const around_t *at, double terms[MAX_PREDICTORS][PREDICTED_TERMS], const pattern_t *pattern, double own[6][2], int64_t near,
    double *out)
{
    for (int axis = 0; axis < 2; axis++) {
        const double *rest = axis ? at->v : at->u;
        double solved[PREDICTED_TERMS] = {0.0};
        for (int64_t k = 0; k < near; k++)
            for (int i = 0; i < PREDICTED_TERMS; i++)
                solved[i] += at->weight[k] * rest[k] * terms[k][i];
        cholesky_solve(pattern->factor, PREDICTED_TERMS, solved);
        out[axis] = solved[0] + own[0][axis] + at->middle[axis];
        for (int i = 0; i < 2; i++)
            out[2 + 2 * axis + i] = solved[1 + i] + own[1 + i][axis];
        for (int i = 0; i < 3; i++)
            out[6 + 3 * axis + i] = solved[3 + i] + own[3 + i][axis];
    }
    out[14] = pattern->gain;
    out[15] = pattern->slope_gain;
}

/* Write the map around each of the `places` of a table of circles, NaN where there is none (reference.circle_maps). The sums of
 * neighbouring places are the same where as many circles are beside them. */
FOR_EACH_PROCESSOR
void local_maps(
    const double *table, int64_t rows, int64_t columns, const int64_t *places, int64_t count, const int64_t *offsets,
    const double *plane, const double *weights, const uint8_t *next, int64_t near, const double *typical,
    const prediction_rules_t *rules, double *out)
{
    double terms[MAX_PREDICTORS][PREDICTED_TERMS], ridge[PREDICTED_TERMS], squares = 0.0, extent = 0.0;
    int64_t known = 0;
    around_t at;
    pattern_t pattern = {.known = 0, .solved = 0};
    (void)rows;
    if (near > MAX_PREDICTORS)
        return;
    set_terms(plane, near, terms);
    for (int64_t n = 0; n < count; n++) {
        squares += look_around(table, columns, places + 2 * n, offsets, weights, near, rules->leave_out, &at);
        known += at.count;
    }
    for (int64_t k = 0; k < near; k++)
        extent += (plane[2 * k] * plane[2 * k] + plane[2 * k + 1] * plane[2 * k + 1]) / (double)near;
    const double pitch = sqrt(squares / (double)(known > 0 ? 2 * known : 1) / extent);
    for (int i = 0; i < PREDICTED_TERMS; i++) {
        const double share = rules->sigma_px / (pitch * typical[i]);
        ridge[i] = share * share + rules->min_ridge;
    }
    for (int64_t n = 0; n < count; n++) {
        double own[6][2], *result = out + PREDICTED_COLUMNS * n;
        look_around(table, columns, places + 2 * n, offsets, weights, near, rules->leave_out, &at);
        int surrounded = 1, centre = 0;
        for (int64_t k = 0; k < near; k++) {
            const int here = offsets[2 * k] == 0 && offsets[2 * k + 1] == 0, there = at.known >> k & 1;
            surrounded &= there || here || !next[k];
            centre += there && here;
        }
        if (!pattern.solved || pattern.known != at.known)
            set_pattern(&at, terms, ridge, near, &pattern);
        if (pattern.solved && without_homography(&at, plane, near, rules, own))
            write_map(&at, terms, &pattern, own, near, result);
        else
            for (int i = 0; i < PREDICTED_COLUMNS; i++)
                result[i] = NAN;
        result[12] = (double)(at.count - centre);
        result[13] = (double)surrounded;
    }
}
