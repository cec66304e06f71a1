/* The perspective camera with Brown's distortion: pixels and their derivatives. The formulas are in cameras/brown.py, the
 * definition in numpy in tests/kernels/reference/brown.py. */
#include "kernels.h"

/* Indices of the parameters. */
enum { FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6 };

/* Newton's method stops when the next step is predicted to be below this, in the plane at unit depth. */
#define SETTLED 1e-13
#define MAX_STEPS 30
/* Added to lengths that are divisors. */
#define TINY 1e-300

/* The distortion of a point (x, y) in the plane at unit depth: t = x^2 + y^2, the radial factor and its denominator, the tangential
 * terms (t + 2 x^2, 2 x y, t + 2 y^2), the distorted point m, and the symmetric dm / d(x, y). */
typedef struct {
    double t, factor, bottom, along_x, across, along_y, mx, my, xx, xy, yy;
} bent_t;

/* Return the distortion of (x, y); only the `rational` model has a denominator. */
INLINE bent_t bend(const double *k, const int rational, double x, double y)
{
    bent_t b;
    const double t = x * x + y * y, p1 = k[P1], p2 = k[P2];
    b.t = t;
    b.bottom = rational ? 1.0 + t * (k[K4] + t * (k[K5] + t * k[K6])) : 1.0;
    const double top = 1.0 + t * (k[K1] + t * (k[K2] + t * k[K3]));
    b.factor = rational ? top / b.bottom : top;
    b.along_x = t + 2.0 * (x * x), b.across = 2.0 * (x * y), b.along_y = t + 2.0 * (y * y);
    b.mx = b.factor * x + p2 * b.along_x + p1 * b.across;
    b.my = b.factor * y + p2 * b.across + p1 * b.along_y;
    /* d factor / d (x, y) is this times (x, y). */
    double slope = 2.0 * k[K1] + t * (4.0 * k[K2] + t * 6.0 * k[K3]);
    if (rational)
        slope = (slope - b.factor * (2.0 * k[K4] + t * (4.0 * k[K5] + t * 6.0 * k[K6]))) / b.bottom;
    b.xx = 6.0 * p2 * x + 2.0 * p1 * y + slope * (x * x) + b.factor;
    b.xy = 2.0 * p1 * x + 2.0 * p2 * y + slope * (x * y);
    b.yy = 2.0 * p2 * x + 6.0 * p1 * y + slope * (y * y) + b.factor;
    return b;
}

/* Write the pixels of the points and their derivatives. */
INLINE void differentiate(
    const brown_points_t *at, const int rational, double *d_pixels_d_point, double *d_pixels_d_parameters, double *u, double *v,
    uint8_t *valid)
{
    const double *k = at->parameters;
    const double fx = k[FX], fy = k[FY], cx = k[CX], cy = k[CY];
    const double farthest = at->max_r * at->max_r;
    const int64_t N = at->count, P = at->rows;
    double *by_u = d_pixels_d_parameters, *by_v = by_u + P * N;
#pragma omp simd
    for (int64_t n = 0; n < N; n++) {
        const double inverse = 1.0 / at->z[n], x = at->x[n] * inverse, y = at->y[n] * inverse;
        const bent_t b = bend(k, rational, x, y);
        const double t = b.t, factor = b.factor, bottom = b.bottom;
        const double ux = fx * inverse * b.xx, uy = fx * inverse * b.xy;
        const double vx = fy * inverse * b.xy, vy = fy * inverse * b.yy;
        if (at->axes) {
            double *by_x = d_pixels_d_point + n;
            by_x[0] = ux, by_x[N] = uy, by_x[2 * N] = -(ux * x + uy * y);
            by_x[3 * N] = vx, by_x[4 * N] = vy, by_x[5 * N] = -(vx * x + vy * y);
        }
        u[n] = fx * b.mx + cx;
        v[n] = fy * b.my + cy;
        valid[n] = (at->z[n] > 0.0) & (t <= farthest);
        if (P) {
            by_u[FX * N + n] = b.mx;
            by_v[FY * N + n] = b.my;
            by_u[CX * N + n] = by_v[CY * N + n] = 1.0;
            by_u[P1 * N + n] = fx * b.across;
            by_u[P2 * N + n] = fx * b.along_x;
            by_v[P1 * N + n] = fy * b.along_y;
            by_v[P2 * N + n] = fy * b.across;
            const double ray_u = fx * x / bottom * t, ray_v = fy * y / bottom * t;
            by_u[K1 * N + n] = ray_u;
            by_v[K1 * N + n] = ray_v;
            by_u[K2 * N + n] = ray_u * t;
            by_v[K2 * N + n] = ray_v * t;
            if (P > K3)
                by_u[K3 * N + n] = ray_u * t * t, by_v[K3 * N + n] = ray_v * t * t;
            if (rational)
                for (int64_t i = K4; i <= K6; i++) {
                    const int64_t above = (i == K6 ? K3 : i == K5 ? K2 : K1) * N + n;
                    by_u[i * N + n] = -factor * by_u[above], by_v[i * N + n] = -factor * by_v[above];
                }
        }
    }
}

EXPORT FOR_EACH_PROCESSOR void differentiate_brown(
    const brown_points_t *points, double *d_pixels_d_point, double *d_pixels_d_parameters, double *u, double *v, uint8_t *valid)
{
    if (points->rational)
        differentiate(points, 1, d_pixels_d_point, d_pixels_d_parameters, u, v, valid);
    else
        differentiate(points, 0, d_pixels_d_point, d_pixels_d_parameters, u, v, valid);
}

/* Replace `plane`, initial points, by those within `max_r` that are distorted to `m`; `valid` says which have converged. */
INLINE void undistort(
    const double *k, double max_r, const int rational, const double *m, int64_t count, double *plane, uint8_t *valid)
{
    for (int64_t n = 0; n < count; n++) {
        double x = plane[n], y = plane[count + n], before = TINY;
        valid[n] = 0;
        for (int step = 0; step < MAX_STEPS && !valid[n]; step++) {
            const bent_t b = bend(k, rational, x, y);
            const double miss_x = b.mx - m[n], miss_y = b.my - m[count + n], area = b.xx * b.yy - b.xy * b.xy;
            const double dx = (b.yy * miss_x - b.xy * miss_y) / area, dy = (b.xx * miss_y - b.xy * miss_x) / area;
            x -= dx;
            y -= dy;
            /* Clipped to the circle in which dm / d(x, y) is positive definite: Newton's method cannot reach another branch. */
            const double length = sqrt(x * x + y * y + TINY);
            if (length > max_r) {
                x *= max_r / length;
                y *= max_r / length;
            }
            /* With quadratic convergence the next step is (size / before)^2 of this one. */
            const double size = fabs(dx) + fabs(dy), slower = size < before ? size / before : 1.0;
            valid[n] = size * slower * slower <= SETTLED * (1.0 + (length < max_r ? length : max_r));
            before = size > TINY ? size : TINY;
        }
        plane[n] = x;
        plane[count + n] = y;
    }
}

EXPORT FOR_EACH_PROCESSOR void undistort_brown(
    const double *parameters, double max_r, int64_t rational, const double *m, int64_t count, double *plane, uint8_t *valid)
{
    if (rational)
        undistort(parameters, max_r, 1, m, count, plane, valid);
    else
        undistort(parameters, max_r, 0, m, count, plane, valid);
}
