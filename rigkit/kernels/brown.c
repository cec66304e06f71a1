/* The perspective camera with Brown's distortion: pixels and their derivatives, point by point. cameras/brown.py has the
 * formulas, tests/kernels/reference/brown.py says in numpy what is computed. */
#include "kernels.h"

/* Where the parameters stand. */
enum { FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6 };

/* Write what the points come to; without denominator where the model is not `rational`. */
INLINE void differentiate(
    const brown_points_t *at, const int rational, double *by_point, double *by, double *u, double *v, uint8_t *valid)
{
    const double *k = at->parameters;
    const double fx = k[FX], fy = k[FY], cx = k[CX], cy = k[CY], p1 = k[P1], p2 = k[P2];
    const double farthest = at->max_r * at->max_r;
    const int64_t N = at->count, P = at->rows;
    double *by_u = by, *by_v = by + P * N;
#pragma omp simd
    for (int64_t n = 0; n < N; n++) {
        const double inverse = 1.0 / at->z[n], x = at->x[n] * inverse, y = at->y[n] * inverse;
        const double xx = x * x, xy = x * y, yy = y * y, t = xx + yy;
        const double bottom = rational ? 1.0 + t * (k[K4] + t * (k[K5] + t * k[K6])) : 1.0;
        const double top = 1.0 + t * (k[K1] + t * (k[K2] + t * k[K3]));
        const double factor = rational ? top / bottom : top;
        /* The tangential part's (t + 2 x^2, 2 x y, t + 2 y^2). */
        const double along_x = t + 2.0 * xx, across = 2.0 * xy, along_y = t + 2.0 * yy;
        const double mx = factor * x + p2 * along_x + p1 * across, my = factor * y + p2 * across + p1 * along_y;
        /* d factor / d (x, y) is this times (x, y). */
        double slope = 2.0 * k[K1] + t * (4.0 * k[K2] + t * 6.0 * k[K3]);
        if (rational)
            slope = (slope - factor * (2.0 * k[K4] + t * (4.0 * k[K5] + t * 6.0 * k[K6]))) / bottom;
        const double by_xx = 6.0 * p2 * x + 2.0 * p1 * y + slope * xx + factor;
        const double by_xy = 2.0 * p1 * x + 2.0 * p2 * y + slope * xy;
        const double by_yy = 2.0 * p2 * x + 6.0 * p1 * y + slope * yy + factor;
        const double ux = fx * inverse * by_xx, uy = fx * inverse * by_xy;
        const double vx = fy * inverse * by_xy, vy = fy * inverse * by_yy;
        if (at->axes) {
            by_point[n] = ux, by_point[N + n] = uy, by_point[2 * N + n] = -(ux * x + uy * y);
            by_point[3 * N + n] = vx, by_point[4 * N + n] = vy, by_point[5 * N + n] = -(vx * x + vy * y);
        }
        u[n] = fx * mx + cx;
        v[n] = fy * my + cy;
        valid[n] = (at->z[n] > 0.0) & (t <= farthest);
        if (P) {
            by_u[FX * N + n] = mx;
            by_v[FY * N + n] = my;
            by_u[CX * N + n] = by_v[CY * N + n] = 1.0;
            by_u[P1 * N + n] = fx * across;
            by_u[P2 * N + n] = fx * along_x;
            by_v[P1 * N + n] = fy * along_y;
            by_v[P2 * N + n] = fy * across;
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
