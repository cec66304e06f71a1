/* The fit of blurred circles under a smooth map, one after the other. The definition in numpy is in
 * tests/kernels/reference/circles.py, the numbers in rigkit.detection.circles.fit.
 *
 * The position in the image is x = c + M w + H(w, w) / 2 with w in radii from the circle's centre: c is the image of the centre,
 * not the centre of the image ellipse. The parameters are c, a symmetric matrix that M is multiplied by from the right (a
 * rotation of the circle in itself cannot be observed), the blur s, and the brightness (1 + g . x) (a + b S) with S the share of
 * the disc. */
#include "circle_model.h"

/* Range of the factor of relaxed steps, which noise dominates if two steps are nearly equal or opposite. */
static const double MIN_TIMES = 0.3, MAX_TIMES = 4.0;

/* Gather at most `capacity` pixels within `band` px of the edge and `reach` radii of the centre, and set the circle's brightness to
 * their means inside and outside; return whether there are pixels on both sides. */
INLINE int gather(
    circle_t *at, const void *grey, int64_t bytes, int64_t width, int64_t height, double reach, double band, int64_t capacity,
    spots_t *spots)
{
    const double bend_u = fabs(at->H[0]) + fabs(at->H[1]) + fabs(at->H[2]);
    const double bend_v = fabs(at->H[3]) + fabs(at->H[4]) + fabs(at->H[5]);
    double wide = reach * hypot(at->M[0], at->M[1]), high = reach * hypot(at->M[2], at->M[3]);
    const double near_u = hypot(at->M[0], at->M[1]) + band, near_v = hypot(at->M[2], at->M[3]) + band;
    wide = (wide < near_u ? wide : near_u) + bend_u;
    high = (high < near_v ? high : near_v) + bend_v;
    spots->count = 0;
    if (!isfinite(wide + high + at->c[0] + at->c[1]))
        return 0;
    int64_t left = (int64_t)ceil(at->c[0] - wide), right = (int64_t)floor(at->c[0] + wide);
    int64_t top = (int64_t)ceil(at->c[1] - high), bottom = (int64_t)floor(at->c[1] + high);
    left = left > 0 ? left : 0;
    top = top > 0 ? top : 0;
    right = right < width - 1 ? right : width - 1;
    bottom = bottom < height - 1 ? bottom : height - 1;
    double du[BLOCK], dv[BLOCK], total[2] = {0.0, 0.0};
    int64_t parts[2] = {0, 0};
    places_t here;
    for (int64_t v = top; v <= bottom; v++)
        for (int64_t u = left; u <= right; u += BLOCK) {
            for (int64_t k = 0; k < BLOCK; k++) {
                du[k] = (double)(u + k) - at->c[0];
                dv[k] = (double)v - at->c[1];
            }
            place(at, du, dv, &here);
            for (int64_t k = 0; k < BLOCK && u + k <= right; k++) {
                if (here.r[k] > reach || fabs(here.d[k]) > band || here.r[k] * at->size < NO_DIRECTION || spots->count == capacity)
                    continue;
                const int64_t from = v * width + u + k, to = spots->count++;
                spots->u[to] = (double)(u + k);
                spots->v[to] = (double)v;
                spots->value[to] = level_at(grey, bytes, from);
                const int inside = here.d[k] < 0.0;
                total[inside] += spots->value[to];
                parts[inside]++;
            }
        }
    if (!(parts[0] > 0 && parts[1] > 0))
        return 0;
    at->a = total[0] / (double)parts[0];
    at->b = total[1] / (double)parts[1] - at->a;
    return 1;
}

/* Add the harmonics from 3 on of the residuals of a block over the angle in the plane (cosine, sine), weighted with the derivative by
 * the radius. */
