/* The alignment of patches of two images.
 *
 * A patch of image 1 is a square of samples at offsets u from q1, which correspond to A u + q2 in image 2 up to gain and offset of
 * the brightness. The alignment is inverse compositional (Baker and Matthews, "Lucas-Kanade 20 years on", 2004): derivatives are
 * those of the patch of image 1, computed once. Images are interpolated by cubic convolution. The definitions in numpy are in
 * tests/kernels/reference/patches.py. */
#include "patch_samples.h"

void make_window(const patch_rules_t *rules, patch_t *patch)
{
    const int64_t half = rules->half;
    patch->half = half;
    patch->count = 0;
    patch->total = 0.0;
    double squares = 0.0;
    for (int64_t j = -half; j <= half; j++) {
        for (int64_t i = -half; i <= half; i++) {
            const double w = exp(-0.5 * (double)(i * i + j * j) / (rules->width * rules->width));
            patch->u[patch->count] = (float)i;
            patch->v[patch->count] = (float)j;
            patch->window[patch->count++] = (float)w;
            patch->total += w;
            squares += w * w;
        }
    }
    for (; patch->count % 16; patch->count++)
        patch->u[patch->count] = patch->v[patch->count] = patch->window[patch->count] = 0.0f;
    /* The number of samples of equal weight with the same variance of the mean. */
    patch->effective = patch->total * patch->total / squares;
}

INLINE double product(const float *a, const float *b, int64_t count)
{
    float sum = 0.0f;
#pragma omp simd reduction(+ : sum)
    for (int64_t k = 0; k < count; k++)
        sum += a[k] * b[k];
    return (double)sum;
}

/* Set `out` to the products of six rows of samples with one. */
INLINE void six_products(float rows[UNKNOWNS][MAX_SAMPLES], const float *with, int64_t count, double out[UNKNOWNS])
{
    float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f, s4 = 0.0f, s5 = 0.0f;
#pragma omp simd reduction(+ : s0, s1, s2, s3, s4, s5)
    for (int64_t k = 0; k < count; k++) {
        s0 += rows[0][k] * with[k];
        s1 += rows[1][k] * with[k];
        s2 += rows[2][k] * with[k];
        s3 += rows[3][k] * with[k];
        s4 += rows[4][k] * with[k];
        s5 += rows[5][k] * with[k];
    }
    const double sums[UNKNOWNS] = {(double)s0, (double)s1, (double)s2, (double)s3, (double)s4, (double)s5};
    memcpy(out, sums, sizeof sums);
}

/* Read the patch around (u, v) of `image` and prepare its alignment; return 0 if it has too little contrast or is not inside the
 * image. */
INLINE int take_patch(const image_t image, double u, double v, double min_contrast, patch_t *p)
{
    const int64_t half = p->half, side = 2 * half + 1, wide = side + 2, count = p->count;
    if (!is_inside(image, u - (double)half - 1.0, v - (double)half - 1.0, 0.0)
        || !is_inside(image, u + (double)half + 1.0, v + (double)half + 1.0, 0.0))
        return 0;
    float around[(MAX_SIDE + 2) * (MAX_SIDE + 2)];
    read_square(image, (float)(u - (double)(half + 1)), (float)(v - (double)(half + 1)), wide, around);
    float gradient_u[MAX_SAMPLES] = {0.0f}, gradient_v[MAX_SAMPLES] = {0.0f};
    memset(p->values + side * side, 0, (size_t)(count - side * side) * sizeof(float));
    double mean = 0.0;
    for (int64_t j = 0, k = 0; j < side; j++) {
        const float *at = around + (j + 1) * wide + 1;
        for (int64_t i = 0; i < side; i++, k++) {
            p->values[k] = at[i];
            gradient_u[k] = 0.5f * (at[i + 1] - at[i - 1]);
            gradient_v[k] = 0.5f * (at[i + wide] - at[i - wide]);
            mean += (double)(p->window[k] * at[i]);
        }
    }
    p->mean = (float)(mean / p->total);
    for (int64_t k = 0; k < count; k++) {
        p->values[k] -= p->mean;
        p->weighted[k] = p->window[k] * p->values[k];
    }
    p->energy = product(p->values, p->weighted, count);
    if (!(p->energy > min_contrast * min_contrast * p->total))
        return 0;
    for (int64_t k = 0; k < count; k++) {
        p->steep[0][k] = gradient_u[k] * p->u[k];
        p->steep[1][k] = gradient_u[k] * p->v[k];
        p->steep[2][k] = gradient_v[k] * p->u[k];
        p->steep[3][k] = gradient_v[k] * p->v[k];
        p->steep[4][k] = gradient_u[k];
        p->steep[5][k] = gradient_v[k];
    }
    double levels[UNKNOWNS], slopes[UNKNOWNS];
    six_products(p->steep, p->window, count, levels);
    six_products(p->steep, p->weighted, count, slopes);
    for (int64_t n = 0; n < UNKNOWNS; n++) {
        const float level = (float)(levels[n] / p->total), slope = (float)(slopes[n] / p->energy);
        for (int64_t k = 0; k < count; k++)
            p->steep[n][k] -= level + slope * p->values[k];
    }
    float plain[UNKNOWNS][MAX_SAMPLES];
    memcpy(plain, p->steep, sizeof plain);
    for (int64_t n = 0; n < UNKNOWNS; n++)
        for (int64_t k = 0; k < count; k++)
            p->steep[n][k] *= p->window[k];
    for (int64_t m = 0; m < UNKNOWNS; m++)
        six_products(plain, p->steep[m], count, p->normal[m]);
    return 1;
}

