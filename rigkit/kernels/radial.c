/* Rotationally symmetric cameras, Kannala-Brandt's and Scaramuzza's: pixels and their derivatives. The formulas are in
 * cameras/radial.py, kannala_brandt.py and scaramuzza.py, the definition in numpy in tests/kernels/reference/radial.py. */
#include "monotone.h"

/* Return the angle, 0 to pi, of a unit vector with these components across and along the axis, to four rounding errors; unlike
 * atan2 it is vectorised with the loop around it. An eighth of it has a tangent x below tan(pi / 8), where the arc tangent is
 * x P(x^2), with P interpolated at Chebyshev points and an error below 4e-17. */
INLINE double angle_of(double across, double along)
{
    static const double P[] = {
        1.0,
        -0.3333333333332844,
        0.1999999999885511,
        -0.14285714180976467,
        0.11111106180455946,
        -0.09090773074808414,
        0.07689953496306857,
        -0.06640233930429408,
        0.056883492268090106,
        -0.04348052215716462,
        0.021135373157693246};
    /* Sine and cosine of half the angle; the larger one is computed first, which avoids cancellation. */
    const double larger = sqrt(0.5 * (1.0 + fabs(along))), smaller = 0.5 * across / larger;
    const double sine = along < 0.0 ? larger : smaller, cosine = along < 0.0 ? smaller : larger;
    const double fourth = sine / (1.0 + cosine), x = fourth / (1.0 + sqrt(1.0 + fourth * fourth)), t = x * x;
    const double t2 = t * t, t4 = t2 * t2;
    const double low = (P[0] + P[1] * t) + (P[2] + P[3] * t) * t2, high = (P[4] + P[5] * t) + (P[6] + P[7] * t) * t2;
    return 8.0 * x * (low + t4 * (high + t4 * (P[8] + t * (P[9] + t * P[10]))));
}

/* Scales s of POINTS points with their derivatives (ds/dr) / r, ds/dz and by the first coefficient of the model; each further
 * coefficient's derivative is `factor` times the previous one. */
typedef struct {
    double scale[POINTS], by_r[POINTS], by_z[POINTS], by_shape[POINTS], factor[POINTS];
} scales_t;

enum {
    /* Number of samples of the angle over the radius, and of cells of the table of its inverse, from which Newton starts. */
    KNOTS = 129,
    CELLS = 4 * (KNOTS - 1)
};

/* Write pixel = L s (x, y) + centre and its derivatives by the point for `count` points from `first` on. */
INLINE void write_points(
    const radial_points_t *at, const scales_t *of, int64_t first, int64_t count, double *d_pixels_d_point, double *u, double *v)
{
    const double l00 = at->l00, l01 = at->l01, l11 = at->l11;
    const int64_t N = at->count;
    double *by_u = d_pixels_d_point + first, *by_v = by_u + 3 * N;
#pragma omp simd
    for (int64_t i = 0; i < count; i++) {
        const double x = at->x[first + i], y = at->y[first + i], scale = of->scale[i];
        const double lx = l00 * x + l01 * y, ly = l11 * y;
        u[first + i] = scale * lx + at->cx;
        v[first + i] = scale * ly + at->cy;
        if (at->axes) {
            const double rx = of->by_r[i] * x, ry = of->by_r[i] * y;
            by_u[i] = lx * rx + l00 * scale;
            by_u[N + i] = lx * ry + l01 * scale;
            by_u[2 * N + i] = lx * of->by_z[i];
            by_v[i] = ly * rx;
            by_v[N + i] = ly * ry + l11 * scale;
            by_v[2 * N + i] = ly * of->by_z[i];
        }
    }
}

/* Write the derivatives by `terms` coefficients of the model from row `from` on; from the first to the second the power of `factor`
 * grows by `gap`. */
INLINE void write_shape(
    const radial_points_t *at, scales_t *of, int64_t first, int64_t count, int64_t from, int64_t terms, int64_t gap,
    double *d_pixels_d_parameters)
{
    const int64_t N = at->count;
    for (int64_t k = 0; k < terms; k++) {
        double *by_u = d_pixels_d_parameters + (from + k) * N + first, *by_v = by_u + at->rows * N;
#pragma omp simd
        for (int64_t i = 0; i < count; i++) {
            const double x = at->x[first + i], y = at->y[first + i];
            by_u[i] = of->by_shape[i] * (at->l00 * x + at->l01 * y);
            by_v[i] = of->by_shape[i] * (at->l11 * y);
            of->by_shape[i] *= k ? of->factor[i] : gap == 2 ? of->factor[i] * of->factor[i] : of->factor[i];
        }
    }
}

