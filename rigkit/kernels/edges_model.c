/* The edge model along the two lines of a corner, with what lies beyond the outer squares: a block of pixels at a time, in
 * float32, which the compiler vectorises; and the normal equations of a Gauss-Newton step. */
#include "edges.h"

/* A line through the corner as float32 arithmetic wants it. A sharp edge is two of less `width`, `apart` to either side;
 * `stretch` is s / width (reference.edges._edge). */
typedef struct {
    float cosine, sine, curvature, before, after, tilt_before, tilt_after;
    float blur, width, stretch, apart, kurtosis;
    float paper_before, paper_after;
    int tight, sharp, ends_before, ends_after;
} line_t;

/* The model along one line over a block of pixels: the step, its derivatives, -s dS/ds, and the pixel's place. */
typedef struct {
    float value[BLOCK], slope[BLOCK], bow[BLOCK], curl[BLOCK], grown[BLOCK], along[BLOCK], aside[BLOCK];
} edge_t;

/* What lies beyond the outer squares of one line over a block of pixels: how much of it a pixel sees, and that times how
 * bright it is; the derivatives of both, and -s d/ds. */
typedef struct {
    float seen[BLOCK], seen_slope[BLOCK], seen_grown[BLOCK], paper[BLOCK], slope[BLOCK], grown[BLOCK];
} beyond_t;

/* Beyond so many s an edge is flat to float32; the exponential below needs a limit. */
#define FLAT_SIGMAS 12.0f

INLINE line_t line_of(
    double angle, double curvature, const double gaps[2], const double tilts[2], const double paper[2], double blur, const edge_rules_t *rules)
{
    const double cosine = cos(angle), sine = sin(angle), c2 = cosine * cosine, s2 = sine * sine, b2 = blur * blur;
    const double flat = rules->pixel_kurtosis * (c2 * c2 + s2 * s2);
    const int sharp = blur < rules->sharp_blur;
    const double apart = sharp ? sqrt(sqrt(-0.5 * flat)) : 0.0, width = sqrt(b2 - apart * apart);
    const double nearest = gaps[0] < gaps[1] ? gaps[0] : gaps[1];
    const int before = isfinite(paper[0]), after = isfinite(paper[1]);
    return (line_t){
        .cosine = (float)cosine, .sine = (float)sine, .curvature = (float)curvature,
        .before = (float)gaps[0], .after = (float)gaps[1],
        .tilt_before = (float)tilts[0], .tilt_after = (float)tilts[1],
        .blur = (float)blur, .width = (float)width, .stretch = (float)(blur / width), .apart = (float)apart,
        .kurtosis = sharp ? 0.0f : (float)(flat / (b2 * b2)),
        .paper_before = before ? (float)paper[0] : 0.0f, .paper_after = after ? (float)paper[1] : 0.0f,
        .tight = before || after || nearest * (1.0 - rules->reach) < rules->tail_sigmas * blur, .sharp = sharp,
        .ends_before = before, .ends_after = after};
}

/* Add a Gaussian edge, `shift` back from the line and turned by `tilt`, with weight `part`. The distances have a loop of their own: mixed
 * with what follows, their limits become branches that keep the compiler from vectorising. */
INLINE void add_gaussian(const line_t line, float shift, float tilt, float part, edge_t *out)
{
    float x[BLOCK];
    const float per_width = 1.0f / line.width;
    for (int i = 0; i < BLOCK; i++) {
        const float along = out->along[i];
        const float bend = 0.5f * line.curvature * (along * along + line.blur * line.blur);
        const float at = (out->aside[i] - bend - tilt * along + shift) * per_width;
        const float most = at < FLAT_SIGMAS ? at : FLAT_SIGMAS;
        x[i] = most > -FLAT_SIGMAS ? most : -FLAT_SIGMAS;
    }
    const float once = part * line.stretch, twice = once * line.stretch, thrice = twice * line.stretch;
    for (int i = 0; i < BLOCK; i++) {
        float edge[5];
        blurred_edge(x[i], line.kurtosis, edge);
        out->value[i] += part * edge[0];
        out->slope[i] += once * edge[1];
        out->bow[i] += twice * edge[2];
        out->curl[i] += thrice * edge[3];
        out->grown[i] += twice * edge[4];
    }
}

/* reference.edges._edge, `shift` back from the line and turned by `tilt`. */
INLINE void add_edge(const line_t line, float shift, float tilt, float part, edge_t *out)
{
    if (line.sharp) {
        add_gaussian(line, shift - line.apart, tilt, 0.5f * part, out);
        add_gaussian(line, shift + line.apart, tilt, 0.5f * part, out);
    } else {
        add_gaussian(line, shift, tilt, part, out);
    }
}

