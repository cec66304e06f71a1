/* Residuals of a rigid board's points against rays, with derivatives by the pose: r = 2 T u / (1 + f . u) with f the measured ray,
 * T the basis perpendicular to it and u the unit ray to the point. Its length is 2 tan(angle / 2), to first order the angle, and
 * grows up to the opposite ray; T u alone would be zero there, too. */
#include "pose.h"

/* Smallest 1 + f . u: the residual of the opposite ray is large but finite. */
#define MIN_CLOSENESS 1e-9

/* Damping of Levenberg-Marquardt steps, as a factor of the diagonal of J^T J. */
#define FIRST_DAMPING 1e-4
#define MIN_DAMPING 1e-12
#define MAX_DAMPING 1e6

/* Write two rows of POSE + 1 numbers, ACROSS apart: the derivatives of the residuals of a point against the ray f, with the two
 * rows of its basis, by rotation and translation, and last the residuals. */
INLINE void point_rows(const double *ray, const double *basis, const double *point, const double *R, v3_t t, double *rows)
{
    const v3_t f = v3(ray), lever = apply(R, v3(point));
    const v3_t at = plus(lever, t);
    const double length = sqrt(dot(at, at));
    const v3_t u = {at.x / length, at.y / length, at.z / length};
    const double near = 1.0 + dot(u, f), closeness = near > MIN_CLOSENESS ? near : MIN_CLOSENESS;
    for (int64_t k = 0; k < 2; k++) {
        const v3_t b = v3(basis + 3 * k);
        const double tangent = dot(b, u);
        const v3_t by_u = times(2.0 / closeness, plus(b, times(-tangent / closeness, f)));
        const v3_t by_point = times(1.0 / length, plus(by_u, times(-dot(by_u, u), u)));
        const v3_t by_turn = cross(lever, by_point);
        const double row[POSE + 1] = {
            by_turn.x, by_turn.y, by_turn.z, by_point.x, by_point.y, by_point.z, 2.0 * tangent / closeness};
        memcpy(rows + ACROSS * k, row, sizeof row);
    }
}

FOR_EACH_PROCESSOR void ray_residuals(
    const double *rays, const double *bases, int64_t sets, const double *points, int64_t count, const double *rotation,
    const double *translation, int64_t poses, double *residuals, double *jacobian)
{
    for (int64_t pose = 0; pose < poses; pose++) {
        const int64_t set = sets == 1 ? 0 : pose;
        for (int64_t i = 0; i < count; i++) {
            const int64_t in = count * set + i, out = 2 * (count * pose + i);
            double rows[2 * ACROSS];
            point_rows(rays + 3 * in, bases + 6 * in, points + 3 * i, rotation + 9 * pose, v3(translation + 3 * pose), rows);
            for (int64_t k = 0; k < 2; k++) {
                memcpy(jacobian + POSE * (out + k), rows + ACROSS * k, POSE * sizeof(double));
                residuals[out + k] = rows[ACROSS * k + POSE];
            }
        }
    }
}

/* Write the upper triangle of `sums` (ACROSS, ACROSS): J^T J, J^T r, and last the cost r^T r. */
INLINE void pose_products(
    const double *rays, const double *bases, const double *points, int64_t count, const double *R, const double *t, double *sums)
{
    double rows[CORNERS * ACROSS];
    memset(rows, 0, sizeof rows);
    memset(sums, 0, ACROSS * ACROSS * sizeof(double));
    for (int64_t first = 0; first < count; first += CORNERS / 2) {
        const int64_t end = count < first + CORNERS / 2 ? count : first + CORNERS / 2;
        for (int64_t i = first; i < end; i++)
            point_rows(rays + 3 * i, bases + 6 * i, points + 3 * i, R, v3(t), rows + 2 * ACROSS * (i - first));
        add_products(rows, 2 * (end - first), ACROSS, sums);
    }
}

/* Write the step of the normal equations `sums` with damping; return whether they are positive definite. */
INLINE int pose_step(const double *sums, double damping, double *step)
{
    double damped[POSE * POSE];
    for (int i = 0; i < POSE; i++) {
        for (int j = 0; j <= i; j++)
            damped[POSE * i + j] = sums[ACROSS * j + i];
        damped[POSE * i + i] += damping * (damped[POSE * i + i] > 0.0 ? damped[POSE * i + i] : 1.0);
        step[i] = -sums[ACROSS * i + POSE];
    }
    if (!cholesky(damped, POSE))
        return 0;
    cholesky_solve(damped, POSE, step);
    return 1;
}

/* Return the largest absolute value of a's components. */
INLINE double largest(v3_t a)
{
    const double x = fabs(a.x), y = fabs(a.y), z = fabs(a.z);
    return x > y ? (x > z ? x : z) : (y > z ? y : z);
}

/* Levenberg-Marquardt from each pose, until a step's rotation in radians plus its translation relative to the distance is below
 * `tolerance`. */
FOR_EACH_PROCESSOR void refine_board_poses(
    const double *rays, const double *bases, int64_t sets, const double *points, int64_t count, double *rotation,
    double *translation, int64_t poses, int64_t max_steps, double tolerance, double *costs)
{
    for (int64_t pose = 0; pose < poses; pose++) {
        const int64_t set = sets == 1 ? 0 : pose;
        const double *f = rays + 3 * count * set, *b = bases + 6 * count * set;
        double *R = rotation + 9 * pose, *t = translation + 3 * pose, damping = FIRST_DAMPING;
        double here[ACROSS * ACROSS], there[ACROSS * ACROSS];
        double *const cost = here + POSE * (ACROSS + 1);
        pose_products(f, b, points, count, R, t, here);
        int done = 0;
        for (int64_t k = 0; k < max_steps && !done; k++) {
            double step[POSE], next_R[9], next_t[3], gain = 0.0;
            if (pose_step(here, damping, step)) {
                turn(R, v3(step), next_R);
                for (int i = 0; i < 3; i++)
                    next_t[i] = t[i] + step[3 + i];
                pose_products(f, b, points, count, next_R, next_t, there);
                gain = *cost - there[POSE * (ACROSS + 1)];
                done = largest(v3(step)) + largest(v3(step + 3)) / sqrt(dot(v3(t), v3(t))) < tolerance;
            }
            if (gain > 0.0) {
                memcpy(R, next_R, sizeof next_R);
                memcpy(t, next_t, sizeof next_t);
                memcpy(here, there, sizeof here);
                damping = damping * 0.1 > MIN_DAMPING ? damping * 0.1 : MIN_DAMPING;
            } else {
                done = done || damping > MAX_DAMPING;
                damping *= 10.0;
            }
        }
        costs[pose] = *cost;
    }
}
