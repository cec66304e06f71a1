/* Hypotheses of a relative pose against matches: Sampson distances, robust qualities, and the local optimum near each
 * hypothesis. */
#include "pose.h"

#define BLOCK 64

/* Sampson distances in sigmas of a block of matches, and the reciprocals of the standard deviations of their constraints; both 0
 * where a constraint has no gradient. */
typedef struct {
    double r[BLOCK], inverse[BLOCK];
} block_t;

/* Set `out` to the distances of `size` matches from `first` on (SampsonRows.residuals). */
INLINE void distances(const double *packed, int64_t count, int64_t first, int64_t size, const double *E, block_t *out)
{
#pragma omp simd
    for (int64_t k = 0; k < size; k++) {
        const int64_t i = first + k;
        const v3_t f1 = column(packed, count, i), f2 = column(packed + 3 * count, count, i);
        const constraint_t at = constraint_of(packed, count, i, E, f1, f2);
        const double inverse = at.variance > 0.0 ? 1.0 / sqrt(at.variance) : 0.0;
        out->r[k] = at.c * inverse;
        out->inverse[k] = inverse;
    }
}

INLINE int64_t block_size(int64_t count, int64_t first)
{
    return count - first < BLOCK ? count - first : BLOCK;
}

/* SampsonRows.residuals: E (hypotheses, 9) -> out (hypotheses, count). */
FOR_EACH_PROCESSOR void residuals(const double *packed, int64_t count, const double *E, int64_t hypotheses, double *out)
{
    block_t block;
    for (int64_t h = 0; h < hypotheses; h++)
        for (int64_t first = 0; first < count; first += BLOCK) {
            const int64_t size = block_size(count, first);
            distances(packed, count, first, size, E + 9 * h, &block);
            memcpy(out + count * h + first, block.r, sizeof(double) * (size_t)size);
        }
}

/* SampsonRows.quality: the sums over the matches of E (hypotheses, 9). */
FOR_EACH_PROCESSOR void qualities(
    const double *packed, int64_t count, const double *E, int64_t hypotheses, double noise, double *out)
{
    const level_t level = level_of(noise);
    block_t block;
    for (int64_t h = 0; h < hypotheses; h++) {
        double total = 0.0;
        for (int64_t first = 0; first < count; first += BLOCK) {
            const int64_t size = block_size(count, first);
            distances(packed, count, first, size, E + 9 * h, &block);
            double sum = 0.0;
#pragma omp simd reduction(+ : sum)
            for (int64_t k = 0; k < size; k++)
                sum += quality_of(block.r[k], level);
            total += sum;
        }
        out[h] = total;
    }
}

/* SampsonRows.quality_ahead: the largest of the four sums for E = [t]x R with both rotations (hypotheses, 2, 9) and both signs of
 * t (hypotheses, 3), over the matches that are in front of both cameras or have a parallax below `sigmas`. */
FOR_EACH_PROCESSOR void qualities_ahead(
    const double *packed, int64_t count, const double *R, const double *t, int64_t hypotheses, double noise, double sigmas,
    double *out)
{
    const level_t level = level_of(noise);
    block_t block;
    for (int64_t h = 0; h < hypotheses; h++) {
        double E[9], most = 0.0;
        essential(R + 18 * h, t + 3 * h, E);
        const v3_t axis = v3(t + 3 * h);
        const double *turn = R + 18 * h;
        double sums[4] = {0.0};
        for (int64_t first = 0; first < count; first += BLOCK) {
            const int64_t size = block_size(count, first);
            double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
            distances(packed, count, first, size, E, &block);
#pragma omp simd reduction(+ : s0, s1, s2, s3)
            for (int64_t k = 0; k < size; k++) {
                const int64_t i = first + k;
                const v3_t f1 = column(packed, count, i), b = column(packed + 3 * count, count, i);
                const v3_t a = apply(turn, f1), c = apply(turn + 9, f1), of_a = cross(b, a), of_c = cross(b, c);
                const v3_t side = cross(axis, b);
                const double a1 = dot(side, of_a), a2 = dot(cross(axis, a), of_a);
                const double c1 = dot(side, of_c), c2 = dot(cross(axis, c), of_c);
                double square = 0.0;
                for (int row = 6; row < 18; row++)
                    square += packed[row * count + i] * packed[row * count + i];
                square *= 0.5 * sigmas * sigmas;
                const int far_a = dot(of_a, of_a) <= square, far_c = dot(of_c, of_c) <= square;
                const double value = quality_of(block.r[k], level);
                s0 += far_a | ((a1 >= 0.0) & (a2 >= 0.0)) ? value : 0.0;
                s1 += far_a | ((a1 <= 0.0) & (a2 <= 0.0)) ? value : 0.0;
                s2 += far_c | ((c1 >= 0.0) & (c2 >= 0.0)) ? value : 0.0;
                s3 += far_c | ((c1 <= 0.0) & (c2 <= 0.0)) ? value : 0.0;
            }
            sums[0] += s0, sums[1] += s1, sums[2] += s2, sums[3] += s3;
        }
        for (int k = 0; k < 4; k++)
            most = sums[k] > most ? sums[k] : most;
        out[h] = most;
    }
}