INLINE void add_harmonics(const places_t *places, const double grown[BLOCK], const double off[BLOCK], double out[2 * HARMONICS])
{
    double c[BLOCK], s[BLOCK], cn[BLOCK], sn[BLOCK];
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double per_r = 1.0 / (places->r[k] > 1e-9 ? places->r[k] : 1e-9);
        c[k] = places->x[k] * per_r;
        s[k] = places->y[k] * per_r;
        cn[k] = grown[k] * off[k] * (c[k] * c[k] - s[k] * s[k]);
        sn[k] = grown[k] * off[k] * 2.0 * c[k] * s[k];
    }
    for (int n = 0; n < HARMONICS; n++) {
        double cosines = 0.0, sines = 0.0;
#pragma omp simd reduction(+ : cosines, sines)
        for (int k = 0; k < BLOCK; k++) {
            const double next = cn[k] * c[k] - sn[k] * s[k];
            sn[k] = sn[k] * c[k] + cn[k] * s[k];
            cn[k] = next;
            cosines += cn[k];
            sines += sn[k];
        }
        out[2 * n] += cosines;
        out[2 * n + 1] += sines;
    }
}

/* Write the sums of the products of rows to the lower triangle of `sums`; if `all` rows are wanted, add up the harmonics, too. */
INLINE void sum_products(
    const group_t *at, const spots_t *spots, const int all, double sums[ROWS][ROWS], double harmonics[2 * HARMONICS])
{
    const int count = all ? ROWS : COLUMNS;
    double du[BLOCK], dv[BLOCK], value[BLOCK], rows[ROWS][BLOCK];
    places_t places;
    memset(sums, 0, ROWS * sizeof *sums);
    for (int64_t first = 0; first < spots->count; first += BLOCK) {
        const int64_t here = offsets(&at->own, spots, first, du, dv);
        for (int64_t k = 0; k < BLOCK; k++)
            value[k] = spots->value[first + (k < here ? k : 0)];
        differentiate(at, du, dv, value, all, &places, rows);
        for (int i = 0; i < count; i++)
            for (int64_t k = here; k < BLOCK; k++)
                rows[i][k] = 0.0;
        for (int i = 0; i < count; i++)
            for (int j = 0; j <= i; j++) {
                double sum = 0.0;
#pragma omp simd reduction(+ : sum)
                for (int k = 0; k < BLOCK; k++)
                    sum += rows[i][k] * rows[j][k];
                sums[i][j] += sum;
            }
        if (all)
            add_harmonics(&places, rows[OWN], rows[OFF], harmonics);
    }
}

/* Set the normal equations; return the sum of squared residuals. */
INLINE double equations(double sums[ROWS][ROWS], double N[PARAMETERS * PARAMETERS], double right[PARAMETERS])
{
    for (int i = 0; i < PARAMETERS; i++) {
        right[i] = sums[OFF][i];
        memcpy(N + i * PARAMETERS, sums[i], PARAMETERS * sizeof(double));
    }
    return sums[OFF][OFF];
}

/* Remove an unknown that is at its limit from the normal equations: its step becomes 0, the others those of the reduced problem. */
INLINE void fix_unknown(double N[PARAMETERS * PARAMETERS], double right[PARAMETERS], int out)
{
    for (int i = 0; i < PARAMETERS; i++)
        N[i * PARAMETERS + out] = N[out * PARAMETERS + i] = 0.0;
    N[out * PARAMETERS + out] = 1.0;
    right[out] = 0.0;
}

/* Return the factor of a step, from the factor `times` of the previous one: where the model does not describe the edges, steps
 * oscillate or converge slowly. This is Aitken's relaxation for vectors (Irons and Tuck, "A version of the Aitken accelerator for
 * computer iteration", 1969, equation 12) in the metric of the normal equations: `moves` is the squared norm of the step, `along`
 * its product with the previous one, `before` the squared norm of that. */
INLINE double relaxed(double times, double moves, double along, double before)
{
    const double change = moves - 2.0 * along + before;
    const double fresh = times * (before - along) / (change > 1e-12 * before ? change : 1e-12 * before);
    return fresh < MIN_TIMES ? MIN_TIMES : fresh > MAX_TIMES ? MAX_TIMES : fresh;
}

/* Multiply M from the right by 1 plus the symmetric matrix of `step`, clipped to the largest change. */
INLINE void grow(circle_t *at, const double step[PARAMETERS], const circle_rules_t *rules)
{
    const double e1 = limited(step[E1], rules->max_growth), e2 = limited(step[E2], rules->max_growth);
    const double e3 = limited(step[E3], rules->max_growth);
    const double m0 = at->M[0], m1 = at->M[1], m2 = at->M[2], m3 = at->M[3];
    at->M[0] = m0 * (1.0 + e1 + e2) + m1 * e3;
    at->M[1] = m0 * e3 + m1 * (1.0 + e1 - e2);
    at->M[2] = m2 * (1.0 + e1 + e2) + m3 * e3;
    at->M[3] = m2 * e3 + m3 * (1.0 + e1 - e2);
}