/* s = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r (Kannala and Brandt, "A generic camera model and
 * calibration method for conventional, wide-angle, and fish-eye lenses", 2006, equation 6 with a first coefficient of 1). */
EXPORT FOR_EACH_PROCESSOR void differentiate_kannala_brandt(
    const radial_points_t *at, double *d_pixels_d_point, double *d_pixels_d_parameters, double *u, double *v, uint8_t *valid)
{
    const double k1 = at->polynomial[0], k2 = at->polynomial[1], k3 = at->polynomial[2], k4 = at->polynomial[3];
    const double max_angle = at->max_angle;
    const int64_t N = at->count;
    for (int64_t first = 0; first < N; first += POINTS) {
        const int64_t count = N - first < POINTS ? N - first : POINTS;
        scales_t of;
        double inside[POINTS];
        const double *xs = at->x + first, *ys = at->y + first, *zs = at->z + first;
#pragma omp simd
        for (int64_t i = 0; i < count; i++) {
            const double x = xs[i], y = ys[i], z = zs[i];
            const double r2 = x * x + y * y, r = sqrt(r2), length2 = r2 + z * z, per = 1.0 / sqrt(length2);
            const double angle = angle_of(r * per, z * per), t = angle * angle, per_r = 1.0 / r;
            const double ratio = r2 > 0.0 ? angle * per_r : per;
            const double limit = length2 < INFINITY ? max_angle : -1.0, ahead = r2 > 0.0 ? 1.0 : z;
            inside[i] = angle <= limit ? ahead : 0.0;
            const double scale = ratio * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))));
            const double slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)));
            /* d theta / d r = z / |X|^2, d theta / d z = -r / |X|^2. */
            const double by_angle = slope * per * per, by_r = (by_angle * z - scale) * per_r * per_r;
            of.scale[i] = scale;
            of.by_r[i] = r2 > 0.0 ? by_r : 0.0;
            of.by_z[i] = -by_angle;
            of.by_shape[i] = ratio * t;
            of.factor[i] = t;
        }
        for (int64_t i = 0; i < count; i++)
            valid[first + i] = inside[i] > 0.0;
        write_points(at, &of, first, count, d_pixels_d_point, u, v);
        if (!at->rows)
            continue;
        double *by_u = d_pixels_d_parameters + first, *by_v = by_u + at->rows * N;
        for (int64_t i = 0; i < count; i++) {
            by_u[i] = of.scale[i] * at->x[first + i];
            by_v[N + i] = of.scale[i] * at->y[first + i];
            by_u[2 * N + i] = by_v[3 * N + i] = 1.0;
        }
        write_shape(at, &of, first, count, 4, at->terms, 1, d_pixels_d_parameters);
    }
}

/* Set `table` to the radii at equal steps of the angle; return the largest angle. */
static double fill_table(const radial_points_t *at, double table[CELLS + 1])
{
    double angles[KNOTS];
    const double step = at->max_radius / (double)(KNOTS - 1);
    for (int64_t j = 0; j < KNOTS; j++) {
        double f = 0.0;
        for (int64_t k = at->terms - 1; k >= 0; k--)
            f = f * (step * (double)j) + at->polynomial[k];
        angles[j] = atan2(step * (double)j, f);
    }
    int64_t j = 0;
    for (int64_t c = 0; c <= CELLS; c++) {
        const double angle = angles[KNOTS - 1] * (double)c / (double)CELLS;
        while (j < KNOTS - 2 && angles[j + 1] < angle)
            j++;
        table[c] = step * ((double)j + limited((angle - angles[j]) / (angles[j + 1] - angles[j]), 1.0));
    }
    return angles[KNOTS - 1];
}

/* Angles between POINTS points and the axis with sines, their negatives, cosines, and the reciprocals of the points' lengths. */
typedef struct {
    double angle[POINTS], sine[POINTS], minus_sine[POINTS], cosine[POINTS], per[POINTS];
} directions_t;

