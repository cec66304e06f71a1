/* The edge model of a corner: the product of its two lines and the paper beyond the outer squares, for a block of pixels at a time
 * in float32, which the compiler vectorises; and the normal equations of a Gauss-Newton step. */
#include "edges_lines.h"

/* Return the pattern: minus the mean of the product of both steps, whose blurs along oblique normals have the correlation rho
 * (Mehler's series to the third order; reference.edge_model._mixed). */
INLINE float mixed(const edge_t *one, const edge_t *two, float rho, int i)
{
    return -(
        one->value[i] * two->value[i]
        + rho
            * (one->slope[i] * two->slope[i]
               + rho * (0.5f * one->bow[i] * two->bow[i] + (1.0f / 6.0f) * rho * one->curl[i] * two->curl[i])));
}

/* The parameters in float32, as the rows of a block need them. */
typedef struct {
    float x, y, blur, base, half, per_size, light_u, light_v, rho, single1, single2;
    line_t line1, line2;
} model_t;

INLINE model_t model_of(const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules)
{
    const float per_size = (float)(1.0 / window->size);
    return (model_t){
        .x = (float)values[X],
        .y = (float)values[Y],
        .blur = (float)values[S],
        .base = (float)values[A],
        .half = (float)values[B],
        .per_size = per_size,
        .light_u = (float)values[GX] * per_size,
        .light_v = (float)values[GY] * per_size,
        .rho = (float)cos(values[T1] - values[T2]),
        .single1 = (float)at.single[0],
        .single2 = (float)at.single[1],
        .line1 = line_of(values[T1], values[K1], at.gaps, at.tilts, at.paper, values[S], rules),
        .line2 = line_of(values[T2], values[K2], at.gaps + 2, at.tilts + 2, at.paper + 2, values[S], rules)};
}

/* Return the pattern at pixel i with the paper beyond the outer squares; add the paper's part of the derivatives. */
INLINE float papered_pattern(
    const model_t *m, const edge_t *one, const edge_t *two, const beyond_t *past1, const beyond_t *past2, int i)
{
    float pattern = mixed(one, two, m->rho, i);
    pattern += past1->paper[i] * (1.0f - 0.5f * past2->seen[i]) + past2->paper[i] * (1.0f - 0.5f * past1->seen[i]);
    return pattern - (m->single2 * one->value[i] + m->single1 * two->value[i]);
}

INLINE void add_papered(
    const model_t *m, const edge_t *one, const edge_t *two, const beyond_t *past1, const beyond_t *past2, int i, float scale,
    float *by_d1, float *by_d2, float *grown)
{
    *by_d1 += scale * m->single2 * one->slope[i];
    *by_d2 += scale * m->single1 * two->slope[i];
    *grown += m->single2 * one->grown[i] + m->single1 * two->grown[i];
    const float rest1 = 1.0f - 0.5f * past1->seen[i], rest2 = 1.0f - 0.5f * past2->seen[i];
    const float half1 = 0.5f * past1->paper[i], half2 = 0.5f * past2->paper[i];
    *by_d1 -= scale * (past1->slope[i] * rest2 - half2 * past1->seen_slope[i]);
    *by_d2 -= scale * (past2->slope[i] * rest1 - half1 * past2->seen_slope[i]);
    *grown -= past1->grown[i] * rest2 - half2 * past1->seen_grown[i];
    *grown -= past2->grown[i] * rest1 - half1 * past2->seen_grown[i];
}

/* Set `rows` of the block of pixels that begins at `start`: derivatives by the first `parameters`
 * (reference.edge_model.linearise), and last the residuals. */
