/* The fit of blurred circles, seen through any smooth map, one after the other. The definition in numpy is in
 * tests/kernels/reference/circles.py, the numbers are in rigkit.detection.circles.fit.
 *
 * Position x in the image is c + M w + H(w, w) / 2 of the place w in radii from the circle's centre: c is the image of the
 * centre, not the middle of the image. Free are c, M from the right by a symmetric matrix (which circle a turn of it would
 * be, nobody sees), the blur s, and the light (1 + g . x) (a + b S), S the share of the disc. */
#include "kernels.h"

enum { X, Y, E1, E2, E3, S, A, B, GX, GY, PARAMETERS };

/* Steps of w = inverse(M) (x - c - H(w, w) / 2), at most: each gains the ratio of bend to size. */
enum { INVERSIONS = 4 };
/* What the place of a pixel may be off for them, in radii. */
static const double PLACE_ERROR = 1e-5;

/* Pixels are dealt with so many at a time. */
enum { BLOCK = 32 };
/* The normal equations and, as the last of their columns, the residuals. */
enum { OFF = PARAMETERS, COLUMNS };
/* Further from an edge than this, in blurs, it is all one brightness. */
static const float FAR = 12.0f;

/* The pixels of a circle: arrays of their coordinates and brightness. */
typedef struct {
    double *u, *v, *value;
    int64_t count;
} spots_t;

typedef struct {
    double c[2], M[4], inverse[4], H[6], s, a, b, g[2], size;
    int inversions;
} circle_t;

/* Pixels as the map places them: place (x, y) in radii and its distance r from the centre, distance d from the edge in px
 * (outwards), direction n of growing r, 1 / |grad r|, curvature of the edge. */
typedef struct {
    double x[BLOCK], y[BLOCK], r[BLOCK], d[BLOCK], nu[BLOCK], nv[BLOCK], per_radius[BLOCK], curvature[BLOCK];
} places_t;

INLINE void place(const circle_t *at, const double du[BLOCK], const double dv[BLOCK], places_t *out)
{
    const double *H = at->H, *M = at->M, *inverse = at->inverse;
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        out->x[k] = inverse[0] * du[k] + inverse[1] * dv[k];
        out->y[k] = inverse[2] * du[k] + inverse[3] * dv[k];
    }
    for (int step = 0; step < at->inversions; step++)
#pragma omp simd
        for (int k = 0; k < BLOCK; k++) {
            const double x = out->x[k], y = out->y[k];
            const double hu = du[k] - 0.5 * (H[0] * x * x + 2.0 * H[1] * x * y + H[2] * y * y);
            const double hv = dv[k] - 0.5 * (H[3] * x * x + 2.0 * H[4] * x * y + H[5] * y * y);
            out->x[k] = inverse[0] * hu + inverse[1] * hv;
            out->y[k] = inverse[2] * hu + inverse[3] * hv;
        }
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double x = out->x[k], y = out->y[k];
        const double j00 = M[0] + H[0] * x + H[1] * y, j01 = M[1] + H[1] * x + H[2] * y;
        const double j10 = M[2] + H[3] * x + H[4] * y, j11 = M[3] + H[4] * x + H[5] * y;
        const double per_det = 1.0 / (j00 * j11 - j01 * j10);
        const double r = sqrt(x * x + y * y), safe = r > 1e-9 ? r : 1e-9;
        const double c = r > 1e-9 ? x / safe : 1.0, s = y / safe;
        const double gu = (j11 * c - j10 * s) * per_det, gv = (j00 * s - j01 * c) * per_det;
        const double per_slope = 1.0 / sqrt(gu * gu + gv * gv), nu = gu * per_slope, nv = gv * per_slope;
        /* How r bends along n: then (r - 1) / slope, which is the distance to first order, is right to second. */
        const double across = (c * (j00 * nv - j10 * nu) - s * (j11 * nu - j01 * nv)) * per_det;
        const double first = (r - 1.0) * per_slope, second = 0.5 * first * across * across * per_slope / safe;
        out->r[k] = r;
        out->d[k] = first * (1.0 + limited(second, 0.5));
        out->nu[k] = nu;
        out->nv[k] = nv;
        out->per_radius[k] = per_slope;
        out->curvature[k] = per_slope * per_slope * per_slope * per_det * per_det;
    }
}

/* Set `share` to the part of the disc in pixels that are `z` blurs inside its edge, `slope` to its derivative. The limits
 * have a loop of their own: as branches they would keep the other from being vectorised. */
