/* Patches of two images aligned, and grown over a surface from neighbour to neighbour.
 *
 * A patch of image 1 is a square of samples around q1; in image 2 it lies at A u + q2 for the offset u. Gain and offset of
 * the brightness are free. The alignment is inverse compositional (Baker and Matthews, "Lucas-Kanade 20 Years On", 2004):
 * derivatives are those of the patch of image 1, taken once. Images are read between pixels by cubic convolution.
 * The functions in numpy that say what is computed are in tests/kernels/reference/patches.py. */
#include "kernels.h"

/* Samples of a patch are filled up to whole vectors by ones without weight. */
enum { MOST_SIDE = 2 * MOST_HALF + 1, MOST_SAMPLES = (MOST_SIDE * MOST_SIDE + 15) / 16 * 16, UNKNOWNS = 6 };

typedef float four_t __attribute__((vector_size(16), aligned(4)));

/* Write the weights of four neighbours at the fraction t after the second (Catmull and Rom). */
#define CUBIC(t, w0, w1, w2, w3)                                                                                       \
    do {                                                                                                               \
        (w0) = (t) * (-0.5f + (t) * (1.0f - 0.5f * (t)));                                                              \
        (w1) = 1.0f + (t) * (t) * (-2.5f + 1.5f * (t));                                                                \
        (w2) = (t) * (0.5f + (t) * (2.0f - 1.5f * (t)));                                                               \
        (w3) = (t) * (t) * (-0.5f + 0.5f * (t));                                                                       \
    } while (0)

/* Read `image` at the `count` places (u, v) + A (x, y), which lie at least a pixel inside; count is a multiple of 16. */
INLINE void read_samples(
    const image_t image, float u, float v, const float A[4], const float *x, const float *y, int64_t count, float *out)
{
    int32_t at[MOST_SAMPLES];
    float across[4][MOST_SAMPLES], down[4][MOST_SAMPLES], sums[4 * MOST_SAMPLES];
    const int32_t width = (int32_t)image.width;
#pragma omp simd
    for (int64_t n = 0; n < count; n++) {
        const float place_u = u + A[0] * x[n] + A[1] * y[n], place_v = v + A[2] * x[n] + A[3] * y[n];
        const int32_t left = (int32_t)place_u, top = (int32_t)place_v;
        const float s = place_u - (float)left, t = place_v - (float)top;
        at[n] = (top - 1) * width + left - 1;
        CUBIC(s, across[0][n], across[1][n], across[2][n], across[3][n]);
        CUBIC(t, down[0][n], down[1][n], down[2][n], down[3][n]);
    }
    for (int64_t n = 0; n < count; n++) {
        const float *from = image.brightness + at[n];
        four_t row, sum;
        memcpy(&row, from, sizeof row);
        sum = down[0][n] * row;
        memcpy(&row, from + width, sizeof row);
        sum += down[1][n] * row;
        memcpy(&row, from + 2 * (ptrdiff_t)width, sizeof row);
        sum += down[2][n] * row;
        memcpy(&row, from + 3 * (ptrdiff_t)width, sizeof row);
        sum += down[3][n] * row;
        memcpy(sums + 4 * n, &sum, sizeof sum);
    }
#pragma omp simd
    for (int64_t n = 0; n < count; n++)
        out[n] = (across[0][n] * sums[4 * n] + across[1][n] * sums[4 * n + 1]) +
                 (across[2][n] * sums[4 * n + 2] + across[3][n] * sums[4 * n + 3]);
}

/* Read `image` at side x side places a pixel apart, from (u, v), which lies at least a pixel inside. */
INLINE void read_square(const image_t image, float u, float v, int64_t side, float *out)
{
    enum { MOST_LINE = MOST_SIDE + 2 };
    const int32_t left = (int32_t)u, top = (int32_t)v;
    const float s = u - (float)left, t = v - (float)top;
    float across[4], down[4], lines[(MOST_LINE + 3) * MOST_LINE];
    CUBIC(s, across[0], across[1], across[2], across[3]);
    CUBIC(t, down[0], down[1], down[2], down[3]);
    for (int64_t j = 0; j < side + 3; j++) {
        const float *from = image.brightness + (ptrdiff_t)(top - 1 + j) * (ptrdiff_t)image.width + (left - 1);
        for (int64_t i = 0; i < side; i++)
            lines[j * side + i] =
                across[0] * from[i] + across[1] * from[i + 1] + across[2] * from[i + 2] + across[3] * from[i + 3];
    }
    for (int64_t j = 0; j < side; j++)
        for (int64_t i = 0; i < side; i++)
            out[j * side + i] = down[0] * lines[j * side + i] + down[1] * lines[(j + 1) * side + i] +
                                down[2] * lines[(j + 2) * side + i] + down[3] * lines[(j + 3) * side + i];
}