/* Evaluate one line over a block of pixels at (u, v) from the window's centre (reference.edges._step). */
INLINE void along_line(const line_t line, const float *u, const float *v, float x, float y, edge_t *out)
{
    for (int i = 0; i < BLOCK; i++) {
        out->along[i] = line.cosine * (u[i] - x) + line.sine * (v[i] - y);
        out->aside[i] = line.cosine * (v[i] - y) - line.sine * (u[i] - x);
        out->value[i] = out->slope[i] = out->bow[i] = out->curl[i] = out->grown[i] = 0.0f;
    }
    add_edge(line, 0.0f, 0.0f, 1.0f, out);
    if (line.tight) {
        /* Squares go on beyond the next line the other way round; of paper the pattern is nothing. */
        const float before = line.ends_before ? 0.5f : 1.0f, after = line.ends_after ? 0.5f : 1.0f;
        add_edge(line, line.before, line.tilt_before, -before, out);
        add_edge(line, -line.after, line.tilt_after, -after, out);
        for (int i = 0; i < BLOCK; i++)
            out->value[i] += before - after;
    }
    for (int i = 0; i < BLOCK; i++)
        out->grown[i] += line.curvature * line.blur * out->slope[i];
}

/* Add what lies beyond the line `shift` back from `line`, turned by `tilt`, on the side where `way` times the distance grows. */
INLINE void add_paper(const line_t line, float shift, float tilt, float way, float paper, const edge_t *at, beyond_t *out)
{
    edge_t edge;
    for (int i = 0; i < BLOCK; i++) {
        edge.along[i] = at->along[i];
        edge.aside[i] = at->aside[i];
        edge.value[i] = edge.slope[i] = edge.bow[i] = edge.curl[i] = edge.grown[i] = 0.0f;
    }
    add_edge(line, shift, tilt, 1.0f, &edge);
    const float half = 0.5f * way;
    for (int i = 0; i < BLOCK; i++) {
        const float seen = 0.5f + half * edge.value[i], slope = half * edge.slope[i];
        const float grown = half * (edge.grown[i] + line.curvature * line.blur * edge.slope[i]);
        out->seen[i] += seen;
        out->seen_slope[i] += slope;
        out->seen_grown[i] += grown;
        out->paper[i] += paper * seen;
        out->slope[i] += paper * slope;
        out->grown[i] += paper * grown;
    }
}

/* Evaluate what lies beyond the ends of one line whose `at` is known (reference.edges._beyond). */
INLINE void beyond_line(const line_t line, const edge_t *at, beyond_t *out)
{
    memset(out, 0, sizeof *out);
    if (line.ends_before)
        add_paper(line, line.before, line.tilt_before, -1.0f, line.paper_before, at, out);
    if (line.ends_after)
        add_paper(line, -line.after, line.tilt_after, 1.0f, line.paper_after, at, out);
}

/* reference.edges._mixed. */
INLINE float mixed(const edge_t *one, const edge_t *two, float rho, int i)
{
    return -(one->value[i] * two->value[i]
             + rho * (one->slope[i] * two->slope[i]
                      + rho * (0.5f * one->bow[i] * two->bow[i] + (1.0f / 6.0f) * rho * one->curl[i] * two->curl[i])));
}

/* What the rows of every block need of the parameters. */
typedef struct {
    float x, y, blur, base, half, per_size, light_u, light_v, rho, single1, single2;
    line_t line1, line2;
} model_t;

INLINE model_t model_of(const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules)
{
    const float per_size = (float)(1.0 / window->size);
    return (model_t){
        .x = (float)values[X], .y = (float)values[Y], .blur = (float)values[S], .base = (float)values[A],
        .half = (float)values[B], .per_size = per_size, .light_u = (float)values[GX] * per_size,
        .light_v = (float)values[GY] * per_size, .rho = (float)cos(values[T1] - values[T2]),
        .single1 = (float)at.single[0], .single2 = (float)at.single[1],
        .line1 = line_of(values[T1], values[K1], at.gaps, at.tilts, at.paper, values[S], rules),
        .line2 = line_of(values[T2], values[K2], at.gaps + 2, at.tilts + 2, at.paper + 2, values[S], rules)};
}

/* The pattern at pixel i with what is beyond its outer squares, and what that adds to its derivatives. */
INLINE float papered_pattern(const model_t *m, const edge_t *one, const edge_t *two, const beyond_t *past1, const beyond_t *past2, int i)
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

/* Set `rows` of the block of pixels that begins with `start` to the first `parameters` of reference.edges.linearise, and the
 * last to the residuals. */
