/* Kernels of the robust and of the maximum likelihood pose: hypotheses against matches.
 *
 * Every function repeats the one of the package that its comment names. The matches come as 18 rows of `count` numbers
 * (local.SampsonRows.packed): the rays f1 and f2, then by pixel coordinate the columns of sigma1 B1 and of sigma2 B2. */
#include "kernels.h"

#define BLOCK 64
#define QUANTILE 2.576

/* Vectors without loops, so that the loops over matches around them are vectorised. */
typedef struct {
    double x, y, z;
} v3_t;

INLINE v3_t v3(const double *at) { return (v3_t){at[0], at[1], at[2]}; }
INLINE v3_t plus(v3_t a, v3_t b) { return (v3_t){a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE v3_t times(double s, v3_t a) { return (v3_t){s * a.x, s * a.y, s * a.z}; }
INLINE double dot(v3_t a, v3_t b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
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

/* Three successive rows of numbers, `count` each, at one match. */
INLINE v3_t column(const double *rows, int64_t count, int64_t i)
{
    return (v3_t){rows[i], rows[count + i], rows[2 * count + i]};
}

/* What a match says of E: the constraint f2^T E f1 and its gradients by both pixels, in sigmas. */
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

/* Distances in sigmas of a block of matches, and one over the sigmas of their constraints, both zero where it has no
 * gradient. */
typedef struct {
    double r[BLOCK], inverse[BLOCK];
} block_t;

/* Fill `out` with `size` distances of the matches from `first` on (SampsonRows.residuals). */
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

INLINE int64_t block_size(int64_t count, int64_t first) { return count - first < BLOCK ? count - first : BLOCK; }

/* Return [t]x R in `E`. */
INLINE void essential(const double *R, const double *t, double E[9])
{
    for (int j = 0; j < 3; j++) {
        const v3_t down = cross(v3(t), (v3_t){R[j], R[3 + j], R[6 + j]});
        E[j] = down.x, E[3 + j] = down.y, E[6 + j] = down.z;
    }
}

/* A noise level, and what the loss at it divides by: inverted once, not for every match. */
typedef struct {
    double noise, near, far;
} level_t;

INLINE level_t level_of(double noise) { return (level_t){noise, 1.0 / noise, 1.0 / (noise * (noise - 1.0))}; }

/* marginal.marginal_quality of one residual. */
INLINE double quality_of(double r, level_t level)
{
    const double rho = fabs(r) * (1.0 / QUANTILE);
    const double rest = level.noise - (rho < level.noise ? rho : level.noise);
    return rho <= 1.0 ? 1.0 - rho * rho * level.near : rest * rest * level.far;
}

/* marginal.marginal_weights of one residual. */
INLINE double weight_of(double r, level_t level)
{
    double low = fabs(r) * (1.0 / QUANTILE);
    low = low > 1.0 ? low : 1.0;
    low = low < level.noise ? low : level.noise;
    return (level.noise - low) * level.noise * level.far / low;
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

/* SampsonRows.quality_ahead: the greatest of the four sums of E = [t]x R with both rotations (hypotheses, 2, 9) and both
 * signs of t (hypotheses, 3), over the matches that are not behind a camera by a parallax of so many `sigmas`. */
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

/* Return the pose after the step (w, b): exp([w]x) R and unit(t + b1 T1 + b2 T2). */
INLINE pose_t moved(const pose_t *pose, const double step[5])
{
    pose_t out;
    const v3_t w = v3(step), b1 = v3(pose->basis), b2 = v3(pose->basis + 3);
    const double square = dot(w, w), angle = sqrt(square);
    const int small = angle < 1e-4;
    const double first = small ? 1.0 - square / 6.0 : sin(angle) / angle;
    const double second = small ? 0.5 - square / 24.0 : (1.0 - cos(angle)) / square;
    for (int j = 0; j < 3; j++) {
        const v3_t down = {pose->R[j], pose->R[3 + j], pose->R[6 + j]}, once = cross(w, down);
        const v3_t turned = plus(down, plus(times(first, once), times(second, cross(w, once))));
        out.R[j] = turned.x, out.R[3 + j] = turned.y, out.R[6 + j] = turned.z;
    }
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
        /* Six sums at a time, none of which waits for the others; half of the matrix is computed twice. */
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

/* Write the step of the `free` ones of five unknowns, with a share `damping` of the diagonal added to it; return whether
 * it exists. */
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

INLINE double longest(const double step[5])
{
    double out = 0.0;
    for (int i = 0; i < 5; i++)
        out = fabs(step[i]) > out ? fabs(step[i]) : out;
    return out;
}

/* Return the quality of the pose; fill its normal equations. J is the derivative of the constraint over its sigma: the
 * sigma is held during a step. */
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

/* SampsonRows.improved: R (hypotheses, 9) and t (hypotheses, 3) move to the best quality at `noise`. */
FOR_EACH_PROCESSOR void improve(
    const double *packed, int64_t count, double *R, double *t, double noise, int64_t hypotheses,
    const int64_t *free, int64_t freedom, int64_t most_steps, double settled)
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
        for (int64_t k = 0; k < most_steps && damping < 1e8; k++) {
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

/* All residuals in sigmas, with derivatives J (5, rows): first the points, then the first, then the second of each
 * affinity. */
typedef struct {
    double *r, *J;
} terms_t;

/* residuals.point_terms. */
INLINE void point_terms(const pose_problem_t *p, const pose_t pose, int64_t rows, terms_t out)
{
    const int64_t count = p->count;
    const double *packed = p->packed;
    const v3_t t = v3(pose.t), b1 = v3(pose.basis), b2 = v3(pose.basis + 3);
    double E[9];
    essential(pose.R, pose.t, E);
#pragma omp simd
    for (int64_t i = 0; i < count; i++) {
        v3_t f1 = column(packed, count, i), f2 = column(packed + 3 * count, count, i);
        const constraint_t first = constraint_of(packed, count, i, E, f1, f2);
        /* In sigmas the displacement of the pixels is minus `step` times the gradients. */
        const double step = first.variance > 0.0 ? first.c / first.variance : 0.0;
        f1 = plus(f1, times(-step * first.n1u, column(packed + 6 * count, count, i)));
        f1 = plus(f1, times(-step * first.n1v, column(packed + 9 * count, count, i)));
        f2 = plus(f2, times(-step * first.n2u, column(packed + 12 * count, count, i)));
        f2 = plus(f2, times(-step * first.n2v, column(packed + 15 * count, count, i)));
        f1 = times(1.0 / sqrt(dot(f1, f1)), f1);
        f2 = times(1.0 / sqrt(dot(f2, f2)), f2);
        const constraint_t then = constraint_of(packed, count, i, E, f1, f2);
        const double inverse = then.variance > 0.0 ? 1.0 / sqrt(then.variance) : 0.0;
        const double back = then.n1u * first.n1u + then.n1v * first.n1v + then.n2u * first.n2u + then.n2v * first.n2v;
        const v3_t turned = apply(pose.R, f1);
        const v3_t by_rotation = cross(turned, cross(f2, t)), by_direction = cross(turned, f2);
        out.r[i] = (then.c + step * back) * inverse;
        out.J[i] = by_rotation.x * inverse;
        out.J[rows + i] = by_rotation.y * inverse;
        out.J[2 * rows + i] = by_rotation.z * inverse;
        out.J[3 * rows + i] = dot(by_direction, b1) * inverse;
        out.J[4 * rows + i] = dot(by_direction, b2) * inverse;
    }
}

/* residuals.affinity_terms with sigma_A. With a = R f1, C = R B1 and the columns B of B2 the gradients are n2 = B . (t x a)
 * and n1 = C . (f2 x t); by rotation a x (B x t) and C x (f2 x t), by direction a x B and C x f2. In the pixels' share of
 * the variance (weights.pixel_share) M = B . (t x C). */
INLINE void affinity_terms(const pose_problem_t *p, const pose_t pose, int64_t rows, terms_t out)
{
    const int64_t count = p->count, chosen = p->chosen;
    const double *at = p->affine;
    const v3_t t = v3(pose.t), b1 = v3(pose.basis), b2 = v3(pose.basis + 3);
#pragma omp simd
    for (int64_t k = 0; k < chosen; k++) {
        const v3_t a = apply(pose.R, column(at, chosen, k)), f2 = column(at + 3 * chosen, chosen, k);
        const v3_t Cu = apply(pose.R, column(at + 6 * chosen, chosen, k));
        const v3_t Cv = apply(pose.R, column(at + 9 * chosen, chosen, k));
        const v3_t Bu = column(at + 12 * chosen, chosen, k), Bv = column(at + 15 * chosen, chosen, k);
        const v3_t line2 = cross(t, a), line1 = cross(f2, t);
        const double n2u = dot(Bu, line2), n2v = dot(Bv, line2), square = n2u * n2u + n2v * n2v;
        const double a1 = at[18 * chosen + k], a2 = at[19 * chosen + k];
        const double a3 = at[20 * chosen + k], a4 = at[21 * chosen + k];
        const v3_t turned_u = cross(t, Cu), turned_v = cross(t, Cv);
        const double muu = dot(Bu, turned_u), muv = dot(Bu, turned_v), mvu = dot(Bv, turned_u), mvv = dot(Bv, turned_v);
        const double auu = a1 * muu + a3 * mvu, auv = a1 * muv + a3 * mvv;
        const double avu = a2 * muu + a4 * mvu, avv = a2 * muv + a4 * mvv;
        const double share1 = at[23 * chosen + k] * (auu * auu + auv * auv + avu * avu + avv * avv);
        const double share2 = at[24 * chosen + k] * (muu * muu + muv * muv + mvu * mvu + mvv * mvv);
        const double variance = at[22 * chosen + k] * square + 0.5 * (share1 + share2);
        const double scale = variance > 0.0 ? 1.0 / sqrt(variance) : 0.0;
        const double half = variance > 0.0 ? 0.5 / variance : 0.0, inverse = 2.0 * half * at[22 * chosen + k];
        /* residuals._half_slope */
        const double s1 = half * at[23 * chosen + k], s2 = half * at[24 * chosen + k];
        const double puu = s1 * (a1 * auu + a2 * avu) + s2 * muu, pvu = s1 * (a3 * auu + a4 * avu) + s2 * mvu;
        const double puv = s1 * (a1 * auv + a2 * avv) + s2 * muv, pvv = s1 * (a3 * auv + a4 * avv) + s2 * mvv;
        const v3_t Pu = plus(times(puu, Bu), times(pvu, Bv)), Pv = plus(times(puv, Bu), times(pvv, Bv));
        const v3_t slope_rotation = plus(cross(Cu, cross(Pu, t)), cross(Cv, cross(Pv, t)));
        const v3_t slope_direction = plus(cross(Cu, Pu), cross(Cv, Pv));
        const double gu = a1 * n2u + a3 * n2v + dot(Cu, line1), gv = a2 * n2u + a4 * n2v + dot(Cv, line1);
        const v3_t by_u = cross(a, cross(Bu, t)), by_v = cross(a, cross(Bv, t));
        const v3_t to_u = cross(a, Bu), to_v = cross(a, Bv);
        /* The second terms of the factors: how the variance changes with n2. */
        const double uu = a1 - gu * n2u * inverse, uv = a3 - gu * n2v * inverse;
        const double vu = a2 - gv * n2u * inverse, vv = a4 - gv * n2v * inverse;
        const v3_t by_line_u = plus(cross(Cu, line1), times(-gu, slope_rotation));
        const v3_t by_line_v = plus(cross(Cv, line1), times(-gv, slope_rotation));
        const v3_t to_line_u = plus(cross(Cu, f2), times(-gu, slope_direction));
        const v3_t to_line_v = plus(cross(Cv, f2), times(-gv, slope_direction));
        const v3_t rotation_u = plus(plus(times(uu, by_u), times(uv, by_v)), by_line_u);
        const v3_t rotation_v = plus(plus(times(vu, by_u), times(vv, by_v)), by_line_v);
        const v3_t direction_u = plus(plus(times(uu, to_u), times(uv, to_v)), to_line_u);
        const v3_t direction_v = plus(plus(times(vu, to_u), times(vv, to_v)), to_line_v);
        const int64_t u = count + k, v = u + chosen;
        out.r[u] = gu * scale;
        out.r[v] = gv * scale;
        out.J[u] = rotation_u.x * scale;
        out.J[v] = rotation_v.x * scale;
        out.J[rows + u] = rotation_u.y * scale;
        out.J[rows + v] = rotation_v.y * scale;
        out.J[2 * rows + u] = rotation_u.z * scale;
        out.J[2 * rows + v] = rotation_v.z * scale;
        out.J[3 * rows + u] = dot(direction_u, b1) * scale;
        out.J[3 * rows + v] = dot(direction_v, b1) * scale;
        out.J[4 * rows + u] = dot(direction_u, b2) * scale;
        out.J[4 * rows + v] = dot(direction_v, b2) * scale;
    }
}

/* Return the weight by one of the losses: none, Cauchy, marginal (PoseProblem._loss). */
INLINE double robust_weight(const pose_problem_t *p, double r)
{
    if (p->loss == 1)
        return 1.0 / (1.0 + (r / p->scale) * (r / p->scale));
    return p->loss == 2 ? weight_of(r, level_of(p->scale)) : 1.0;
}

/* PoseProblem._weights. */
INLINE void weigh(const pose_problem_t *p, const double *r, double *w)
{
    for (int64_t i = 0; i < p->count; i++)
        w[i] = p->point_weights[i] * robust_weight(p, r[i]);
    for (int64_t k = 0; k < p->chosen; k++) {
        const int64_t u = p->count + k, v = u + p->chosen;
        const double weight = w[p->which[k]] * robust_weight(p, sqrt(0.5 * (r[u] * r[u] + r[v] * r[v])));
        w[u] = w[v] = weight;
    }
}

INLINE double weighted_squares(const double *w, const double *r, int64_t rows)
{
    double sum = 0.0;
#pragma omp simd reduction(+ : sum)
    for (int64_t i = 0; i < rows; i++)
        sum += w[i] * r[i] * r[i];
    return sum;
}

/* Where row i of numpy's order is here: there the two of an affinity follow each other. */
INLINE int64_t place_of(const pose_problem_t *p, int64_t i)
{
    const int64_t k = i - p->count;
    return k < 0 ? i : p->count + k / 2 + k % 2 * p->chosen;
}

/* PoseProblem._minimum: R (9,) and t (3,) move to the minimum; `r`, `w` (rows,) and `J` (rows, 5) there, `rows` = count + 2
 * chosen. Returns the iterations, negative if not converged; 0 without freedom, and NO_MEMORY without memory. */
FOR_EACH_PROCESSOR int64_t minimise(const pose_problem_t *p, double *R, double *t, double *r, double *J, double *w)
{
    const int64_t rows = p->count + 2 * p->chosen;
    double *memory = malloc(sizeof(double) * (size_t)(13 * rows + 1));
    if (!memory)
        return NO_MEMORY;
    terms_t here = {memory, memory + rows}, there = {memory + 6 * rows, memory + 7 * rows};
    double *weights = memory + 12 * rows, damping = 1e-6, step[5];
    pose_t pose;
    memcpy(pose.R, R, sizeof pose.R);
    memcpy(pose.t, t, sizeof pose.t);
    fill_basis(&pose);
    point_terms(p, pose, rows, here);
    affinity_terms(p, pose, rows, here);
    weigh(p, here.r, weights);
    normal_t normal;
    memset(&normal, 0, sizeof normal);
    add_rows(weights, here.r, here.J, rows, rows, &normal);
    int converged = p->freedom == 0;
    int64_t iterations = 0;
    while (!converged && iterations < p->most_iterations) {
        iterations++;
        if (!damped_step(&normal, damping, p->free, p->freedom, step))
            break;
        const pose_t next = moved(&pose, step);
        point_terms(p, next, rows, there);
        affinity_terms(p, next, rows, there);
        converged = longest(step) < p->tolerance;
        if (weighted_squares(weights, there.r, rows) <= weighted_squares(weights, here.r, rows) * (1.0 + 1e-14)) {
            const terms_t kept = here;
            here = there;
            there = kept;
            pose = next;
            weigh(p, here.r, weights);
            memset(&normal, 0, sizeof normal);
            add_rows(weights, here.r, here.J, rows, rows, &normal);
            damping = damping * 0.1 > 1e-12 ? damping * 0.1 : 1e-12;
        } else {
            converged = converged || damping > 1e8;
            damping *= 10.0;
        }
    }
    memcpy(R, pose.R, sizeof pose.R);
    memcpy(t, pose.t, sizeof pose.t);
    for (int64_t i = 0; i < rows; i++) {
        const int64_t at = place_of(p, i);
        r[i] = here.r[at];
        w[i] = weights[at];
        for (int q = 0; q < 5; q++)
            J[5 * i + q] = here.J[q * rows + at];
    }
    free(memory);
    return converged ? iterations : -iterations;
}