INLINE void shares(const double z[BLOCK], double share[BLOCK], double slope[BLOCK])
{
    float x[BLOCK];
    for (int k = 0; k < BLOCK; k++) {
        const float at = (float)z[k], most = at < FAR ? at : FAR;
        x[k] = most > -FAR ? most : -FAR;
    }
    for (int k = 0; k < BLOCK; k++) {
        float edge[5];
        blurred_edge(x[k], 0.0f, edge);
        share[k] = 0.5 + 0.5 * (double)edge[0];
        slope[k] = 0.5 * (double)edge[1];
    }
}

/* Return how many pixels of a block there are from `first` on, and where they are from the circle's centre; what is beyond
 * the last pixel is at the centre. */
INLINE int64_t offsets(const circle_t *at, const spots_t *spots, int64_t first, double du[BLOCK], double dv[BLOCK])
{
    const int64_t here = spots->count - first < BLOCK ? spots->count - first : BLOCK;
    for (int64_t k = 0; k < BLOCK; k++) {
        du[k] = k < here ? spots->u[first + k] - at->c[0] : 0.0;
        dv[k] = k < here ? spots->v[first + k] - at->c[1] : 0.0;
    }
    return here;
}

/* Set the inverse of the circle's map; return whether there is one. */
INLINE int inverted(circle_t *at)
{
    const double *M = at->M, det = M[0] * M[3] - M[1] * M[2];
    if (!(fabs(det) > 1e-6))
        return 0;
    at->inverse[0] = M[3] / det;
    at->inverse[1] = -M[1] / det;
    at->inverse[2] = -M[2] / det;
    at->inverse[3] = M[0] / det;
    return 1;
}

/* Gather the pixels near the edge and within `reach` radii, at most `most`. */
INLINE void gather(
    const circle_t *at, const void *grey, int64_t bytes, int64_t width, int64_t height, double reach, double band, int64_t most,
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
        return;
    int64_t left = (int64_t)ceil(at->c[0] - wide), right = (int64_t)floor(at->c[0] + wide);
    int64_t top = (int64_t)ceil(at->c[1] - high), bottom = (int64_t)floor(at->c[1] + high);
    left = left > 0 ? left : 0;
    top = top > 0 ? top : 0;
    right = right < width - 1 ? right : width - 1;
    bottom = bottom < height - 1 ? bottom : height - 1;
    double du[BLOCK], dv[BLOCK];
    places_t here;
    for (int64_t v = top; v <= bottom; v++)
        for (int64_t u = left; u <= right; u += BLOCK) {
            for (int64_t k = 0; k < BLOCK; k++) {
                du[k] = (double)(u + k) - at->c[0];
                dv[k] = (double)v - at->c[1];
            }
            place(at, du, dv, &here);
            for (int64_t k = 0; k < BLOCK && u + k <= right; k++) {
                if (here.r[k] > reach || fabs(here.d[k]) > band || spots->count == most)
                    continue;
                const int64_t from = v * width + u + k, to = spots->count++;
                spots->u[to] = (double)(u + k);
                spots->v[to] = (double)v;
                spots->value[to] = bytes ? (double)((const uint8_t *)grey)[from] : (double)((const float *)grey)[from];
            }
        }
}

/* Set the places of a block, and its rows: derivatives of the brightness by the parameters, and residuals. */
INLINE void differentiate(
    const circle_t *at, const double du[BLOCK], const double dv[BLOCK], const double value[BLOCK], places_t *places,
    double rows[COLUMNS][BLOCK])
{
    double z[BLOCK], share[BLOCK], slope[BLOCK];
    const double per_blur = 1.0 / at->s, per_size = 1.0 / at->size;
    place(at, du, dv, places);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++)
        z[k] = -places->d[k] * per_blur - 0.5 * places->curvature[k] * at->s;
    shares(z, share, slope);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double x = du[k] * per_size, y = dv[k] * per_size, light = 1.0 + at->g[0] * x + at->g[1] * y;
        const double level = at->a + at->b * share[k], steep = light * at->b * slope[k], edge = steep * per_blur;
        const double per_r = 1.0 / (places->r[k] > 1e-9 ? places->r[k] : 1e-9), c = places->x[k] * per_r, s = places->y[k] * per_r;
        const double grown = edge * places->per_radius[k];
        rows[X][k] = edge * places->nu[k];
        rows[Y][k] = edge * places->nv[k];
        rows[E1][k] = grown;
        rows[E2][k] = grown * (c * c - s * s);
        rows[E3][k] = grown * 2.0 * c * s;
        rows[S][k] = steep * (places->d[k] * per_blur * per_blur - 0.5 * places->curvature[k]);
        rows[A][k] = light;
        rows[B][k] = light * share[k];
        rows[GX][k] = level * x;
        rows[GY][k] = level * y;
        rows[OFF][k] = value[k] - light * level;
    }
}