/* Move the circle and its neighbours by a step; return whether their maps are still invertible. */
static int moved(group_t *group, const double step[PARAMETERS], const circle_rules_t *rules)
{
    circle_t *at = &group->own;
    at->c[0] += limited(step[X], rules->max_move_px);
    at->c[1] += limited(step[Y], rules->max_move_px);
    at->s += limited(step[S], 0.5 * at->s);
    at->s = at->s < rules->min_blur ? rules->min_blur : at->s > rules->max_blur ? rules->max_blur : at->s;
    at->a += step[A];
    at->b += step[B];
    at->g[0] = limited(at->g[0] + step[GX], rules->max_light);
    at->g[1] = limited(at->g[1] + step[GY], rules->max_light);
    grow(at, step, rules);
    int fine = inverted(at);
    for (int j = 0; j < group->count && fine; j++) {
        grow(group->beside + j, step, rules);
        fine = inverted(group->beside + j);
    }
    return fine;
}

/* Write the gradient of the cost by the two parameters of an anisotropic blur, and the Schur complement of their normal equations
 * (3) after the elimination of all others, whose normal equations have the factor `N`. */
static void unevenness(double sums[ROWS][ROWS], const double *N, double out[5])
{
    double solved[2][PARAMETERS];
    out[0] = sums[Q1][OFF];
    out[1] = sums[Q2][OFF];
    out[2] = sums[Q1][Q1];
    out[3] = sums[Q2][Q1];
    out[4] = sums[Q2][Q2];
    memcpy(solved[0], sums[Q1], sizeof solved[0]);
    memcpy(solved[1], sums[Q2], sizeof solved[1]);
    cholesky_solve(N, PARAMETERS, solved[0]);
    cholesky_solve(N, PARAMETERS, solved[1]);
    for (int i = 0; i < PARAMETERS; i++) {
        out[2] -= sums[Q1][i] * solved[0][i];
        out[3] -= sums[Q1][i] * solved[1][i];
        out[4] -= sums[Q2][i] * solved[1][i];
    }
}

/* Write the move (2) of the centre if the gradient of added light were a parameter, too, and its covariance (uu, uv, vv) at noise of
 * variance 1; `N` is the factor of the normal equations of all others. */
static void added_light(double sums[ROWS][ROWS], const double *N, double out[5])
{
    double solved[2][PARAMETERS], A[3] = {sums[LX][LX], sums[LY][LX], sums[LY][LY]};
    memcpy(solved[0], sums[LX], sizeof solved[0]);
    memcpy(solved[1], sums[LY], sizeof solved[1]);
    cholesky_solve(N, PARAMETERS, solved[0]);
    cholesky_solve(N, PARAMETERS, solved[1]);
    for (int i = 0; i < PARAMETERS; i++) {
        A[0] -= sums[LX][i] * solved[0][i];
        A[1] -= sums[LX][i] * solved[1][i];
        A[2] -= sums[LY][i] * solved[1][i];
    }
    const double det = A[0] * A[2] - A[1] * A[1];
    memset(out, 0, 5 * sizeof *out);
    if (!(det > 1e-9 * A[0] * A[2]))
        return;
    const double B[3] = {A[2] / det, -A[1] / det, A[0] / det}, left[2] = {sums[LX][OFF], sums[LY][OFF]};
    double by[2][2];
    for (int i = X; i <= Y; i++) {
        by[i][0] = -solved[0][i] * B[0] - solved[1][i] * B[1];
        by[i][1] = -solved[0][i] * B[1] - solved[1][i] * B[2];
        out[i] = by[i][0] * left[0] + by[i][1] * left[1];
    }
    out[2] = -by[0][0] * solved[0][X] - by[0][1] * solved[1][X];
    out[3] = -by[0][0] * solved[0][Y] - by[0][1] * solved[1][Y];
    out[4] = -by[1][0] * solved[0][Y] - by[1][1] * solved[1][Y];
}