/* Replace the lower triangle of a symmetric matrix by its Cholesky factor; return 0 where it has none. */
INLINE int factor(double M[UNKNOWNS][UNKNOWNS])
{
    for (int64_t i = 0; i < UNKNOWNS; i++) {
        for (int64_t j = 0; j <= i; j++) {
            double sum = M[i][j];
            for (int64_t k = 0; k < j; k++)
                sum -= M[i][k] * M[j][k];
            if (i == j) {
                /* Pivots below the rounding errors of single precision count as 0. */
                if (!(sum > 1e-6 * M[i][i]))
                    return 0;
                M[i][i] = sqrt(sum);
            } else {
                M[i][j] = sum / M[j][j];
            }
        }
    }
    return 1;
}

/* Set the products of the patch of image 2 (`there`) with `steep` and with that of image 1, and its energy without offset. As
 * `steep` and the weighted patch have a sum of 0, the offset does not affect the products. */
INLINE void compare(patch_t *p, double sums[UNKNOWNS], double *common, double *energy)
{
    float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f, s4 = 0.0f, s5 = 0.0f, with = 0.0f, level = 0.0f, square = 0.0f;
#pragma omp simd reduction(+ : s0, s1, s2, s3, s4, s5, with, level, square)
    for (int64_t n = 0; n < p->count; n++) {
        /* Minus the mean of image 1, which avoids cancellation. */
        const float there = p->there[n] - p->mean, weighted = p->window[n] * there;
        s0 += p->steep[0][n] * there;
        s1 += p->steep[1][n] * there;
        s2 += p->steep[2][n] * there;
        s3 += p->steep[3][n] * there;
        s4 += p->steep[4][n] * there;
        s5 += p->steep[5][n] * there;
        with += p->weighted[n] * there;
        level += weighted;
        square += weighted * there;
    }
    sums[0] = (double)s0;
    sums[1] = (double)s1;
    sums[2] = (double)s2;
    sums[3] = (double)s3;
    sums[4] = (double)s4;
    sums[5] = (double)s5;
    *common = (double)with;
    *energy = (double)square - (double)level * (double)level / p->total;
}

/* Add the equations of the epipolar line to `matrix` and `step`; return whether there is a line. */
INLINE int add_line(
    const line_t *line, const place_t *place, double scale1, double weight, double step[UNKNOWNS],
    double matrix[UNKNOWNS][UNKNOWNS])
{
    knowledge_t known;
    if (!line_knowledge(line, place, scale1, &known))
        return 0;
    for (int64_t r = 0; r < 3; r++) {
        for (int64_t m = 0; m < UNKNOWNS; m++) {
            step[m] += weight * known.rows[r][m] * known.values[r];
            for (int64_t n = 0; n < UNKNOWNS; n++)
                matrix[m][n] += weight * known.rows[r][m] * known.rows[r][n];
        }
    }
    return 1;
}

/* Move `place` by a step: W <- W o dW^-1, that is A <- A (I + dA)^-1, q2 <- q2 - A dq with the new A. Return whether the step is
 * small enough for the linear model. */