INLINE void fill_rows(
    const int parameters, const int papered, const int size, const model_t *m, const window_t *window, int64_t start,
    block_row_t *restrict rows)
{
    const float *restrict u = window->u + start, *restrict v = window->v + start;
    const float *restrict value = window->value + start;
    const line_t line1 = m->line1, line2 = m->line2;
    const float rho = m->rho, half_rho = 0.5f * rho, half = m->half, blur = m->blur, per_size = m->per_size;
    edge_t one, two;
    along_line(size, line1, u, v, m->x, m->y, &one);
    along_line(size, line2, u, v, m->x, m->y, &two);
    beyond_t past1, past2;
    if (papered) {
        beyond_line(size, line1, &one, &past1);
        beyond_line(size, line2, &two, &past2);
    }
    for (int i = 0; i < size; i++) {
        const float pattern = papered ? papered_pattern(m, &one, &two, &past1, &past2, i) : mixed(&one, &two, rho, i);
        const float plain = m->base + half * pattern;
        const float light = 1.0f + m->light_u * u[i] + m->light_v * v[i];
        const float scale = -light * half / blur;
        float by_d1 =
            scale * (one.slope[i] * two.value[i] + rho * (one.bow[i] * two.slope[i] + half_rho * one.curl[i] * two.bow[i]));
        float by_d2 =
            scale * (two.slope[i] * one.value[i] + rho * (two.bow[i] * one.slope[i] + half_rho * two.curl[i] * one.bow[i]));
        float grown = one.grown[i] * two.value[i] + two.grown[i] * one.value[i];
        if (papered)
            add_papered(m, &one, &two, &past1, &past2, i, scale, &by_d1, &by_d2, &grown);
        const float bend1 = line1.curvature * one.along[i], bend2 = line2.curvature * two.along[i];
        rows[X][i] = by_d1 * (line1.sine + bend1 * line1.cosine) + by_d2 * (line2.sine + bend2 * line2.cosine);
        rows[Y][i] = by_d1 * (bend1 * line1.sine - line1.cosine) + by_d2 * (bend2 * line2.sine - line2.cosine);
        rows[T1][i] = -by_d1 * (one.along[i] + bend1 * one.lateral[i]);
        rows[T2][i] = -by_d2 * (two.along[i] + bend2 * two.lateral[i]);
        rows[S][i] = -scale * grown;
        rows[A][i] = light;
        rows[B][i] = light * pattern;
        rows[GX][i] = plain * per_size * u[i];
        rows[GY][i] = plain * per_size * v[i];
        rows[parameters][i] = value[i] - light * plain;
        if (parameters == PARAMETERS) {
            rows[K1][i] = -0.5f * by_d1 * (one.along[i] * one.along[i] + blur * blur);
            rows[K2][i] = -0.5f * by_d2 * (two.along[i] * two.along[i] + blur * blur);
        }
    }
}

/* Add the products of the first `parameters` rows and the residuals of `size` pixels, a block or half of it, to `sum`: the lower
 * triangle row by row. */
INLINE void add_block(const int parameters, const int size, block_row_t *restrict rows, lanes_t *sum)
{
    for (int i = 0; i <= parameters; i++) {
        const lanes_t *left = (const lanes_t *)rows[i];
        const lanes_t l0 = left[0], l1 = left[1], l2 = left[2], l3 = left[3];
        const lanes_t l4 = left[4], l5 = left[5], l6 = left[6], l7 = left[7];
        for (int j = 0; j <= i; j++, sum++) {
            const lanes_t *right = (const lanes_t *)rows[j];
            /* Two independent chains of fused multiply-adds. */
            lanes_t even = *sum + l0 * right[0], odd = l1 * right[1];
            even += l2 * right[2];
            odd += l3 * right[3];
            if (size == BLOCK) {
                even += l4 * right[4];
                odd += l5 * right[5];
                even += l6 * right[6];
                odd += l7 * right[7];
            }
            *sum = even + odd;
        }
    }
}

/* Set the first `parameters` rows of a block and the residuals to 0 from pixel `used` on. */
INLINE void clear_behind(const int parameters, int64_t used, block_row_t *restrict rows)
{
    const int group = (int)(used / LANES), left = (int)(used % LANES);
    const mask_t numbers = {0, 1, 2, 3, 4, 5, 6, 7}, kept = numbers < left;
    for (int row = 0; row <= parameters; row++) {
        lanes_t *groups = (lanes_t *)rows[row];
        groups[group] = (lanes_t)((mask_t)groups[group] & kept);
        for (int k = 0; k < GROUPS; k++)
            if (k > group)
                groups[k] = (lanes_t){0.0f};
    }
}

/* Set the rows of the block of pixels that begins at `start` (fill_rows), 0 from pixel `used` on, and add their products to
 * `sums`. */
INLINE void multiply_block(
    const int parameters, const int papered, const int size, const model_t *model, const window_t *window, int64_t start,
    int64_t used, block_row_t *restrict rows, lanes_t *sums)
{
    fill_rows(parameters, papered, size, model, window, start, rows);
    if (used < BLOCK)
        clear_behind(parameters, used, rows);
    add_block(parameters, size, rows, sums);
}

