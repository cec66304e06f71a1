/* The model of blurred circles, seen through any smooth map (circles.c): where pixels lie on a circle, how bright they are,
 * and what its parameters change. The definition in numpy is in tests/kernels/reference/circles.py. */
#ifndef CIRCLE_MODEL_H
#define CIRCLE_MODEL_H

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
/* Beside them, what the circle's own growth changes (that of the circles beside it is in E1 to S, too), and what a blur that
 * differs with the direction changes. */
enum { OWN = COLUMNS, Q1, Q2, ROWS };
/* Further from an edge than this, in blurs, it is all one brightness: but for a part in 10^12. */
static const float FAR = 7.0f;
/* Nearer to the centre than this, in px, the way to the edge turns round with the centre, and fits do not settle. */
static const double NO_DIRECTION = 1.0;
/* Further than so many radii from a circle beside it pixels have none of its light: there its map may not be inverted. */
static const double NO_LIGHT = 2.5;

/* The pixels of a circle: arrays of their coordinates and brightness. */
typedef struct {
    double *u, *v, *value;
    int64_t count;
} spots_t;

typedef struct {
    double c[2], M[4], inverse[4], H[6], s, q[2], a, b, g[2], size;
    int inversions;
} circle_t;

/* A circle and those beside it whose edges reach into its pixels: what is lighter by two discs is so by the sum of both. They
 * grow and blur as it does: circles of one board are alike. */
typedef struct {
    circle_t own, beside[BESIDE];
    int count;
} group_t;

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

/* The blur towards the edges of a block: its variance is s^2 + q . (cos, sin) of twice the angle of the edge's normal, as that
 * of motion is; and its derivatives by s and, where `all` are wanted, by q. */
typedef struct {
    double s[BLOCK], per_s[BLOCK], by_s[BLOCK], by_q[2][BLOCK];
} blurs_t;

INLINE void towards(const double q[2], double s, const places_t *places, const int all, blurs_t *out)
{
    const double least = 0.01 * s * s, per_even = 1.0 / s;
    const int even = q[0] == 0.0 && q[1] == 0.0;
    for (int k = 0; k < BLOCK && even; k++) {
        out->s[k] = s;
        out->per_s[k] = per_even;
        out->by_s[k] = 1.0;
    }
    if (even && !all)
        return;
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double c = places->nu[k] * places->nu[k] - places->nv[k] * places->nv[k], d = 2.0 * places->nu[k] * places->nv[k];
        const double squared = s * s + q[0] * c + q[1] * d, here = sqrt(squared > least ? squared : least), per_here = 1.0 / here;
        out->s[k] = here;
        out->per_s[k] = per_here;
        out->by_s[k] = s * per_here;
        out->by_q[0][k] = 0.5 * c * per_here;
        out->by_q[1][k] = 0.5 * d * per_here;
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

/* Add the light of a circle beside it to the block's share of discs and, for growth and blur, to its rows: derivatives of the
 * share. Most blocks have none of it. */
INLINE void add_beside(
    const circle_t *at, const circle_t *from, const double du[BLOCK], const double dv[BLOCK], const int all, double total[BLOCK],
    double rows[ROWS][BLOCK])
{
    double u[BLOCK], v[BLOCK], from_it[BLOCK], z[BLOCK], share[BLOCK], slope[BLOCK], nearest = NO_LIGHT * NO_LIGHT;
    double deepest = -(double)FAR;
    places_t places;
    blurs_t blur;
    const double off_u = from->c[0] - at->c[0], off_v = from->c[1] - at->c[1];
#pragma omp simd reduction(min : nearest)
    for (int k = 0; k < BLOCK; k++) {
        u[k] = du[k] + off_u;
        v[k] = dv[k] + off_v;
        const double x = at->inverse[0] * u[k] + at->inverse[1] * v[k], y = at->inverse[2] * u[k] + at->inverse[3] * v[k];
        from_it[k] = x * x + y * y;
        nearest = from_it[k] < nearest ? from_it[k] : nearest;
    }
    if (!(nearest < NO_LIGHT * NO_LIGHT))
        return;
    place(at, u, v, &places);
    towards(from->q, from->s, &places, all, &blur);
#pragma omp simd reduction(max : deepest)
    for (int k = 0; k < BLOCK; k++) {
        const double inside = -places.d[k] * blur.per_s[k] - 0.5 * places.curvature[k] * blur.s[k];
        z[k] = from_it[k] < NO_LIGHT * NO_LIGHT ? inside : -(double)FAR;
        deepest = z[k] > deepest ? z[k] : deepest;
    }
    if (!(deepest > -(double)FAR))
        return;
    shares(z, share, slope);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double per_r = 1.0 / (places.r[k] > 1e-9 ? places.r[k] : 1e-9), c = places.x[k] * per_r, s = places.y[k] * per_r;
        const double grown = slope[k] * blur.per_s[k] * places.per_radius[k],
                     bent = 0.5 * slope[k] * places.curvature[k] * blur.s[k];
        const double wider = slope[k] * (places.d[k] * blur.per_s[k] * blur.per_s[k] - 0.5 * places.curvature[k]);
        total[k] += share[k];
        rows[E1][k] += grown + bent;
        rows[E2][k] += (grown - 3.0 * bent) * (c * c - s * s);
        rows[E3][k] += (grown - 3.0 * bent) * 2.0 * c * s;
        rows[S][k] += wider * blur.by_s[k];
        if (all) {
            rows[Q1][k] += wider * blur.by_q[0][k];
            rows[Q2][k] += wider * blur.by_q[1][k];
        }
    }
}