/* Return the circle of the initial values, with the number of fixed-point steps that PLACE_ERROR needs. */
static circle_t guessed(const double *pixel, const double *map, const double *bend, double blur, const double q[2])
{
    circle_t at = {.s = blur, .q = {q[0], q[1]}};
    memcpy(at.c, pixel, sizeof at.c);
    memcpy(at.M, map, sizeof at.M);
    memcpy(at.H, bend, sizeof at.H);
    at.size = sqrt(fabs(at.M[0] * at.M[3] - at.M[1] * at.M[2]));
    /* The shorter axis is at least the area over the Frobenius norm. */
    const double longest = sqrt(at.M[0] * at.M[0] + at.M[1] * at.M[1] + at.M[2] * at.M[2] + at.M[3] * at.M[3]);
    double bent = 0.0, left_over = 1.0;
    for (int k = 0; k < 6; k++)
        bent += fabs(at.H[k]);
    const double ratio = 0.5 * bent * longest / (at.size * at.size);
    for (at.inversions = 0; at.inversions < INVERSIONS && left_over * ratio > PLACE_ERROR; at.inversions++)
        left_over *= ratio;
    return at;
}

/* Write the results of a fitted circle; `N` is the factor of the normal equations. */
static void write_circle(const circle_t *at, const double *N, double sums[ROWS][ROWS], int64_t seen, int settled, double *result)
{
    double cov[2][PARAMETERS] = {{0.0}}, growth[PARAMETERS];
    cov[0][X] = cov[1][Y] = 1.0;
    cholesky_solve(N, PARAMETERS, cov[0]);
    cholesky_solve(N, PARAMETERS, cov[1]);
    memcpy(result, at->c, sizeof at->c);
    memcpy(result + 2, at->M, sizeof at->M);
    result[6] = cov[0][X];
    result[7] = cov[0][Y];
    result[8] = cov[1][Y];
    result[9] = at->s;
    result[10] = at->a;
    result[11] = at->b;
    result[12] = sqrt(sums[OFF][OFF] / (double)(seen > PARAMETERS ? seen - PARAMETERS : 1));
    result[13] = (double)seen;
    result[14] = (double)settled;
    for (int i = E1; i <= E3; i++) {
        memset(growth, 0, sizeof growth);
        growth[i] = 1.0;
        cholesky_solve(N, PARAMETERS, growth);
        result[15 + i - E1] = growth[i];
    }
}

/* Write the further results. The harmonics of the edge are deviations of its radius, in radii: 0 for a disc, while a square has the
 * fourth. */
static void write_shape(const double *N, double sums[ROWS][ROWS], const double harmonics[2 * HARMONICS], double *result)
{
    for (int n = 0; n < 2 * HARMONICS; n++)
        result[18 + n] = 2.0 * harmonics[n] / (sums[OWN][OWN] > 1e-12 ? sums[OWN][OWN] : 1e-12);
    unevenness(sums, N, result + 18 + 2 * HARMONICS);
    added_light(sums, N, result + 23 + 2 * HARMONICS);
}

/* Write the results of a fit whose last step had the normal equations of `sums` and their factor `N`: of a brief one those, else what
 * follows from the circle as it is now. */
INLINE void finish(
    const group_t *group, const spots_t *spots, int brief, int settled, double sums[ROWS][ROWS], double N[PARAMETERS * PARAMETERS],
    double *result)
{
    double harmonics[2 * HARMONICS] = {0.0}, right[PARAMETERS];
    if (!brief) {
        sum_products(group, spots, 1, sums, harmonics);
        equations(sums, N, right);
        if (!cholesky(N, PARAMETERS))
            return;
        write_shape(N, sums, harmonics, result);
    }
    write_circle(&group->own, N, sums, spots->count, settled, result);
}