/* Set `out` for `count` points from `first` on, with those beyond `max_angle` replaced by the axis. */
INLINE void directions_of(
    const radial_points_t *at, int64_t first, int64_t count, double max_angle, directions_t *out, uint8_t *valid)
{
    const double *xs = at->x + first, *ys = at->y + first, *zs = at->z + first;
    double inside[POINTS];
#pragma omp simd
    for (int64_t i = 0; i < count; i++) {
        const double x = xs[i], y = ys[i], z = zs[i];
        const double r2 = x * x + y * y, length2 = r2 + z * z, per = 1.0 / sqrt(length2), r = sqrt(r2) * per;
        const double theta = angle_of(r, z * per), limit = length2 < INFINITY ? max_angle : -1.0;
        inside[i] = theta <= limit ? length2 : 0.0;
        out->angle[i] = theta <= limit ? theta : 0.0;
        out->sine[i] = theta <= limit ? r : 0.0;
        out->minus_sine[i] = theta <= limit ? -r : 0.0;
        out->cosine[i] = theta <= limit ? z * per : 1.0;
        out->per[i] = per;
    }
    for (int64_t i = 0; i < count; i++)
        valid[i] = inside[i] > 0.0;
}

/* s = rho / r with rho the root of z rho = r f(rho) (Scaramuzza, Martinelli and Siegwart, "A toolbox for easily calibrating
 * omnidirectional cameras", 2006). */
EXPORT FOR_EACH_PROCESSOR void differentiate_scaramuzza(
    const radial_points_t *at, double *d_pixels_d_point, double *d_pixels_d_parameters, double *u, double *v, uint8_t *valid)
{
    double table[CELLS + 1], rho[POINTS], f[POINTS], slope[POINTS];
    directions_t seen;
    const double zero[POINTS] = {0.0}, max_angle = fill_table(at, table), a0 = at->polynomial[0];
    const int64_t N = at->count, n = at->terms - 1;
    /* z rho - r f = |(rho, f)| sin(angle(rho) - theta) changes its sign once in the range, from minus to plus. */
    const increasing_t g = {at->polynomial, seen.cosine, seen.minus_sine, zero, seen.angle,    table, at->terms, POINTS,
                            CELLS,          0.0,         max_angle,       0.0,  at->max_radius};
    for (int64_t first = 0; first < N; first += POINTS) {
        const int64_t count = N - first < POINTS ? N - first : POINTS;
        scales_t of;
        directions_of(at, first, count, max_angle, &seen, valid + first);
        invert(&g, 0, count, rho);
        for (int64_t i = 0; i < count; i++)
            f[i] = slope[i] = 0.0;
        for (int64_t k = n; k >= 0; k--)
#pragma omp simd
            for (int64_t i = 0; i < count; i++) {
                slope[i] = slope[i] * rho[i] + f[i];
                f[i] = f[i] * rho[i] + at->polynomial[k];
            }
#pragma omp simd
        for (int64_t i = 0; i < count; i++) {
            /* d rho / d r = -f / D, d rho / d z = rho / D, d rho / d a_k = -r rho^k / D at unit length; s is homogeneous of
             * degree -1, ds/dz of degree -2 and ds/dr, which is divided by r once more, of degree -3. */
            const double r = seen.sine[i], inverse = 1.0 / (r * slope[i] - seen.cosine[i]), off = rho[i] / r, per = seen.per[i];
            const double scale = r > 0.0 ? off : a0, by_r = (-f[i] * inverse - scale) / (r * r);
            of.scale[i] = scale * per;
            of.by_r[i] = r > 0.0 ? by_r * per * per * per : 0.0;
            of.by_z[i] = scale * inverse * per * per;
            of.by_shape[i] = -inverse * per;
            of.factor[i] = rho[i];
        }
        write_points(at, &of, first, count, d_pixels_d_point, u, v);
        if (!at->rows)
            continue;
        write_shape(at, &of, first, count, 0, n, 2, d_pixels_d_parameters);
        double *by_u = d_pixels_d_parameters + n * N + first, *by_v = by_u + at->rows * N;
        for (int64_t i = 0; i < count; i++) {
            by_u[i] = by_v[N + i] = 1.0;
            by_u[2 * N + i] = of.scale[i] * at->x[first + i];
            by_u[3 * N + i] = of.scale[i] * at->y[first + i];
        }
    }
}