/* Return the quality of the pose and set its normal equations. J is the derivative of the constraint over its standard deviation,
 * which is constant during a step. */
INLINE double sum_up(const double *packed, int64_t count, level_t level, const pose_t *pose, normal_t *normal)
{
    double E[9], J[5 * BLOCK], weight[BLOCK], total = 0.0;
    const v3_t t = v3(pose->t), b1 = v3(pose->basis), b2 = v3(pose->basis + 3);
    block_t block;
    essential(pose->R, pose->t, E);
    memset(normal, 0, sizeof *normal);
    for (int64_t first = 0; first < count; first += BLOCK) {
        const int64_t size = block_size(count, first);
        distances(packed, count, first, size, E, &block);
        double quality = 0.0;
#pragma omp simd reduction(+ : quality)
        for (int64_t k = 0; k < size; k++) {
            const v3_t turned = apply(pose->R, column(packed, count, first + k));
            const v3_t f2 = column(packed + 3 * count, count, first + k);
            const v3_t by_rotation = cross(turned, cross(f2, t)), by_direction = cross(turned, f2);
            J[k] = by_rotation.x * block.inverse[k];
            J[BLOCK + k] = by_rotation.y * block.inverse[k];
            J[2 * BLOCK + k] = by_rotation.z * block.inverse[k];
            J[3 * BLOCK + k] = dot(by_direction, b1) * block.inverse[k];
            J[4 * BLOCK + k] = dot(by_direction, b2) * block.inverse[k];
            weight[k] = weight_of(block.r[k], level);
            quality += quality_of(block.r[k], level);
        }
        total += quality;
        add_rows(weight, block.r, J, BLOCK, size, normal);
    }
    return total;
}

/* SampsonRows.improved: replace R (hypotheses, 9) and t (hypotheses, 3) by the poses of locally best quality at `noise`. */
FOR_EACH_PROCESSOR void improve(
    const double *packed, int64_t count, double *R, double *t, double noise, int64_t hypotheses, const int64_t *free,
    int64_t freedom, int64_t max_steps, double settled)
{
    const level_t level = level_of(noise);
    for (int64_t h = 0; h < hypotheses; h++) {
        pose_t pose;
        normal_t normal, normal_there;
        double damping = 1e-4, step[5];
        memcpy(pose.R, R + 9 * h, sizeof pose.R);
        memcpy(pose.t, t + 3 * h, sizeof pose.t);
        fill_basis(&pose);
        double quality = sum_up(packed, count, level, &pose, &normal);
        for (int64_t k = 0; k < max_steps && damping < 1e8; k++) {
            if (!damped_step(&normal, damping, free, freedom, step))
                break;
            const pose_t there = moved(&pose, step);
            const double quality_there = sum_up(packed, count, level, &there, &normal_there);
            const int better = quality_there >= quality;
            if (better) {
                pose = there;
                quality = quality_there;
                normal = normal_there;
            }
            damping *= better ? 0.1 : 10.0;
            if (!(longest(step) > settled))
                break;
        }
        memcpy(R + 9 * h, pose.R, sizeof pose.R);
        memcpy(t + 3 * h, pose.t, sizeof pose.t);
    }
}