INLINE void fill_rows(
    const int parameters, const int papered, const model_t *m, const window_t *window, int64_t start, float (*restrict rows)[BLOCK])
{
    const float *restrict u = window->u + start, *restrict v = window->v + start;
    const float *restrict value = window->value + start;
    const line_t line1 = m->line1, line2 = m->line2;
    const float rho = m->rho, half_rho = 0.5f * rho, half = m->half, blur = m->blur, per_size = m->per_size;
    edge_t one, two;
    along_line(line1, u, v, m->x, m->y, &one);
    along_line(line2, u, v, m->x, m->y, &two);
    beyond_t past1, past2;
    if (papered) {
        beyond_line(line1, &one, &past1);
        beyond_line(line2, &two, &past2);
    }
    for (int i = 0; i < BLOCK; i++) {
        const float pattern = papered ? papered_pattern(m, &one, &two, &past1, &past2, i) : mixed(&one, &two, rho, i);
        const float plain = m->base + half * pattern;
        const float light = 1.0f + m->light_u * u[i] + m->light_v * v[i];
        const float scale = -light * half / blur;
        float by_d1 = scale * (one.slope[i] * two.value[i]
                               + rho * (one.bow[i] * two.slope[i] + half_rho * one.curl[i] * two.bow[i]));
        float by_d2 = scale * (two.slope[i] * one.value[i]
                               + rho * (two.bow[i] * one.slope[i] + half_rho * two.curl[i] * one.bow[i]));
        float grown = one.grown[i] * two.value[i] + two.grown[i] * one.value[i];
        if (papered)
            add_papered(m, &one, &two, &past1, &past2, i, scale, &by_d1, &by_d2, &grown);
        const float bend1 = line1.curvature * one.along[i], bend2 = line2.curvature * two.along[i];
        rows[X][i] = by_d1 * (line1.sine + bend1 * line1.cosine) + by_d2 * (line2.sine + bend2 * line2.cosine);
        rows[Y][i] = by_d1 * (bend1 * line1.sine - line1.cosine) + by_d2 * (bend2 * line2.sine - line2.cosine);
        rows[T1][i] = -by_d1 * (one.along[i] + bend1 * one.aside[i]);
        rows[T2][i] = -by_d2 * (two.along[i] + bend2 * two.aside[i]);
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

/* Add the products of the first `parameters` rows of a block and the last to `sum`, the lower half row by row. */
INLINE void add_block(const int parameters, float (*restrict rows)[BLOCK], lanes_t *sum)
{
    for (int i = 0; i <= parameters; i++) {
        const lanes_t *left = (const lanes_t *)rows[i];
        const lanes_t l0 = left[0], l1 = left[1], l2 = left[2], l3 = left[3];
        const lanes_t l4 = left[4], l5 = left[5], l6 = left[6], l7 = left[7];
        for (int j = 0; j <= i; j++, sum++) {
            const lanes_t *right = (const lanes_t *)rows[j];
            *sum += ((l0 * right[0] + l1 * right[1]) + (l2 * right[2] + l3 * right[3]))
                + ((l4 * right[4] + l5 * right[5]) + (l6 * right[6] + l7 * right[7]));
        }
    }
}

/* Set the window's rows (fill_rows), and `products` (rows of ROWS, lower half) to those of these rows over all pixels. */
INLINE void multiply_rows(
    const int parameters, const int papered, const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules,
    double *products)
{
    const model_t model = model_of(values, window, at, rules);
    lanes_t sums[ROWS * (ROWS + 1) / 2];
    memset(sums, 0, sizeof sums);
    for (int64_t start = 0; start < window->count; start += BLOCK) {
        /* Where they are not asked for afterwards, in one place, which stays in the cache. */
        float(*restrict rows)[BLOCK] = rows_of(window, rules->mirrored ? start : 0);
        fill_rows(parameters, papered, &model, window, start, rows);
        const int64_t used = window->count - start;
        for (int row = 0; row <= parameters && used < BLOCK; row++)
            memset(rows[row] + used, 0, (size_t)(BLOCK - used) * sizeof(float));
        add_block(parameters, rows, sums);
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

/* Beside paper of known brightness, and at corners of single squares. */
FOR_EACH_PROCESSOR
void papered_equations(
    const int n, const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules,
    double *products)
{
    multiply_rows(n == FEWER ? FEWER : PARAMETERS, 1, values, window, at, rules, products);
}

/* Set a and b by linear least squares with everything else as it stands (reference.edges._brightness); every second block says
 * enough. */
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
        along_line(line1, window->u + start, window->v + start, x, y, &one);
        along_line(line2, window->u + start, window->v + start, x, y, &two);
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