INLINE int move_place(place_t *place, const double step[UNKNOWNS], double scale1)
{
    const double e = 1.0 + step[0], f = step[1], g = step[2], h = 1.0 + step[3];
    const double determinant = e * h - f * g;
    if (!(determinant > 0.1 && determinant < 10.0))
        return 0;
    const double before[4] = {place->A[0], place->A[1], place->A[2], place->A[3]};
    place->A[0] = (before[0] * h - before[1] * g) / determinant;
    place->A[1] = (before[1] * e - before[0] * f) / determinant;
    place->A[2] = (before[2] * h - before[3] * g) / determinant;
    place->A[3] = (before[3] * e - before[2] * f) / determinant;
    place->u2 -= scale1 * (place->A[0] * step[4] + place->A[1] * step[5]);
    place->v2 -= scale1 * (place->A[2] * step[4] + place->A[3] * step[5]);
    return 1;
}

/* Read the patch of `image2` at `place`; return whether it is inside. */
INLINE int read_there(patch_t *p, const image_t image2, double scale1, double scale2, const place_t *place)
{
    const double ratio = scale1 / scale2, half = (double)p->half;
    const float A[4] = {
        (float)(ratio * place->A[0]), (float)(ratio * place->A[1]), (float)(ratio * place->A[2]), (float)(ratio * place->A[3])};
    const double u = place->u2 / scale2, v = place->v2 / scale2;
    const double wide = half * (double)(fabsf(A[0]) + fabsf(A[1])), high = half * (double)(fabsf(A[2]) + fabsf(A[3]));
    if (!(is_inside(image2, u - wide, v - high, 0.01) && is_inside(image2, u + wide, v + high, 0.01)))
        return 0;
    read_samples(image2, (float)u, (float)v, A, p->u, p->v, p->count, p->there);
    return 1;
}

/* Align the patch `p`, of `scale1` pixels per sample around (u1, v1), with `image2`, of `scale2` pixels per sample; return whether
 * it converged. */
INLINE int align_patch(
    patch_t *p, const image_t image2, double scale1, double scale2, const patch_rules_t *rules, const line_t *line, place_t *place,
    agreement_t *out)
{
    const double half = (double)p->half, u0 = place->u2, v0 = place->v2;
    double step[UNKNOWNS], matrix[UNKNOWNS][UNKNOWNS];
    int fixed = 0;
    for (int64_t k = 0; k <= rules->max_steps; k++) {
        if (!read_there(p, image2, scale1, scale2, place))
            return 0;
        double sums[UNKNOWNS];
        double common, energy;
        compare(p, sums, &common, &energy);
        if (!(common > 0.0))
            return 0;
        out->correlation = common / sqrt(p->energy * energy);
        /* The variance of the brightness residuals; the degrees of freedom are reduced by the unknowns, gain and offset. */
        out->noise = p->energy * (1.0 - out->correlation * out->correlation) / p->total;
        out->noise = out->noise * p->effective / (p->effective - UNKNOWNS - 2.0) + rules->min_noise * rules->min_noise;
        const double gain = p->energy / common;
        for (int64_t n = 0; n < UNKNOWNS; n++)
            step[n] = gain * sums[n];
        if (line != NULL || !fixed) {
            memcpy(matrix, p->normal, sizeof matrix);
            if (line != NULL && !add_line(line, place, scale1, rules->excess_noise * out->noise, step, matrix))
                return 0;
            memcpy(out->normal, matrix, sizeof matrix);
            if (!factor(matrix))
                return 0;
            fixed = 1;
        }
        cholesky_solve(matrix[0], UNKNOWNS, step);
        if (!move_place(place, step, scale1))
            return 0;
        const double away_u = (place->u2 - u0) / scale2, away_v = (place->v2 - v0) / scale2;
        if (!(away_u * away_u + away_v * away_v < rules->max_move * rules->max_move))
            return 0;
        double border = fabs(step[4]) + fabs(step[5]);
        for (int64_t n = 0; n < 4; n++)
            border += half * fabs(step[n]);
        /* A step this small does not change the residuals. */
        if (border < rules->settled)
            return place->A[0] * place->A[3] - place->A[1] * place->A[2] > 0.0;
    }
    return 0;
}

/* Write the covariance (upper triangle) of (u2, v2, A) from the normal matrix; return the standard deviation of (u2, v2) along the
 * major axis, -1 if the matrix is singular. */