/* Set the window's rows (fill_rows), and `products` (rows of ROWS, lower triangle) to the sums of their products over all
 * pixels. */
INLINE void multiply_rows(
    const int parameters, const int papered, const double *values, const window_t *window, const geometry_t at,
    const edge_rules_t *rules, double *products)
{
    const model_t model = model_of(values, window, at, rules);
    lanes_t sums[ROWS * (ROWS + 1) / 2];
    memset(sums, 0, sizeof sums);
    for (int64_t start = 0; start < window->count; start += BLOCK) {
        /* If they are not used afterwards, all blocks share the same memory, which stays in the cache. */
        block_row_t *restrict rows = rows_of(window, rules->mirrored ? start : 0);
        const int64_t used = window->count - start;
        if (used > BLOCK / 2) {
            multiply_block(parameters, papered, BLOCK, &model, window, start, used, rows, sums);
        } else {
            multiply_block(parameters, papered, BLOCK / 2, &model, window, start, used, rows, sums);
        }
    }
    for (int i = 0, k = 0; i <= parameters; i++)
        for (int j = 0; j <= i; j++, k++) {
            double total = 0.0;
            for (int lane = 0; lane < LANES; lane++)
                total += (double)sums[k][lane];
            products[i * ROWS + j] = total;
        }
}

FOR_EACH_PROCESSOR
void normal_equations(
    const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products)
{
    multiply_rows(FEWER, 0, values, window, at, rules, products);
}

FOR_EACH_PROCESSOR
void all_normal_equations(
    const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products)
{
    multiply_rows(PARAMETERS, 0, values, window, at, rules, products);
}

/* The same for corners near paper of known brightness, and for those of single squares. */
FOR_EACH_PROCESSOR
void papered_equations(
    const int n, const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products)
{
    multiply_rows(n == FEWER ? FEWER : PARAMETERS, 1, values, window, at, rules, products);
}

/* Set a and b by linear least squares with the other parameters fixed (reference.edges._brightness), from every second block of
 * pixels. */
FOR_EACH_PROCESSOR
void set_brightness(double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double sign)
{
    const float x = (float)values[X], y = (float)values[Y];
    const float rho = (float)cos(values[T1] - values[T2]);
    const line_t line1 = line_of(values[T1], values[K1], at.gaps, at.tilts, at.paper, values[S], rules);
    const line_t line2 = line_of(values[T2], values[K2], at.gaps + 2, at.tilts + 2, at.paper + 2, values[S], rules);
    double n = 0.0, sum_p = 0.0, sum_i = 0.0, sum_pp = 0.0, sum_pi = 0.0;
    for (int64_t start = 0; start < window->count; start += 2 * BLOCK) {
        edge_t one, two;
        float pattern[BLOCK], value[BLOCK];
        lanes_t p = {0.0f}, i = {0.0f}, pp = {0.0f}, pi = {0.0f};
        n += (double)(window->count - start < BLOCK ? window->count - start : BLOCK);
        along_line(BLOCK, line1, window->u + start, window->v + start, x, y, &one);
        along_line(BLOCK, line2, window->u + start, window->v + start, x, y, &two);
        for (int k = 0; k < BLOCK; k++) {
            const int used = start + k < window->count;
            pattern[k] = used ? (float)sign * mixed(&one, &two, rho, k) : 0.0f;
            value[k] = used ? window->value[start + k] : 0.0f;
        }
        for (int k = 0; k < BLOCK; k += LANES) {
            const lanes_t here = *(const lanes_t *)(pattern + k), grey = *(const lanes_t *)(value + k);
            p += here;
            i += grey;
            pp += here * here;
            pi += here * grey;
        }
        for (int lane = 0; lane < LANES; lane++) {
            sum_p += (double)p[lane];
            sum_i += (double)i[lane];
            sum_pp += (double)pp[lane];
            sum_pi += (double)pi[lane];
        }
    }
    n = n > 1.0 ? n : 1.0;
    const double spread = sum_pp - sum_p * sum_p / n;
    const double slope = (sum_pi - sum_p * sum_i / n) / (spread > 1e-9 ? spread : 1e-9);
    values[B] = slope * sign;
    values[A] = (sum_i - slope * sum_p) / n;
}