/* Fill the normal equations; return the sum of squared residuals. */
INLINE double linearise(const circle_t *at, const spots_t *spots, double N[PARAMETERS * PARAMETERS], double right[PARAMETERS])
{
    double du[BLOCK], dv[BLOCK], value[BLOCK], rows[COLUMNS][BLOCK], sums[COLUMNS][COLUMNS] = {{0.0}};
    places_t places;
    for (int64_t first = 0; first < spots->count; first += BLOCK) {
        const int64_t here = offsets(at, spots, first, du, dv);
        for (int64_t k = 0; k < BLOCK; k++)
            value[k] = spots->value[first + (k < here ? k : 0)];
        differentiate(at, du, dv, value, &places, rows);
        for (int i = 0; i < COLUMNS; i++)
            for (int64_t k = here; k < BLOCK; k++)
                rows[i][k] = 0.0;
        for (int i = 0; i < COLUMNS; i++)
            for (int j = 0; j <= i; j++) {
                double sum = 0.0;
#pragma omp simd reduction(+ : sum)
                for (int k = 0; k < BLOCK; k++)
                    sum += rows[i][k] * rows[j][k];
                sums[i][j] += sum;
            }
    }
    for (int i = 0; i < PARAMETERS; i++) {
        right[i] = sums[OFF][i];
        memcpy(N + i * PARAMETERS, sums[i], PARAMETERS * sizeof(double));
    }
    return sums[OFF][OFF];
}

static void moved(circle_t *at, const double step[PARAMETERS], const circle_rules_t *rules)
{
    const double e1 = limited(step[E1], rules->most_growth), e2 = limited(step[E2], rules->most_growth);
    const double e3 = limited(step[E3], rules->most_growth);
    const double m0 = at->M[0], m1 = at->M[1], m2 = at->M[2], m3 = at->M[3];
    at->c[0] += limited(step[X], rules->most_move_px);
    at->c[1] += limited(step[Y], rules->most_move_px);
    at->M[0] = m0 * (1.0 + e1 + e2) + m1 * e3;
    at->M[1] = m0 * e3 + m1 * (1.0 + e1 - e2);
    at->M[2] = m2 * (1.0 + e1 + e2) + m3 * e3;
    at->M[3] = m2 * e3 + m3 * (1.0 + e1 - e2);
    at->s += limited(step[S], 0.5 * at->s);
    at->s = at->s < rules->least_blur ? rules->least_blur : at->s > rules->most_blur ? rules->most_blur : at->s;
    at->a += step[A];
    at->b += step[B];
    at->g[0] = limited(at->g[0] + step[GX], rules->most_light);
    at->g[1] = limited(at->g[1] + step[GY], rules->most_light);
}

/* Write how the residuals go on round the circle: their means weighted as a change of radius, for harmonics 3 to 6 of the
 * angle in the plane, in radii (cosine and sine each). A disc has none; a square has the fourth. */
INLINE void harmonics(const circle_t *at, const spots_t *spots, double out[8])
{
    double du[BLOCK], dv[BLOCK], value[BLOCK], rows[COLUMNS][BLOCK], weight = 0.0;
    places_t places;
    memset(out, 0, 8 * sizeof(double));
    for (int64_t first = 0; first < spots->count; first += BLOCK) {
        const int64_t here = offsets(at, spots, first, du, dv);
        for (int64_t k = 0; k < BLOCK; k++)
            value[k] = spots->value[first + (k < here ? k : 0)];
        differentiate(at, du, dv, value, &places, rows);
        for (int64_t k = 0; k < here; k++) {
            const double grown = rows[E1][k], per_r = 1.0 / (places.r[k] > 1e-9 ? places.r[k] : 1e-9);
            const double c = places.x[k] * per_r, s = places.y[k] * per_r;
            double cn = c * c - s * s, sn = 2.0 * c * s;
            weight += grown * grown;
            for (int n = 0; n < 4; n++) {
                const double next = cn * c - sn * s;
                sn = sn * c + cn * s;
                cn = next;
                out[2 * n] += grown * rows[OFF][k] * cn;
                out[2 * n + 1] += grown * rows[OFF][k] * sn;
            }
        }
    }
    for (int n = 0; n < 8; n++)
        out[n] *= 2.0 / (weight > 1e-12 ? weight : 1e-12);
}

