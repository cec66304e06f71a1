/* The model of blurred circles under a smooth map (circles.c): the coordinates of pixels relative to a circle, their brightness,
 * and its derivatives. The definition in numpy is in tests/kernels/reference/circles.py. */
#ifndef CIRCLE_MODEL_H
#define CIRCLE_MODEL_H

#include "kernels.h"

/* Parameters: centre, the symmetric matrix ((1 + e1 + e2, e3), (e3, 1 + e1 - e2)) that M is multiplied by, blur, brightness
 * outside, difference of the brightness inside, relative gradient of the light. */
enum { X, Y, E1, E2, E3, S, A, B, GX, GY, PARAMETERS };

/* Largest number of fixed-point steps w = inverse(M) (x - c - H(w, w) / 2): each reduces the error by the ratio of the second-order
 * term to the size. */
enum { INVERSIONS = 4 };
/* Error of w, in radii, at which they stop. */
static const double PLACE_ERROR = 1e-5;

/* Pixels that are processed at a time. */
enum { BLOCK = 32 };
/* Columns of the normal equations: the parameters, then the residuals. */
enum { OFF = PARAMETERS, COLUMNS };
/* Further rows: the derivatives by the radius of this circle alone (E1 to S include those of its neighbours), by the two
 * parameters of an anisotropic blur, and by the gradient of light that is added to the image (glare). */
enum { OWN = COLUMNS, Q1, Q2, LX, LY, ROWS };
/* Distance from an edge, in blurs, beyond which the brightness is constant to 1e-12. */
static const float FAR = 7.0f;
/* Distance from the centre, px, within which pixels are not used: the direction to the nearest edge depends on the centre there,
 * and fits do not converge. */
static const double NO_DIRECTION = 1.0;
/* Distance from a neighbouring circle, in radii, beyond which its light is 0: its map need not be invertible there. */
static const double NO_LIGHT = 2.5;

/* The pixels of a circle: arrays of their coordinates and brightness. */
typedef struct {
    double *u, *v, *value;
    int64_t count;
} spots_t;

/* A circle: position = c + M w + H(w, w) / 2 of the place w in radii, the inverse of M, blur s with its anisotropy q, brightness a
 * outside and a + b inside, gradient g of the light, radius `size` in px, and the fixed-point steps that invert the map. */
typedef struct {
    double c[2], M[4], inverse[4], H[6], s, q[2], a, b, g[2], size;
    int inversions;
} circle_t;

/* A circle and the neighbours whose blurred edges overlap its pixels; their light adds up. The neighbours have the same changes of
 * size and the same blur, as circles of one board. */
typedef struct {
    circle_t own, beside[BESIDE];
    int count;
} group_t;

/* Pixels relative to a circle: place (x, y) in radii and its distance r from the centre, distance d from the edge in px (positive
 * outside), unit vector n along grad r in the image, 1 / |grad r|, curvature of the edge. */
typedef struct {
    double x[BLOCK], y[BLOCK], r[BLOCK], d[BLOCK], nu[BLOCK], nv[BLOCK], per_radius[BLOCK], curvature[BLOCK];
} places_t;

/* Set `out` for the pixels at (du, dv) from the circle's centre. */
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
        /* The distance (r - 1) / |grad r| is exact to first order; the second derivative of r along n makes it exact to second. */
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

/* Set `share` to the share of the disc in pixels `z` blurs inside its edge, and `slope` to its derivative. The clipping has a loop
 * of its own: otherwise it becomes branches, which prevent vectorisation. */
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

/* The blur normal to the edge at the pixels of a block. Its variance is s^2 + q . (cos, sin) of twice the angle of the normal, as
 * that of motion blur; with its derivatives by s and, if `all` are wanted, by q. */
typedef struct {
    double s[BLOCK], per_s[BLOCK], by_s[BLOCK], by_q[2][BLOCK];
} blurs_t;

INLINE void set_blurs(const double q[2], double s, const places_t *places, const int all, blurs_t *out)
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

/* Set (du, dv) to the pixels of a block from `first` on, relative to the circle's centre, 0 beyond the last pixel; return the
 * number of pixels. */
INLINE int64_t offsets(const circle_t *at, const spots_t *spots, int64_t first, double du[BLOCK], double dv[BLOCK])
{
    const int64_t here = spots->count - first < BLOCK ? spots->count - first : BLOCK;
    for (int64_t k = 0; k < BLOCK; k++) {
        du[k] = k < here ? spots->u[first + k] - at->c[0] : 0.0;
        dv[k] = k < here ? spots->v[first + k] - at->c[1] : 0.0;
    }
    return here;
}

/* Set the inverse of M; return whether M is invertible. */
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

/* Add the light of the neighbour `at` of the circle `from` to the shares of the block, and its derivatives by size and blur to the
 * rows. Most blocks have none of it. */
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
    set_blurs(from->q, from->s, &places, all, &blur);
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

/* Set the places of a block and its rows: derivatives of the brightness by the parameters, residuals, and, if `all` are wanted, the
 * further rows. */
INLINE void differentiate(
    const group_t *group, const double du[BLOCK], const double dv[BLOCK], const double value[BLOCK], const int all,
    places_t *places, double rows[ROWS][BLOCK])
{
    const circle_t *at = &group->own;
    double z[BLOCK], share[BLOCK], slope[BLOCK], total[BLOCK];
    const double per_size = 1.0 / at->size;
    blurs_t blur;
    place(at, du, dv, places);
    set_blurs(at->q, at->s, places, all, &blur);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++)
        z[k] = -places->d[k] * blur.per_s[k] - 0.5 * places->curvature[k] * blur.s[k];
    shares(z, share, slope);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double per_r = 1.0 / (places->r[k] > 1e-9 ? places->r[k] : 1e-9), c = places->x[k] * per_r, s = places->y[k] * per_r;
        const double edge = slope[k] * blur.per_s[k], grown = edge * places->per_radius[k];
        /* A larger circle has less curvature. The curvature of an ellipse changes with its axes three times as much, and with the
         * other sign: more where the ellipse is longer. */
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
        for (int i = OWN; i <= Q2 && all; i++)
            rows[i][k] *= steep;
        if (all) {
            rows[LX][k] = x;
            rows[LY][k] = y;
        }
        rows[A][k] = light;
        rows[B][k] = light * total[k];
        rows[GX][k] = level * x;
        rows[GY][k] = level * y;
        rows[OFF][k] = value[k] - light * level;
    }
}

#endif