/* Set the places of a block, and its rows: derivatives of the brightness by the parameters, and residuals; and what else there
 * is a row of, where `all` are wanted. */
INLINE void differentiate(
    const group_t *group, const double du[BLOCK], const double dv[BLOCK], const double value[BLOCK], const int all,
    places_t *places, double rows[ROWS][BLOCK])
{
    const circle_t *at = &group->own;
    double z[BLOCK], share[BLOCK], slope[BLOCK], total[BLOCK];
    const double per_size = 1.0 / at->size;
    blurs_t blur;
    place(at, du, dv, places);
    towards(at->q, at->s, places, all, &blur);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++)
        z[k] = -places->d[k] * blur.per_s[k] - 0.5 * places->curvature[k] * blur.s[k];
    shares(z, share, slope);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double per_r = 1.0 / (places->r[k] > 1e-9 ? places->r[k] : 1e-9), c = places->x[k] * per_r, s = places->y[k] * per_r;
        const double edge = slope[k] * blur.per_s[k], grown = edge * places->per_radius[k];
        /* A larger circle is less curved; a slanted one where it is longer is more so, three times as much. */
        const double bent = 0.5 * slope[k] * places->curvature[k] * blur.s[k];
        const double wider = slope[k] * (places->d[k] * blur.per_s[k] * blur.per_s[k] - 0.5 * places->curvature[k]);
        total[k] = share[k];
        rows[X][k] = edge * places->nu[k];
        rows[Y][k] = edge * places->nv[k];
        rows[E1][k] = grown + bent;
        rows[E2][k] = (grown - 3.0 * bent) * (c * c - s * s);
        rows[E3][k] = (grown - 3.0 * bent) * 2.0 * c * s;
        rows[S][k] = wider * blur.by_s[k];
        if (all) {
            rows[OWN][k] = grown;
            rows[Q1][k] = wider * blur.by_q[0][k];
            rows[Q2][k] = wider * blur.by_q[1][k];
        }
    }
    for (int j = 0; j < group->count; j++)
        add_beside(group->beside + j, at, du, dv, all, total, rows);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double x = du[k] * per_size, y = dv[k] * per_size, light = 1.0 + at->g[0] * x + at->g[1] * y;
        const double level = at->a + at->b * total[k], steep = light * at->b;
        for (int i = X; i <= S; i++)
            rows[i][k] *= steep;
        for (int i = OWN; i < ROWS && all; i++)
            rows[i][k] *= steep;
        rows[A][k] = light;
        rows[B][k] = light * total[k];
        rows[GX][k] = level * x;
        rows[GY][k] = level * y;
        rows[OFF][k] = value[k] - light * level;
    }
}

#endif
