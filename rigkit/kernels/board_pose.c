/* How far a rigid board's points lie from rays, and how that changes as the board moves: r = 2 T u / (1 + f . u) with f the
 * ray, T the basis across it and u the unit ray to the point. To first order that is the measured offset, 2 tan(angle / 2) in
 * general, which grows up to the opposite ray (T u alone would call the opposite ray a perfect fit). */
#include "pose.h"

/* Of the opposite ray: its residual is large, and finite. */
#define MIN_CLOSENESS 1e-9

FOR_EACH_PROCESSOR void ray_residuals(
    const double *rays, const double *bases, int64_t sets, const double *points, int64_t count, const double *rotation,
    const double *translation, int64_t poses, double *residuals, double *jacobian)
{
    for (int64_t pose = 0; pose < poses; pose++) {
        const int64_t set = sets == 1 ? 0 : pose;
        const v3_t t = v3(translation + 3 * pose);
        for (int64_t i = 0; i < count; i++) {
            const double *basis = bases + 6 * (count * set + i);
            const int64_t out = 2 * (count * pose + i);
            const v3_t f = v3(rays + 3 * (count * set + i)), lever = apply(rotation + 9 * pose, v3(points + 3 * i));
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
                const double row[POSE] = {by_turn.x, by_turn.y, by_turn.z, by_point.x, by_point.y, by_point.z};
                residuals[out + k] = 2.0 * tangent / closeness;
                memcpy(jacobian + POSE * (out + k), row, sizeof row);
            }
        }
    }
}