INLINE double covariance_of(const place_t *place, double scale1, const agreement_t *found, const patch_rules_t *rules, double *out)
{
    double L[UNKNOWNS][UNKNOWNS], spread[UNKNOWNS][UNKNOWNS], by[UNKNOWNS][UNKNOWNS];
    memcpy(L, found->normal, sizeof L);
    if (!factor(L))
        return -1.0;
    for (int64_t n = 0; n < UNKNOWNS; n++) {
        double unit[UNKNOWNS] = {0};
        unit[n] = 1.0;
        cholesky_solve(L[0], UNKNOWNS, unit);
        for (int64_t m = 0; m < UNKNOWNS; m++)
            spread[m][n] = unit[m];
    }
    /* Derivatives of (u2, v2, a11, a12, a21, a22) by the step: -A dq and -A dA. */
    const double *A = place->A;
    memset(by, 0, sizeof by);
    by[0][4] = -scale1 * A[0];
    by[0][5] = -scale1 * A[1];
    by[1][4] = -scale1 * A[2];
    by[1][5] = -scale1 * A[3];
    for (int64_t row = 0; row < 2; row++) {
        for (int64_t column = 0; column < 2; column++) {
            by[2 + 2 * row + column][column] = -A[2 * row];
            by[2 + 2 * row + column][2 + column] = -A[2 * row + 1];
        }
    }
    double half[UNKNOWNS][UNKNOWNS], full[UNKNOWNS][UNKNOWNS];
    for (int64_t m = 0; m < UNKNOWNS; m++) {
        for (int64_t n = 0; n < UNKNOWNS; n++) {
            half[m][n] = 0.0;
            for (int64_t k = 0; k < UNKNOWNS; k++)
                half[m][n] += by[m][k] * spread[k][n];
        }
    }
    const double variance = rules->excess_noise * found->noise;
    int64_t next = 0;
    for (int64_t m = 0; m < UNKNOWNS; m++) {
        for (int64_t n = m; n < UNKNOWNS; n++) {
            full[m][n] = 0.0;
            for (int64_t k = 0; k < UNKNOWNS; k++)
                full[m][n] += half[m][k] * by[n][k];
            out[next++] = variance * full[m][n];
        }
    }
    const double mean = 0.5 * (full[0][0] + full[1][1]), apart = 0.5 * (full[0][0] - full[1][1]);
    return sqrt(variance * (mean + sqrt(apart * apart + full[0][1] * full[0][1])));
}

/* Align the patches of a pair on the finest level that succeeds; write PATCH_COLUMNS numbers and return 1 if the result is good.
 * The image that shows the surface larger is read from a coarser level, so that both patches are equally sharp. */
FOR_EACH_PROCESSOR int align_pair(
    const pyramid_t *first, const pyramid_t *second, const patch_rules_t *rules, const line_t *line, patch_t *patch, place_t *place,
    double *out)
{
    const place_t start = *place;
    const double scale = 0.5 * log2(fabs(start.A[0] * start.A[3] - start.A[1] * start.A[2]));
    if (!isfinite(scale))
        return 0;
    const int64_t level1 = scale < -0.5 ? (int64_t)(0.5 - scale) : 0, level2 = scale > 0.5 ? (int64_t)(0.5 + scale) : 0;
    for (int64_t k = 0; k <= rules->coarsest; k++) {
        if (level1 + k >= first->count || level2 + k >= second->count)
            return 0;
        const double scale1 = ldexp(1.0, (int)(level1 + k)), scale2 = ldexp(1.0, (int)(level2 + k));
        agreement_t found;
        *place = start;
        if (!take_patch(first->levels[level1 + k], start.u1 / scale1, start.v1 / scale1, rules->min_contrast, patch))
            continue;
        if (!align_patch(patch, second->levels[level2 + k], scale1, scale2, rules, line, place, &found))
            continue;
        const double sigma = covariance_of(place, scale1, &found, rules, out + 9);
        if (!(sigma >= 0.0 && sigma < rules->max_sigma))
            continue;
        out[0] = place->u2;
        out[1] = place->v2;
        memcpy(out + 2, place->A, sizeof place->A);
        out[6] = found.correlation;
        out[7] = found.noise;
        out[8] = (double)k;
        return found.correlation >= rules->min_correlation;
    }
    return 0;
}

/* Align patches from `starts`: u1, v1, u2, v2 and the affinity row by row; all columns are NaN if this fails. */
FOR_EACH_PROCESSOR void align_patches(
    const pyramid_t *first, const pyramid_t *second, const patch_rules_t *rules, const double *starts, int64_t count, double *out)
{
    patch_t patch;
    make_window(rules, &patch);
    for (int64_t k = 0; k < count; k++) {
        const double *at = starts + 8 * k;
        place_t place = {at[0], at[1], at[2], at[3], {at[4], at[5], at[6], at[7]}};
        if (!align_pair(first, second, rules, NULL, &patch, &place, out + PATCH_COLUMNS * k))
            for (int64_t n = 0; n < PATCH_COLUMNS; n++)
                out[PATCH_COLUMNS * k + n] = NAN;
    }
}
