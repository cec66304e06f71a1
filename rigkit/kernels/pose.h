/* Shared by the kernels of the robust and of the maximum likelihood pose: residuals of matches, weights, steps of a pose.
 *
 * Functions repeat those of the package that their comments name. The matches are 18 rows of `count` numbers
 * (local.SampsonRows.packed): the rays f1 and f2, then the columns of sigma1 B1 and of sigma2 B2, with B the derivatives of a
 * ray by its pixel. */
#ifndef RIGKIT_POSE_H
#define RIGKIT_POSE_H

#include "kernels.h"

#define QUANTILE 2.576

/* Vectors as structures: loops over matches that call functions of them are vectorised. */
typedef struct {
    double x, y, z;
} v3_t;

INLINE v3_t v3(const double *at)
{
    return (v3_t){at[0], at[1], at[2]};
}
INLINE v3_t plus(v3_t a, v3_t b)
{
    return (v3_t){a.x + b.x, a.y + b.y, a.z + b.z};
}
INLINE v3_t times(double s, v3_t a)
{
    return (v3_t){s * a.x, s * a.y, s * a.z};
}
INLINE double dot(v3_t a, v3_t b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
INLINE v3_t cross(v3_t a, v3_t b)
{
    return (v3_t){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

/* Return M v, and M^T v. */
INLINE v3_t apply(const double *M, v3_t v)
{
    return (v3_t){dot(v3(M), v), dot(v3(M + 3), v), dot(v3(M + 6), v)};
}
INLINE v3_t apply_transposed(const double *M, v3_t v)
{
    return plus(times(v.x, v3(M)), plus(times(v.y, v3(M + 3)), times(v.z, v3(M + 6))));
}

/* Return the vector of match i, from three consecutive rows of `count` numbers. */
INLINE v3_t column(const double *rows, int64_t count, int64_t i)
{
    return (v3_t){rows[i], rows[count + i], rows[2 * count + i]};
}

/* The epipolar constraint f2^T E f1 of a match, its gradients by both pixels times their sigmas, and its variance. */
typedef struct {
    double c, n1u, n1v, n2u, n2v, variance;
} constraint_t;

INLINE constraint_t constraint_of(const double *packed, int64_t count, int64_t i, const double *E, v3_t f1, v3_t f2)
{
    const v3_t line2 = apply(E, f1), line1 = apply_transposed(E, f2);
    constraint_t out;
    out.c = dot(f2, line2);
    out.n1u = dot(column(packed + 6 * count, count, i), line1);
    out.n1v = dot(column(packed + 9 * count, count, i), line1);
    out.n2u = dot(column(packed + 12 * count, count, i), line2);
    out.n2v = dot(column(packed + 15 * count, count, i), line2);
    out.variance = out.n1u * out.n1u + out.n1v * out.n1v + out.n2u * out.n2u + out.n2v * out.n2v;
    return out;
}

/* Set `E` to [t]x R. */
INLINE void essential(const double *R, const double *t, double E[9])
{
    for (int j = 0; j < 3; j++) {
        const v3_t down = cross(v3(t), (v3_t){R[j], R[3 + j], R[6 + j]});
        E[j] = down.x, E[3 + j] = down.y, E[6 + j] = down.z;
    }
}

/* A noise level, and the inverses of the divisors of the loss at it. */
typedef struct {
    double noise, near, far;
} level_t;

INLINE level_t level_of(double noise)
{
    return (level_t){noise, 1.0 / noise, 1.0 / (noise * (noise - 1.0))};
}

/* local.marginal_quality of one residual. */
INLINE double quality_of(double r, level_t level)
{
    const double rho = fabs(r) * (1.0 / QUANTILE);
    const double rest = level.noise - (rho < level.noise ? rho : level.noise);
    return rho <= 1.0 ? 1.0 - rho * rho * level.near : rest * rest * level.far;
}

/* local.marginal_weights of one residual. */
INLINE double weight_of(double r, level_t level)
{
    double low = fabs(r) * (1.0 / QUANTILE);
    low = low > 1.0 ? low : 1.0;
    low = low < level.noise ? low : level.noise;
    return (level.noise - low) * level.noise * level.far / low;
}

/* A relative pose with two unit vectors perpendicular to t, the first horizontal. */
typedef struct {
    double R[9], t[3], basis[6];
} pose_t;

/* Fill the basis (pose.translation_basis). */
INLINE void fill_basis(pose_t *pose)
{
    const double *t = pose->t, size = sqrt(t[0] * t[0] + t[2] * t[2]);
    pose->basis[0] = size > 1e-9 ? t[2] / size : 1.0;
    pose->basis[1] = 0.0;
    pose->basis[2] = size > 1e-9 ? -t[0] / size : 0.0;
    const v3_t second = cross(v3(t), v3(pose->basis));
    memcpy(pose->basis + 3, &second, sizeof second);
}

/* Write exp([w]x) R to `out` (Rodrigues' formula, its series for small angles). */
INLINE void turn(const double *R, v3_t w, double *out)
{
    const double square = dot(w, w), angle = sqrt(square);
    const int small = angle < 1e-4;
    const double first = small ? 1.0 - square / 6.0 : sin(angle) / angle;
    const double second = small ? 0.5 - square / 24.0 : (1.0 - cos(angle)) / square;
    for (int j = 0; j < 3; j++) {
        const v3_t down = {R[j], R[3 + j], R[6 + j]}, once = cross(w, down);
        const v3_t turned = plus(down, plus(times(first, once), times(second, cross(w, once))));
        out[j] = turned.x, out[3 + j] = turned.y, out[6 + j] = turned.z;
    }
}

/* Return the pose after the step (w, b): exp([w]x) R and unit(t + b1 T1 + b2 T2). */
INLINE pose_t moved(const pose_t *pose, const double step[5])
{
    pose_t out;
    const v3_t b1 = v3(pose->basis), b2 = v3(pose->basis + 3);
    turn(pose->R, v3(step), out.R);
    v3_t t = plus(v3(pose->t), plus(times(step[3], b1), times(step[4], b2)));
    t = times(1.0 / sqrt(dot(t, t)), t);
    memcpy(out.t, &t, sizeof t);
    fill_basis(&out);
    return out;
}

/* The normal equations of five unknowns: the sums of w J J^T and of w r J. */
typedef struct {
    double gram[5][5], gradient[5];
} normal_t;

/* Add `size` residuals r with weights w and derivatives J (5, stride). */
INLINE void add_rows(const double *w, const double *r, const double *J, int64_t stride, int64_t size, normal_t *out)
{
    const double *j0 = J, *j1 = J + stride, *j2 = J + 2 * stride, *j3 = J + 3 * stride, *j4 = J + 4 * stride;
    for (int p = 0; p < 5; p++) {
        /* Six independent sums at a time; the off-diagonal elements are computed twice. */
        const double *own = J + p * stride;
        double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0, s4 = 0.0, along = 0.0;
#pragma omp simd reduction(+ : s0, s1, s2, s3, s4, along)
        for (int64_t i = 0; i < size; i++) {
            const double weighted = w[i] * own[i];
            s0 += weighted * j0[i];
            s1 += weighted * j1[i];
            s2 += weighted * j2[i];
            s3 += weighted * j3[i];
            s4 += weighted * j4[i];
            along += weighted * r[i];
        }
        const double sums[5] = {s0, s1, s2, s3, s4};
        for (int q = 0; q < 5; q++)
            out->gram[p][q] += sums[q];
        out->gradient[p] += along;
    }
}

/* Write the Levenberg-Marquardt step of the `free` ones of the five unknowns, with `damping` times the diagonal added to the
 * normal equations; return whether these are positive definite. */
INLINE int damped_step(const normal_t *normal, double damping, const int64_t *free, int64_t freedom, double step[5])
{
    double m[5][6], trace = 0.0;
    for (int64_t i = 0; i < freedom; i++) {
        for (int64_t j = 0; j < freedom; j++)
            m[i][j] = normal->gram[free[i]][free[j]];
        m[i][freedom] = -normal->gradient[free[i]];
        trace += m[i][i];
    }
    for (int64_t i = 0; i < freedom; i++)
        m[i][i] += damping * m[i][i] + 1e-12 * trace + 1e-300;
    /* Positive definite: elimination needs no pivoting. */
    for (int64_t k = 0; k < freedom; k++) {
        if (!(m[k][k] > 0.0))
            return 0;
        for (int64_t i = k + 1; i < freedom; i++) {
            const double factor = m[i][k] / m[k][k];
            for (int64_t j = k; j <= freedom; j++)
                m[i][j] -= factor * m[k][j];
        }
    }
    memset(step, 0, 5 * sizeof(double));
    for (int64_t k = freedom - 1; k >= 0; k--) {
        double rest = m[k][freedom];
        for (int64_t j = k + 1; j < freedom; j++)
            rest -= m[k][j] * step[free[j]];
        step[free[k]] = rest / m[k][k];
    }
    return 1;
}

/* Return the largest absolute value of a step. */
INLINE double longest(const double step[5])
{
    double out = 0.0;
    for (int i = 0; i < 5; i++)
        out = fabs(step[i]) > out ? fabs(step[i]) : out;
    return out;
}

#endif