INLINE int is_inside(const image_t image, double u, double v, double margin)
{
    return u >= 1.0 + margin && v >= 1.0 + margin && u < (double)image.width - 2.0 - margin &&
           v < (double)image.height - 2.0 - margin;
}

/* The window, and a patch of image 1 with what the alignment takes from it: `steep` are the derivatives by the six unknowns
 * (the rows of dA, then dq, in the frame of image 1), free of brightness's gain and offset, times the window. */
typedef struct {
    int64_t half, count;
    float window[MOST_SAMPLES], u[MOST_SAMPLES], v[MOST_SAMPLES];
    float values[MOST_SAMPLES], weighted[MOST_SAMPLES], there[MOST_SAMPLES];
    float steep[UNKNOWNS][MOST_SAMPLES];
    float mean;
    double total, effective, energy, normal[UNKNOWNS][UNKNOWNS];
} patch_t;

static void make_window(const patch_rules_t *rules, patch_t *patch)
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
    /* As many samples of equal weight as the window is worth. */
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

/* The products of six rows of samples with one. */
INLINE void six_products(float rows[UNKNOWNS][MOST_SAMPLES], const float *with, int64_t count, double out[UNKNOWNS])
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

/* Read the patch around (u, v) of `image`; return 0 where it has too little contrast or reaches beyond the image. */
INLINE int take_patch(const image_t image, double u, double v, double least_contrast, patch_t *p)
{
    const int64_t half = p->half, side = 2 * half + 1, wide = side + 2, count = p->count;
    if (!is_inside(image, u - (double)half - 1.0, v - (double)half - 1.0, 0.0) ||
        !is_inside(image, u + (double)half + 1.0, v + (double)half + 1.0, 0.0))
        return 0;
    float around[(MOST_SIDE + 2) * (MOST_SIDE + 2)];
    read_square(image, (float)(u - (double)(half + 1)), (float)(v - (double)(half + 1)), wide, around);
    float gradient_u[MOST_SAMPLES] = {0.0f}, gradient_v[MOST_SAMPLES] = {0.0f};
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
    if (!(p->energy > least_contrast * least_contrast * p->total))
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
    float plain[UNKNOWNS][MOST_SAMPLES];
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
                /* Rounding of single precision: less is not known. */
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

INLINE void solve(double L[UNKNOWNS][UNKNOWNS], double x[UNKNOWNS])
{
    for (int64_t i = 0; i < UNKNOWNS; i++) {
        for (int64_t k = 0; k < i; k++)
            x[i] -= L[i][k] * x[k];
        x[i] /= L[i][i];
    }
    for (int64_t i = UNKNOWNS - 1; i >= 0; i--) {
        for (int64_t k = i + 1; k < UNKNOWNS; k++)
            x[i] -= L[k][i] * x[k];
        x[i] /= L[i][i];
    }
}

/* A pair of patches: where, and what the alignment says of it. */
typedef struct {
    double u1, v1, u2, v2, A[4];
} place_t;

typedef struct {
    double correlation, noise, normal[UNKNOWNS][UNKNOWNS];
} agreement_t;

/* What is known of a pair beside the images: rows on the six unknowns with what they should be, each over its sigma. */
typedef struct {
    double rows[3][UNKNOWNS], values[3];
} knowledge_t;

/* The epipolar geometry at a node of image 1: the ray f1 of the node turned into line E f1, and E B1. */
typedef struct {
    const epipolar_t *geometry;
    double line[3], by_pixel[3][2];
} line_t;

/* Return the ray of image 2 at a pixel, and its derivatives by the pixel (a row each of three); 0 outside the field. */
INLINE int ray_at(const epipolar_t *g, double u, double v, double ray[3], double by_u[3], double by_v[3])
{
    const double x = u / g->spacing, y = v / g->spacing;
    if (!(x >= 1.0 && y >= 1.0 && x < (double)g->columns - 2.0 && y < (double)g->rows - 2.0))
        return 0;
    const int64_t left = (int64_t)x, top = (int64_t)y;
    double across[2][4], down[2][4];
    for (int64_t way = 0; way < 2; way++) {
        const double t = way ? y - (double)top : x - (double)left;
        double (*w)[4] = way ? down : across;
        w[0][0] = t * (-0.5 + t * (1.0 - 0.5 * t));
        w[0][1] = 1.0 + t * t * (-2.5 + 1.5 * t);
        w[0][2] = t * (0.5 + t * (2.0 - 1.5 * t));
        w[0][3] = t * t * (-0.5 + 0.5 * t);
        w[1][0] = -0.5 + t * (2.0 - 1.5 * t);
        w[1][1] = t * (-5.0 + 4.5 * t);
        w[1][2] = 0.5 + t * (4.0 - 4.5 * t);
        w[1][3] = t * (-1.0 + 1.5 * t);
    }
    for (int64_t n = 0; n < 3; n++)
        ray[n] = by_u[n] = by_v[n] = 0.0;
    for (int64_t j = 0; j < 4; j++) {
        for (int64_t i = 0; i < 4; i++) {
            const double *at = g->rays2 + 3 * ((top - 1 + j) * g->columns + left - 1 + i);
            for (int64_t n = 0; n < 3; n++) {
                ray[n] += down[0][j] * across[0][i] * at[n];
                by_u[n] += down[0][j] * across[1][i] * at[n];
                by_v[n] += down[1][j] * across[0][i] * at[n];
            }
        }
    }
    for (int64_t n = 0; n < 3; n++) {
        by_u[n] /= g->spacing;
        by_v[n] /= g->spacing;
    }
    return isfinite(ray[0]) && isfinite(ray[1]) && isfinite(ray[2]);
}

/* Say how far a pair is from its epipolar line in image 2, and how its affinity is from one that agrees with the lines:
 * normal n2 of the line (unit), distance, and n2^T A + n1 / |n2|. Return 0 where there is no line. */
INLINE int miss(const line_t *line, const place_t *at, double n2[2], double *distance, double off[2])
{
    double ray[3], by_u[3], by_v[3];
    if (!ray_at(line->geometry, at->u2, at->v2, ray, by_u, by_v))
        return 0;
    double c = 0.0, n1[2] = {0.0, 0.0};
    n2[0] = n2[1] = 0.0;
    for (int64_t n = 0; n < 3; n++) {
        c += ray[n] * line->line[n];
        n2[0] += by_u[n] * line->line[n];
        n2[1] += by_v[n] * line->line[n];
        n1[0] += ray[n] * line->by_pixel[n][0];
        n1[1] += ray[n] * line->by_pixel[n][1];
    }
    const double length = sqrt(n2[0] * n2[0] + n2[1] * n2[1]);
    if (!(length > 1e-12))
        return 0;
    n2[0] /= length;
    n2[1] /= length;
    *distance = c / length;
    off[0] = n2[0] * at->A[0] + n2[1] * at->A[2] + n1[0] / length;
    off[1] = n2[0] * at->A[1] + n2[1] * at->A[3] + n1[1] / length;
    return 1;
}

/* Fill `known` with what the line says of the next step: q2 changes by -A dq, A by -A dA. Samples are `scale` pixels of
 * image 1 apart. Return 0 where there is no line. */
INLINE int line_knowledge(const line_t *line, const place_t *at, double scale, knowledge_t *known)
{
    double n2[2], distance, off[2];
    if (!miss(line, at, n2, &distance, off))
        return 0;
    const double across[2] = {n2[0] * at->A[0] + n2[1] * at->A[2], n2[0] * at->A[1] + n2[1] * at->A[3]};
    const double of_place = 1.0 / line->geometry->sigma, of_A = 1.0 / line->geometry->sigma_A;
    memset(known, 0, sizeof *known);
    known->rows[0][4] = across[0] * scale * of_place;
    known->rows[0][5] = across[1] * scale * of_place;
    known->values[0] = distance * of_place;
    for (int64_t k = 0; k < 2; k++) {
        known->rows[1 + k][k] = across[0] * of_A;
        known->rows[1 + k][2 + k] = across[1] * of_A;
        known->values[1 + k] = off[k] * of_A;
    }
    return 1;
}

/* Say how the patch read from image 2 (`there`) agrees with that of image 1: its products with `steep` and with the patch,
 * and its own energy, free of offset. `steep` and the weighted patch sum up to nothing: an offset is no part of theirs. */
INLINE void compare(patch_t *p, double sums[UNKNOWNS], double *common, double *energy)
{
    float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f, s4 = 0.0f, s5 = 0.0f, with = 0.0f, level = 0.0f, square = 0.0f;
#pragma omp simd reduction(+ : s0, s1, s2, s3, s4, s5, with, level, square)
    for (int64_t n = 0; n < p->count; n++) {
        /* Less the mean of image 1: small numbers keep their digits. */
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

/* Align the patch `p`, taken `scale1` pixels a sample around (u1, v1), with `image2` of `scale2` pixels a sample; return
 * whether it settled. */
INLINE int align_patch(
    patch_t *p, const image_t image2, double scale1, double scale2, const patch_rules_t *rules, const line_t *line,
    place_t *place, agreement_t *out)
{
    const int64_t count = p->count;
    const double half = (double)p->half, u0 = place->u2, v0 = place->v2;
    double step[UNKNOWNS], matrix[UNKNOWNS][UNKNOWNS];
    int fixed = 0;
    for (int64_t k = 0; k <= rules->most_steps; k++) {
        const double ratio = scale1 / scale2;
        const float A[4] = {
            (float)(ratio * place->A[0]), (float)(ratio * place->A[1]), (float)(ratio * place->A[2]),
            (float)(ratio * place->A[3])};
        const double u = place->u2 / scale2, v = place->v2 / scale2;
        const double wide = half * (double)(fabsf(A[0]) + fabsf(A[1])), high = half * (double)(fabsf(A[2]) + fabsf(A[3]));
        if (!(is_inside(image2, u - wide, v - high, 0.01) && is_inside(image2, u + wide, v + high, 0.01)))
            return 0;
        read_samples(image2, (float)u, (float)v, A, p->u, p->v, count, p->there);
        double sums[UNKNOWNS];
        double common, energy;
        compare(p, sums, &common, &energy);
        if (!(common > 0.0))
            return 0;
        out->correlation = common / sqrt(p->energy * energy);
        /* What the patches differ by, beyond gain and offset, a sample; the unknowns and those two are fitted. */
        out->noise = p->energy * (1.0 - out->correlation * out->correlation) / p->total;
        out->noise = out->noise * p->effective / (p->effective - UNKNOWNS - 2.0) + rules->least_noise * rules->least_noise;
        const double gain = p->energy / common;
        for (int64_t n = 0; n < UNKNOWNS; n++)
            step[n] = gain * sums[n];
        if (line != NULL || !fixed) {
            memcpy(matrix, p->normal, sizeof matrix);
            if (line != NULL) {
                knowledge_t known;
                if (!line_knowledge(line, place, scale1, &known))
                    return 0;
                const double weight = rules->excess_noise * out->noise;
                for (int64_t r = 0; r < 3; r++) {
                    for (int64_t m = 0; m < UNKNOWNS; m++) {
                        step[m] += weight * known.rows[r][m] * known.values[r];
                        for (int64_t n = 0; n < UNKNOWNS; n++)
                            matrix[m][n] += weight * known.rows[r][m] * known.rows[r][n];
                    }
                }
            }
            memcpy(out->normal, matrix, sizeof matrix);
            if (!factor(matrix))
                return 0;
            fixed = 1;
        }
        solve(matrix, step);
        /* W <- W o dW^-1: A <- A (I + dA)^-1, q2 <- q2 - A dq with the new A. */
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
        const double away_u = (place->u2 - u0) / scale2, away_v = (place->v2 - v0) / scale2;
        if (!(away_u * away_u + away_v * away_v < rules->most_move * rules->most_move))
            return 0;
        double border = fabs(step[4]) + fabs(step[5]);
        for (int64_t n = 0; n < 4; n++)
            border += half * fabs(step[n]);
        /* So small a step changes nothing that the patches were compared by. */
        if (border < rules->settled)
            return place->A[0] * place->A[3] - place->A[1] * place->A[2] > 0.0;
    }
    return 0;
}

/* Write the covariance (upper triangle) of (u2, v2, A) from the normal matrix; return the larger standard deviation of the
 * place, negative where there is none. */
INLINE double covariance_of(const place_t *place, double scale1, const agreement_t *found, const patch_rules_t *rules, double *out)
{
    double L[UNKNOWNS][UNKNOWNS], spread[UNKNOWNS][UNKNOWNS], by[UNKNOWNS][UNKNOWNS];
    memcpy(L, found->normal, sizeof L);
    if (!factor(L))
        return -1.0;
    for (int64_t n = 0; n < UNKNOWNS; n++) {
        double unit[UNKNOWNS] = {0};
        unit[n] = 1.0;
        solve(L, unit);
        for (int64_t m = 0; m < UNKNOWNS; m++)
            spread[m][n] = unit[m];
    }
    /* Of (u2, v2, a11, a12, a21, a22) by the step: -A dq and -A dA. */
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

/* Align the patches around a pair as finely as its texture allows; write PATCH_COLUMNS numbers and return 1 if it is good.
 * The patch of the image that shows the surface larger is read from a coarser level: both are equally sharp. */
INLINE int align_pair(
    const pyramid_t *first, const pyramid_t *second, const patch_rules_t *rules, const line_t *line, patch_t *patch,
    place_t *place, double *out)
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
        if (!take_patch(first->levels[level1 + k], start.u1 / scale1, start.v1 / scale1, rules->least_contrast, patch))
            continue;
        if (!align_patch(patch, second->levels[level2 + k], scale1, scale2, rules, line, place, &found))
            continue;
        const double sigma = covariance_of(place, scale1, &found, rules, out + 9);
        if (!(sigma >= 0.0 && sigma < rules->most_sigma))
            continue;
        out[0] = place->u2;
        out[1] = place->v2;
        memcpy(out + 2, place->A, sizeof place->A);
        out[6] = found.correlation;
        out[7] = found.noise;
        out[8] = (double)k;
        return found.correlation >= rules->least_correlation;
    }
    return 0;
}

/* Align patches from `starts`: u1, v1, u2, v2 and the affinity row by row. What fails is NaN throughout. */
FOR_EACH_PROCESSOR void align_patches(
    const pyramid_t *first, const pyramid_t *second, const patch_rules_t *rules, const double *starts, int64_t count,
    double *out)
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

/* The nodes whose neighbours are still to be tried, the best correlation on top. */
typedef struct {
    const double *out;
    int32_t *nodes;
    int64_t count;
} heap_t;

INLINE double rank_of(const heap_t *heap, int64_t place) { return heap->out[(int64_t)PATCH_COLUMNS * heap->nodes[place] + 6]; }

INLINE void swap_nodes(heap_t *heap, int64_t a, int64_t b)
{
    const int32_t node = heap->nodes[a];
    heap->nodes[a] = heap->nodes[b];
    heap->nodes[b] = node;
}

static void push_node(heap_t *heap, int32_t node)
{
    int64_t at = heap->count++;
    heap->nodes[at] = node;
    for (; at > 0 && rank_of(heap, at) > rank_of(heap, (at - 1) / 2); at = (at - 1) / 2)
        swap_nodes(heap, at, (at - 1) / 2);
}

static int32_t pop_node(heap_t *heap)
{
    const int32_t best = heap->nodes[0];
    heap->nodes[0] = heap->nodes[--heap->count];
    for (int64_t at = 0;;) {
        int64_t next = 2 * at + 1;
        if (next + 1 < heap->count && rank_of(heap, next + 1) > rank_of(heap, next))
            next++;
        if (next >= heap->count || rank_of(heap, next) <= rank_of(heap, at))
            return best;
        swap_nodes(heap, at, next);
        at = next;
    }
}

/* Try the pair `place` at its node; return 1 and write it if it is good. */
INLINE int try_node(
    const pyramid_t *first, const pyramid_t *second, const epipolar_t *epipolar, const patch_rules_t *rules,
    const patch_grid_t *grid, int64_t node, patch_t *patch, place_t *place)
{
    line_t line = {.geometry = epipolar};
    const double *ray = grid->rays1 + 3 * node, *by = grid->jacobians1 + 6 * node;
    if (!isfinite(ray[0]))
        return 0;
    for (int64_t n = 0; n < 3; n++) {
        const double *E = epipolar->E21 + 3 * n;
        line.line[n] = E[0] * ray[0] + E[1] * ray[1] + E[2] * ray[2];
        for (int64_t k = 0; k < 2; k++)
            line.by_pixel[n][k] = E[0] * by[k] + E[1] * by[2 + k] + E[2] * by[4 + k];
    }
    const int knows = isfinite(epipolar->sigma), gated = isfinite(epipolar->most_distance);
    double found[PATCH_COLUMNS], n2[2], distance, off[2];
    grid->tries[node]++;
    if (gated && !(miss(&line, place, n2, &distance, off) && fabs(distance) < epipolar->most_distance + rules->most_move))
        return 0;
    if (!align_pair(first, second, rules, knows ? &line : NULL, patch, place, found))
        return 0;
    if (gated && !(miss(&line, place, n2, &distance, off) && fabs(distance) < epipolar->most_distance))
        return 0;
    memcpy(grid->out + PATCH_COLUMNS * node, found, sizeof found);
    return 1;
}

/* Grow pairs over the nodes of image 1 from `seeds` (as the starts of `align_patches`), the best first; `out` is NaN where
 * there is none. Return how many nodes have a pair. */
FOR_EACH_PROCESSOR int64_t grow_patches(
    const pyramid_t *first, const pyramid_t *second, const epipolar_t *epipolar, const patch_rules_t *rules,
    const patch_grid_t *grid, const double *seeds, int64_t count)
{
    patch_t patch;
    make_window(rules, &patch);
    const int64_t nodes = grid->rows * grid->columns;
    const double step = (double)grid->step;
    heap_t heap = {grid->out, grid->heap, 0};
    memset(grid->tries, 0, (size_t)nodes);
    for (int64_t k = 0; k < nodes * PATCH_COLUMNS; k++)
        grid->out[k] = NAN;
    int64_t grown = 0;
    for (int64_t k = 0; k < count; k++) {
        const double *at = seeds + 8 * k;
        const int64_t column = (int64_t)floor(at[0] / step + 0.5), row = (int64_t)floor(at[1] / step + 0.5);
        if (column < 0 || row < 0 || column >= grid->columns || row >= grid->rows)
            continue;
        const int64_t node = row * grid->columns + column;
        if (isfinite(grid->out[PATCH_COLUMNS * node]))
            continue;
        const double u = step * (double)column - at[0], v = step * (double)row - at[1];
        place_t place = {
            step * (double)column, step * (double)row, at[2] + at[4] * u + at[5] * v, at[3] + at[6] * u + at[7] * v,
            {at[4], at[5], at[6], at[7]}};
        if (try_node(first, second, epipolar, rules, grid, node, &patch, &place)) {
            push_node(&heap, (int32_t)node);
            grown++;
        }
        /* A bad seed must not keep the surface from coming this way. */
        grid->tries[node] = 0;
    }
    while (heap.count > 0) {
        const int64_t node = pop_node(&heap), row = node / grid->columns, column = node % grid->columns;
        const double *at = grid->out + PATCH_COLUMNS * node;
        for (int64_t way = 0; way < 4; way++) {
            const int64_t du = way == 0 ? 1 : way == 1 ? -1 : 0, dv = way == 2 ? 1 : way == 3 ? -1 : 0;
            const int64_t next = (row + dv) * grid->columns + column + du;
            if (row + dv < 0 || row + dv >= grid->rows || column + du < 0 || column + du >= grid->columns)
                continue;
            if (grid->tries[next] >= grid->most_tries || isfinite(grid->out[PATCH_COLUMNS * next]))
                continue;
            const double u = step * (double)du, v = step * (double)dv;
            place_t place = {
                step * (double)(column + du), step * (double)(row + dv), at[0] + at[2] * u + at[3] * v,
                at[1] + at[4] * u + at[5] * v, {at[2], at[3], at[4], at[5]}};
            if (try_node(first, second, epipolar, rules, grid, next, &patch, &place)) {
                push_node(&heap, (int32_t)next);
                grown++;
            }
        }
    }
    return grown;
}
