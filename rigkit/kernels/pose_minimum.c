/* The maximum likelihood relative pose of matched points and affinities, by the Levenberg-Marquardt method. */
#include "pose.h"

/* All residuals over their standard deviations, with derivatives J (5, rows): those of the points, then the first ones of all
 * affinities, then the second ones. */
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
        /* The corrections of the pixels, in sigmas, are minus `step` times the gradients. */
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

/* residuals.affinity_terms with sigma_A. With a = R f1, C = R B1 and the columns B of B2 the gradients are n2 = B . (t x a) and
 * n1 = C . (f2 x t). Their derivatives by the rotation are a x (B x t) and C x (f2 x t), by the direction a x B and C x f2. The
 * pixels' part of the variance (weights.pixel_share) has M = B . (t x C). */
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
        /* residuals._half_pixel_share_jacobian */
        const double s1 = half * at[23 * chosen + k], s2 = half * at[24 * chosen + k];
        const double puu = s1 * (a1 * auu + a2 * avu) + s2 * muu, pvu = s1 * (a3 * auu + a4 * avu) + s2 * mvu;
        const double puv = s1 * (a1 * auv + a2 * avv) + s2 * muv, pvv = s1 * (a3 * auv + a4 * avv) + s2 * mvv;
        const v3_t Pu = plus(times(puu, Bu), times(pvu, Bv)), Pv = plus(times(puv, Bu), times(pvv, Bv));
        const v3_t slope_rotation = plus(cross(Cu, cross(Pu, t)), cross(Cv, cross(Pv, t)));
        const v3_t slope_direction = plus(cross(Cu, Pu), cross(Cv, Pv));
        const double gu = a1 * n2u + a3 * n2v + dot(Cu, line1), gv = a2 * n2u + a4 * n2v + dot(Cv, line1);
        const v3_t by_u = cross(a, cross(Bu, t)), by_v = cross(a, cross(Bv, t));
        const v3_t to_u = cross(a, Bu), to_v = cross(a, Bv);
        /* The second terms of the factors are the derivatives of the variance by n2. */
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

/* Return the row here of row i of the results, where both residuals of an affinity are adjacent. */
INLINE int64_t place_of(const pose_problem_t *p, int64_t i)
{
    const int64_t k = i - p->count;
    return k < 0 ? i : p->count + k / 2 + k % 2 * p->chosen;
}

/* Replace R (3, 3) and t (3,) by the minimum (PoseProblem._descend); set `r`, `w` (rows,) and `J` (rows, 5) there, with `rows` =
 * count + 2 chosen. Return the number of iterations, negated if they have not converged; 0 without degrees of freedom, NO_MEMORY
 * without memory. */
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
    while (!converged && iterations < p->max_iterations) {
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