/* Return circle `n` with initial values, and those of its neighbours (`beside`) whose light reaches its pixels. */
static group_t grouped(
    int64_t n, const double *pixels, const double *maps, const double *curvatures, const double *blur, const double *uneven,
    double reach, const int64_t *beside, const circle_rules_t *rules)
{
    group_t group = {.own = guessed(pixels + 2 * n, maps + 4 * n, curvatures + 6 * n, blur[n], uneven + 2 * n)};
    for (int k = 0; k < BESIDE; k++) {
        const int64_t j = beside[BESIDE * n + k];
        if (j < 0)
            continue;
        circle_t other = guessed(pixels + 2 * j, maps + 4 * j, curvatures + 6 * j, blur[n], uneven + 2 * n);
        /* The extents of the neighbour and of this circle's pixels along the line between the centres. */
        const double u = other.c[0] - group.own.c[0], v = other.c[1] - group.own.c[1], apart = hypot(u, v);
        const double *M = other.M, *own = group.own.M, wide = hypot(M[0] * u + M[2] * v, M[1] * u + M[3] * v) / apart;
        const double far = reach * hypot(own[0] * u + own[2] * v, own[1] * u + own[3] * v) / apart;
        if (apart - far - wide < rules->near_beside * blur[n] && apart > 1.0 && inverted(&other))
            group.beside[group.count++] = other;
    }
    return group;
}

/* Fit `count` circles by relaxed Gauss-Newton steps (reference.circles). */
FOR_EACH_PROCESSOR
void fit_circles(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *pixels, const double *maps,
    const double *curvatures, const double *blur, const double *uneven, const double *reach, const int64_t *beside,
    const circle_rules_t *rules, int64_t capacity, double *scratch, double *out)
{
    spots_t spots = {.u = scratch, .v = scratch + capacity, .value = scratch + 2 * capacity};
    for (int64_t n = 0; n < count; n++) {
        double *result = out + n * CIRCLE_OUTCOMES;
        memset(result, 0, CIRCLE_OUTCOMES * sizeof(double));
        group_t group = grouped(n, pixels, maps, curvatures, blur, uneven, reach[n], beside, rules);
        circle_t *at = &group.own;
        const double band = rules->near_sigmas * at->s + rules->near_px;
        if (!inverted(at))
            continue;
        const int both = gather(at, grey, bytes, width, height, reach[n], band, capacity, &spots);
        double sums[ROWS][ROWS], harmonics[2 * HARMONICS] = {0.0}, N[PARAMETERS * PARAMETERS], right[PARAMETERS], step[PARAMETERS];
        if (!both || !(spots.count >= rules->min_pixels))
            continue;
        double before[PARAMETERS] = {0.0}, times = 1.0, moved_before = 0.0;
        int solved = 1, settled = 0, still = 0;
        for (int64_t k = 0; k < rules->iterations && solved && !settled; k++) {
            sum_products(&group, &spots, 0, sums, harmonics);
            const double variance = equations(sums, N, right) / (double)(spots.count - PARAMETERS);
            for (int i = 0; i < PARAMETERS; i++)
                N[i * PARAMETERS + i] *= 1.0 + 1e-9;
            if (at->s <= rules->min_blur && right[S] < 0.0)
                fix_unknown(N, right, S);
            solved = cholesky(N, PARAMETERS);
            if (!solved)
                break;
            memcpy(step, right, sizeof step);
            cholesky_solve(N, PARAMETERS, step);
            /* sqrt(moves / variance) bounds the move of every parameter in its standard deviations. */
            double moves = 0.0, along = 0.0;
            for (int i = 0; i < PARAMETERS; i++) {
                moves += right[i] * step[i];
                along += right[i] * before[i];
            }
            if (k >= rules->plain_iterations)
                times = relaxed(times, moves, along, moved_before);
            moved_before = moves;
            memcpy(before, step, sizeof step);
            for (int i = 0; i < PARAMETERS; i++)
                step[i] *= times;
            solved = moved(&group, step, rules);
            const int certain = moves < rules->converged_sigmas * rules->converged_sigmas * variance;
            /* Size and slant determine the uncertainty of the centre, and converge later. */
            const double grown = fabs(step[E1]) + fabs(step[E2]) + fabs(step[E3]);
            still = certain || fabs(step[X]) + fabs(step[Y]) < rules->converged_px;
            settled = certain || (still && grown * at->size < rules->converged_px);
        }
        if (solved)
            finish(&group, &spots, (int)rules->brief, still, sums, N, result);
    }
}
