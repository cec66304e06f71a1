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

typedef struct {
    double u, v, value;
} spot_t;

typedef struct {
    double c[2], M[4], H[6], s, a, b, g[2], size;
    int inversions;
} circle_t;

/* A pixel as the map places it: place in radii and its distance r from the centre, distance d from the edge in px
 * (outwards), direction n of growing r, 1 / |grad r|, curvature of the edge. */
typedef struct {
    double w[2], r, d, n[2], per_radius, curvature;
} place_t;

INLINE place_t place_of(const circle_t *at, const double inverse[4], double du, double dv)
{
    const double *H = at->H, *M = at->M;
    double x = inverse[0] * du + inverse[1] * dv, y = inverse[2] * du + inverse[3] * dv;
    for (int k = 0; k < at->inversions; k++) {
        const double hu = du - 0.5 * (H[0] * x * x + 2.0 * H[1] * x * y + H[2] * y * y);
        const double hv = dv - 0.5 * (H[3] * x * x + 2.0 * H[4] * x * y + H[5] * y * y);
        x = inverse[0] * hu + inverse[1] * hv;
        y = inverse[2] * hu + inverse[3] * hv;
    }
    const double j00 = M[0] + H[0] * x + H[1] * y, j01 = M[1] + H[1] * x + H[2] * y;
    const double j10 = M[2] + H[3] * x + H[4] * y, j11 = M[3] + H[4] * x + H[5] * y;
    const double det = j00 * j11 - j01 * j10;
    place_t out;
    out.w[0] = x;
    out.w[1] = y;
    out.r = sqrt(x * x + y * y);
    const double safe = out.r > 1e-9 ? out.r : 1e-9, c = out.r > 1e-9 ? x / safe : 1.0, s = y / safe;
    const double gu = (j11 * c - j10 * s) / det, gv = (j00 * s - j01 * c) / det;
    const double slope = sqrt(gu * gu + gv * gv);
    out.n[0] = gu / slope;
    out.n[1] = gv / slope;
    out.per_radius = 1.0 / slope;
    /* How r bends along n: then (r - 1) / slope, which is the distance to first order, is right to second. */
    const double across = (-s * (j11 * out.n[0] - j01 * out.n[1]) + c * (j00 * out.n[1] - j10 * out.n[0])) / det;
    const double first = (out.r - 1.0) / slope;
    double second = 0.5 * first * across * across / (safe * slope);
    second = second > 0.5 ? 0.5 : second < -0.5 ? -0.5 : second;
    out.d = first * (1.0 + second);
    out.curvature = 1.0 / (slope * slope * slope * det * det);
    return out;
}

/* Return exp(-z^2 / 2) / sqrt(2 pi). */
INLINE double bell(double z)
{
    return 0.3989422804014327 * exp(-0.5 * z * z);
}

INLINE int inverted(const double M[4], double out[4])
{
    const double det = M[0] * M[3] - M[1] * M[2];
    if (!(fabs(det) > 1e-6))
        return 0;
    out[0] = M[3] / det;
    out[1] = -M[1] / det;
    out[2] = -M[2] / det;
    out[3] = M[0] / det;
    return 1;
}

/* Gather the pixels near the edge and within `reach` radii; return how many, at most `most`. */
static int64_t gather(
    const circle_t *at, const void *grey, int64_t bytes, int64_t width, int64_t height, double reach, double band, spot_t *spots,
    int64_t most)
{
    double inverse[4];
    if (!inverted(at->M, inverse))
        return 0;
    const double bend_u = fabs(at->H[0]) + fabs(at->H[1]) + fabs(at->H[2]);
    const double bend_v = fabs(at->H[3]) + fabs(at->H[4]) + fabs(at->H[5]);
    double wide = reach * hypot(at->M[0], at->M[1]), high = reach * hypot(at->M[2], at->M[3]);
    const double near_u = hypot(at->M[0], at->M[1]) + band, near_v = hypot(at->M[2], at->M[3]) + band;
    wide = (wide < near_u ? wide : near_u) + bend_u;
    high = (high < near_v ? high : near_v) + bend_v;
    if (!isfinite(wide + high + at->c[0] + at->c[1]))
        return 0;
    int64_t left = (int64_t)ceil(at->c[0] - wide), right = (int64_t)floor(at->c[0] + wide);
    int64_t top = (int64_t)ceil(at->c[1] - high), bottom = (int64_t)floor(at->c[1] + high);
    left = left > 0 ? left : 0;
    top = top > 0 ? top : 0;
    right = right < width - 1 ? right : width - 1;
    bottom = bottom < height - 1 ? bottom : height - 1;
    int64_t count = 0;
    for (int64_t v = top; v <= bottom; v++)
        for (int64_t u = left; u <= right; u++) {
            const place_t here = place_of(at, inverse, (double)u - at->c[0], (double)v - at->c[1]);
            if (here.r > reach || fabs(here.d) > band || count == most)
                continue;
            const int64_t k = v * width + u;
            const double value = bytes ? (double)((const uint8_t *)grey)[k] : (double)((const float *)grey)[k];
            spots[count++] = (spot_t){(double)u, (double)v, value};
        }
    return count;
}