/* Return the circle as its guess has it, with as many inversions of its map as a pixel's place needs. */
static circle_t guessed(const double *pixel, const double *map, const double *bend, double blur)
{
    circle_t at = {.s = blur};
    memcpy(at.c, pixel, sizeof at.c);
    memcpy(at.M, map, sizeof at.M);
    memcpy(at.H, bend, sizeof at.H);
    at.size = sqrt(fabs(at.M[0] * at.M[3] - at.M[1] * at.M[2]));
    /* The narrower of its axes is at least area over the longer. */
    const double longest = sqrt(at.M[0] * at.M[0] + at.M[1] * at.M[1] + at.M[2] * at.M[2] + at.M[3] * at.M[3]);
    double bent = 0.0, left_over = 1.0;
    for (int k = 0; k < 6; k++)
        bent += fabs(at.H[k]);
    const double ratio = 0.5 * bent * longest / (at.size * at.size);
    for (at.inversions = 0; at.inversions < INVERSIONS && left_over * ratio > PLACE_ERROR; at.inversions++)
        left_over *= ratio;
    return at;
}

/* Set the brightness to the means inside and outside; return whether there are pixels of both. */
INLINE int set_brightness(circle_t *at, const spots_t *spots)
{
    double du[BLOCK], dv[BLOCK], total[2] = {0.0, 0.0};
    int64_t parts[2] = {0, 0};
    places_t places;
    for (int64_t first = 0; first < spots->count; first += BLOCK) {
        const int64_t here = offsets(at, spots, first, du, dv);
        place(at, du, dv, &places);
        for (int64_t k = 0; k < here; k++) {
            const int inside = places.d[k] < 0.0;
            total[inside] += spots->value[first + k];
            parts[inside]++;
        }
    }
    if (!(parts[0] > 0 && parts[1] > 0))
        return 0;
    at->a = total[0] / (double)parts[0];
    at->b = total[1] / (double)parts[1] - at->a;
    return 1;
}

/* Write the fitted circle with `N`, the normal equations' factor. */
static void write_circle(const circle_t *at, const double *N, double squares, int64_t seen, int settled, double *result)
{
    double cov[2][PARAMETERS] = {{0.0}};
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
    result[12] = sqrt(squares / (double)(seen > PARAMETERS ? seen - PARAMETERS : 1));
    result[13] = (double)seen;
    result[14] = (double)settled;
}

FOR_EACH_PROCESSOR
void fit_circles(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *pixels, const double *maps,
    const double *bends, const double *blur, const double *reach, const circle_rules_t *rules, int64_t most, double *scratch,
    double *out)
{
    spots_t spots = {.u = scratch, .v = scratch + most, .value = scratch + 2 * most};
    for (int64_t n = 0; n < count; n++) {
        double *result = out + n * CIRCLE_OUTCOMES;
        memset(result, 0, CIRCLE_OUTCOMES * sizeof(double));
        circle_t at = guessed(pixels + 2 * n, maps + 4 * n, bends + 6 * n, blur[n]);
        const double band = rules->near_sigmas * at.s + rules->near_px;
        if (!inverted(&at))
            continue;
        gather(&at, grey, bytes, width, height, reach[n], band, most, &spots);
        double N[PARAMETERS * PARAMETERS], step[PARAMETERS];
        if (!(spots.count >= rules->fewest) || !set_brightness(&at, &spots))
            continue;
        int solved = 1, settled = 0;
        for (int64_t k = 0; k < rules->iterations && solved && !settled; k++) {
            linearise(&at, &spots, N, step);
            for (int i = 0; i < PARAMETERS; i++)
                N[i * PARAMETERS + i] *= 1.0 + 1e-9;
            solved = cholesky(N, PARAMETERS);
            if (!solved)
                break;
            cholesky_solve(N, PARAMETERS, step);
            moved(&at, step, rules);
            solved = inverted(&at);
            settled = fabs(step[X]) + fabs(step[Y]) < rules->converged_px;
        }
        if (!solved)
            continue;
        const double squares = linearise(&at, &spots, N, step);
        if (!cholesky(N, PARAMETERS))
            continue;
        write_circle(&at, N, squares, spots.count, settled, result);
        harmonics(&at, &spots, result + 15);
    }
}