/* Fill the normal equations; return the sum of squared residuals. `row` and what it is made of are as in
 * reference.circles.linearise. */
static double linearise(const circle_t *at, const spot_t *spots, int64_t count, double N[PARAMETERS * PARAMETERS], double right[PARAMETERS])
{
    double inverse[4], sum = 0.0;
    memset(N, 0, PARAMETERS * PARAMETERS * sizeof(double));
    memset(right, 0, PARAMETERS * sizeof(double));
    if (!inverted(at->M, inverse))
        return INFINITY;
    for (int64_t k = 0; k < count; k++) {
        const double du = spots[k].u - at->c[0], dv = spots[k].v - at->c[1];
        const place_t here = place_of(at, inverse, du, dv);
        const double z = -here.d / at->s - 0.5 * here.curvature * at->s;
        const double share = 0.5 * erfc(-0.7071067811865476 * z), slope = bell(z);
        const double x = du / at->size, y = dv / at->size, light = 1.0 + at->g[0] * x + at->g[1] * y;
        const double level = at->a + at->b * share, steep = light * at->b * slope, edge = steep / at->s;
        const double safe = here.r > 1e-9 ? here.r : 1e-9, c = here.w[0] / safe, s = here.w[1] / safe;
        const double grown = edge * here.per_radius;
        const double row[PARAMETERS] = {
            edge * here.n[0],
            edge * here.n[1],
            grown,
            grown * (c * c - s * s),
            grown * 2.0 * c * s,
            steep * (here.d / (at->s * at->s) - 0.5 * here.curvature),
            light,
            light * share,
            level * x,
            level * y};
        const double off = spots[k].value - light * level;
        sum += off * off;
        add_residual(N, right, row, PARAMETERS, off);
    }
    return sum;
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
static void harmonics(const circle_t *at, const spot_t *spots, int64_t count, double out[8])
{
    double inverse[4], weight = 0.0;
    memset(out, 0, 8 * sizeof(double));
    if (!inverted(at->M, inverse))
        return;
    for (int64_t k = 0; k < count; k++) {
        const double du = spots[k].u - at->c[0], dv = spots[k].v - at->c[1];
        const place_t here = place_of(at, inverse, du, dv);
        const double z = -here.d / at->s - 0.5 * here.curvature * at->s;
        const double light = 1.0 + (at->g[0] * du + at->g[1] * dv) / at->size;
        const double off = spots[k].value - light * (at->a + at->b * 0.5 * erfc(-0.7071067811865476 * z));
        const double grown = light * at->b * bell(z) / at->s * here.per_radius, angle = atan2(here.w[1], here.w[0]);
        weight += grown * grown;
        for (int n = 0; n < 4; n++) {
            out[2 * n] += grown * off * cos((n + 3) * angle);
            out[2 * n + 1] += grown * off * sin((n + 3) * angle);
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
static int set_brightness(circle_t *at, const spot_t *spots, int64_t seen)
{
    double inverse[4], total[2] = {0.0, 0.0};
    int64_t parts[2] = {0, 0};
    if (!inverted(at->M, inverse))
        return 0;
    for (int64_t k = 0; k < seen; k++) {
        const int inside = place_of(at, inverse, spots[k].u - at->c[0], spots[k].v - at->c[1]).d < 0.0;
        total[inside] += spots[k].value;
        parts[inside]++;
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

void fit_circles(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *pixels, const double *maps,
    const double *bends, const double *blur, const double *reach, const circle_rules_t *rules, int64_t most, double *scratch,
    double *out)
{
    spot_t *spots = (spot_t *)scratch;
    for (int64_t n = 0; n < count; n++) {
        double *result = out + n * CIRCLE_OUTCOMES;
        memset(result, 0, CIRCLE_OUTCOMES * sizeof(double));
        circle_t at = guessed(pixels + 2 * n, maps + 4 * n, bends + 6 * n, blur[n]);
        const double band = rules->near_sigmas * at.s + rules->near_px;
        const int64_t seen = gather(&at, grey, bytes, width, height, reach[n], band, spots, most);
        double N[PARAMETERS * PARAMETERS], step[PARAMETERS];
        if (!(seen >= rules->fewest) || !set_brightness(&at, spots, seen))
            continue;
        int solved = 1, settled = 0;
        for (int64_t k = 0; k < rules->iterations && !settled; k++) {
            linearise(&at, spots, seen, N, step);
            for (int i = 0; i < PARAMETERS; i++)
                N[i * PARAMETERS + i] *= 1.0 + 1e-9;
            solved = cholesky(N, PARAMETERS);
            if (!solved)
                break;
            cholesky_solve(N, PARAMETERS, step);
            moved(&at, step, rules);
            settled = fabs(step[X]) + fabs(step[Y]) < rules->converged_px;
        }
        if (!solved)
            continue;
        const double squares = linearise(&at, spots, seen, N, step);
        if (!cholesky(N, PARAMETERS))
            continue;
        write_circle(&at, N, squares, seen, settled, result);
        harmonics(&at, spots, seen, result + 15);
    }
}
