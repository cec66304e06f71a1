/* The fit of whole tags with known modules, for the positions of their four corners. The definition in numpy is in
 * tests/kernels/reference/tags.py, the numbers are in rigkit.detection.tags.whole_tags.
 *
 * Cells between `breaks` along both sides of a tag are ink or paper: its modules, the gap around it, and what is beyond. The
 * place of a pixel in the tag is a cubic polynomial of its position. Moves of the four corners displace it with the weights of
 * bilinear interpolation, moves of the middles of the sides by 4 x (1 - x) and 4 y (1 - y) times these. The parameters are the
 * moves, those of the middles with a prior, the blur s, and the brightness (1 + g . x) (a + b S) with S the share of ink. Pixels
 * are processed in squares, which are near the same edges and vectorised. */
#include "kernels.h"

enum { SHARES = 6, BENDS = 8, MOVES = 2 * SHARES, S = MOVES, A, B, GX, GY, PARAMETERS };
enum { ORDERS = 4, MAX_CELLS = 32, SIDE = TAG_SIDE, BLOCK = SIDE * SIDE, AT_ONCE = 4, LANES = 16 };
_Static_assert(4 * LANES == BLOCK * AT_ONCE, "products are taken in four parts");

typedef float lanes_t __attribute__((vector_size(4 * LANES), aligned(4)));

/* Distances from edges are clipped to this, in s: `decay` is defined up to 12.6. */
#define FURTHEST 12.0f

typedef struct {
    const double *map, *centre, *breaks;
    double scale, s, a, b, g[2], moves[MOVES];
    const uint8_t *ink;
    int64_t cells;
} tag_t;

/* The pixels of a square: positions relative to the centre, brightness, weights of the moves, and 0 in `counts` for those not
 * used. */
typedef struct {
    float u[BLOCK], v[BLOCK], value[BLOCK], counts[BLOCK], share[SHARES][BLOCK];
} tag_block_t;
_Static_assert(sizeof(tag_block_t) <= TAG_BLOCK * sizeof(double), "scratch holds the pixels");

/* Places (x, y) in the tag, and their derivatives by u and v. */
typedef struct {
    float at[2][BLOCK], grow[2][2][BLOCK];
} tag_place_t;

/* The edges between `count` cells from `first` on along one side: shares of the pixels beyond them, and their derivatives by the
 * distance over s. */
typedef struct {
    float part[MAX_CELLS][ORDERS][BLOCK];
    int64_t first, count;
} profile_t;

/* The share of ink in pixels, its gradient, and its derivative by the blur. */
typedef struct {
    float of[BLOCK], gradient[2][BLOCK], by_blur[BLOCK];
} share_t;

INLINE void tag_place(const tag_t *tag, const float *restrict du, const float *restrict dv, tag_place_t *restrict out)
{
    const float per_px = (float)(1.0 / tag->scale);
    for (int axis = 0; axis < 2; axis++) {
        float m[TAG_TERMS];
        for (int k = 0; k < TAG_TERMS; k++)
            m[k] = (float)tag->map[axis * TAG_TERMS + k];
        for (int i = 0; i < BLOCK; i++) {
            const float u = du[i] * per_px, v = dv[i] * per_px, uu = u * u, uv = u * v, vv = v * v;
            out->at[axis][i] = (m[0] + m[1] * u + m[2] * v) + (m[3] * uu + m[4] * uv + m[5] * vv) + uu * (m[6] * u + m[7] * v)
                + vv * (m[8] * u + m[9] * v);
            out->grow[axis][0][i] =
                per_px * ((m[1] + 2.0f * m[3] * u + m[4] * v) + (3.0f * m[6] * uu + 2.0f * m[7] * uv + m[8] * vv));
            out->grow[axis][1][i] =
                per_px * ((m[2] + m[4] * u + 2.0f * m[5] * v) + (m[7] * uu + 2.0f * m[8] * uv + 3.0f * m[9] * vv));
        }
    }
}

/* Set `out` to the profiles at `place`, a coordinate in the tag with a gradient of `slope` per px; `per_slope` is 1 / slope. */
INLINE void profile_of(
    const tag_t *tag, const float *restrict place, const float *restrict slope, const float *restrict per_slope,
    const float *restrict kurtosis, const tag_rules_t *rules, profile_t *restrict out)
{
    const int64_t breaks = tag->cells - 1;
    const float once = (float)(1.0 / tag->s), tail = (float)(rules->tail_sigmas * tag->s);
    float per_s[BLOCK], low = 1e30f, high = -1e30f;
    for (int i = 0; i < BLOCK; i++) {
        const float reach = tail * slope[i];
        per_s[i] = once * per_slope[i];
        low = place[i] - reach < low ? place[i] - reach : low;
        high = place[i] + reach > high ? place[i] + reach : high;
    }
    int64_t first = 0, last = breaks;
    while (first < breaks && tag->breaks[first] < (double)low)
        first++;
    while (last > first && tag->breaks[last - 1] > (double)high)
        last--;
    out->first = first;
    out->count = last - first;
    for (int64_t k = 0; k < out->count; k++) {
        const float edge = (float)tag->breaks[first + k];
        float (*restrict part)[BLOCK] = out->part[k];
        for (int i = 0; i < BLOCK; i++) {
            float x = (place[i] - edge) * per_s[i], step[5];
            x = x < FURTHEST ? x : FURTHEST;
            x = x > -FURTHEST ? x : -FURTHEST;
            blurred_edge(x, kurtosis[i], step);
            part[0][i] = 0.5f + 0.5f * step[0];
            for (int order = 1; order < ORDERS; order++)
                part[order][i] = 0.5f * step[order];
        }
    }
}

/* Add to `sums`, for the orders along x and y that the series below uses, the difference between the cells of one row and of the
 * row `before` it, times the share `beyond` the edge between them; for the first row there is no edge, and the difference is to
 * 0. */
INLINE void add_row(
    const profile_t *along, const uint8_t *ink, const uint8_t *before, const float (*restrict beyond)[BLOCK],
    float (*restrict sums)[ORDERS][BLOCK])
{
    float row[ORDERS][BLOCK];
    int empty = 1;
    for (int64_t k = 0; k <= along->count; k++) {
        int more = (int)ink[k] - (before ? (int)before[k] : 0);
        if (k)
            more -= (int)ink[k - 1] - (before ? (int)before[k - 1] : 0);
        if (!more)
            continue;
        if (empty)
            memset(row, 0, sizeof row);
        empty = 0;
        for (int order = 0; order < ORDERS; order++)
            for (int i = 0; i < BLOCK; i++)
                row[order][i] += k ? (float)more * along->part[k - 1][order][i] : order ? 0.0f : (float)more;
    }
    if (empty)
        return;
    for (int order = 0; order < ORDERS; order++)
        for (int other = 0; other < ORDERS; other++)
            for (int i = 0; i < BLOCK && abs(order - other) != 3 && order * other != 3; i++)
                sums[order][other][i] += row[order][i] * (beyond ? beyond[other][i] : other ? 0.0f : 1.0f);
}

/* Set `out` to the share of ink in the pixels at (u, v) from the centre (reference.tags.picture). */
INLINE void share_of_ink(const tag_t *tag, const float *u, const float *v, const tag_rules_t *rules, share_t *restrict out)
{
    tag_place_t here;
    tag_place(tag, u, v, &here);
    float n[2][2][BLOCK], kurtosis[BLOCK], slope[BLOCK], per_slope[BLOCK];
    profile_t along[2];
    const double sharp = tag->s > rules->sharp_blur ? tag->s : rules->sharp_blur;
    const float excess = (float)(rules->pixel_kurtosis / (sharp * sharp * sharp * sharp)), per_s = (float)(1.0 / tag->s);
    for (int axis = 0; axis < 2; axis++) {
        for (int i = 0; i < BLOCK; i++) {
            const float by_u = here.grow[axis][0][i], by_v = here.grow[axis][1][i], square = by_u * by_u + by_v * by_v;
            slope[i] = sqrtf(square > 1e-18f ? square : 1e-18f);
            per_slope[i] = 1.0f / slope[i];
            n[axis][0][i] = by_u * per_slope[i];
            n[axis][1][i] = by_v * per_slope[i];
            const float c2 = n[axis][0][i] * n[axis][0][i], s2 = n[axis][1][i] * n[axis][1][i];
            kurtosis[i] = excess * (c2 * c2 + s2 * s2);
        }
        profile_of(tag, here.at[axis], slope, per_slope, kurtosis, rules, along + axis);
    }
    float sums[ORDERS][ORDERS][BLOCK] = {{{0.0f}}};
    const uint8_t *ink = tag->ink + along[1].first * tag->cells + along[0].first, *before = NULL;
    for (int64_t j = 0; j <= along[1].count; j++, before = ink, ink += tag->cells)
        add_row(along, ink, before, j ? (const float (*)[BLOCK])along[1].part[j - 1] : NULL, sums);
    for (int i = 0; i < BLOCK; i++) {
        /* The blurs along the two normals are correlated: Mehler's series, as in edges_model.c. */
        const float rho = n[0][0][i] * n[1][0][i] + n[0][1][i] * n[1][1][i], half = 0.5f * rho * rho;
        const float by_x = per_s * (sums[1][0][i] + rho * sums[2][1][i] + half * sums[3][2][i]);
        const float by_y = per_s * (sums[0][1][i] + rho * sums[1][2][i] + half * sums[2][3][i]);
        out->gradient[0][i] = by_x * n[0][0][i] + by_y * n[1][0][i];
        out->gradient[1][i] = by_x * n[0][1][i] + by_y * n[1][1][i];
        out->by_blur[i] = per_s * (sums[2][0][i] + sums[0][2][i] + 2.0f * rho * sums[1][1][i]);
        out->of[i] = sums[0][0][i] + rho * sums[1][1][i] + half * (sums[2][2][i] + rho / 3.0f * sums[3][3][i]);
    }
}

/* Set `pixels` to the square with its first pixel at (u, v); pixels in the tag or within `reach` sides of it count. Return their
 * number. */
INLINE int64_t block_pixels(
    const tag_t *tag, const void *grey, int64_t bytes, int64_t width, int64_t height, double reach, int64_t u, int64_t v,
    tag_block_t *restrict pixels)
{
    for (int i = 0; i < BLOCK; i++) {
        int64_t column = u + i % SIDE, row = v + i / SIDE;
        pixels->counts[i] = column < width && row < height ? 1.0f : 0.0f;
        column = column < width ? column : width - 1;
        row = row < height ? row : height - 1;
        pixels->value[i] = (float)level_at(grey, bytes, row * width + column);
        pixels->u[i] = (float)((double)(u + i % SIDE) - tag->centre[0]);
        pixels->v[i] = (float)((double)(v + i / SIDE) - tag->centre[1]);
    }
    tag_place_t here;
    tag_place(tag, pixels->u, pixels->v, &here);
    const float low = (float)-reach, high = (float)(1.0 + reach);
    float count = 0.0f;
    for (int i = 0; i < BLOCK; i++) {
        const float x = here.at[0][i], y = here.at[1][i];
        /* A negative area means that the polynomial has folded, where it would show the tag again, mirrored. */
        const float area = here.grow[0][0][i] * here.grow[1][1][i] - here.grow[0][1][i] * here.grow[1][0][i];
        pixels->counts[i] *= ((x >= low) & (x <= high) & (y >= low) & (y <= high) & (area > 0.0f)) ? 1.0f : 0.0f;
        const float share[SHARES] = {(1.0f - x) * (1.0f - y), x * (1.0f - y),       (1.0f - x) * y, x * y,
                                     4.0f * x * (1.0f - x),   4.0f * y * (1.0f - y)};
        for (int part = 0; part < SHARES; part++)
            pixels->share[part][i] = share[part];
        count += pixels->counts[i];
    }
    return (int64_t)count;
}

/* Gather at most `capacity` squares of pixels in and around the tag; return their number, and set `seen` to the number of pixels
 * that count. */
FOR_EACH_PROCESSOR
static int64_t tag_pixels(
    const tag_t *tag, const void *grey, int64_t bytes, int64_t width, int64_t height, double reach, tag_block_t *blocks,
    int64_t capacity, int64_t *seen)
{
    *seen = 0;
    if (!isfinite(tag->centre[0] + tag->centre[1] + tag->scale))
        return 0;
    const double far = tag->scale * (1.0 + 2.0 * reach);
    int64_t left = (int64_t)ceil(tag->centre[0] - far), right = (int64_t)floor(tag->centre[0] + far);
    int64_t top = (int64_t)ceil(tag->centre[1] - far), bottom = (int64_t)floor(tag->centre[1] + far);
    left = left > 0 ? left : 0;
    top = top > 0 ? top : 0;
    right = right < width - 1 ? right : width - 1;
    bottom = bottom < height - 1 ? bottom : height - 1;
    int64_t count = 0;
    for (int64_t v = top; v <= bottom; v += SIDE)
        for (int64_t u = left; u <= right && count < capacity; u += SIDE) {
            const int64_t mine = block_pixels(tag, grey, bytes, width, height, reach, u, v, blocks + count);
            *seen += mine;
            count += mine > 0;
        }
    return count;
}

/* Set `rows`, from pixel `first` on, to the derivatives of the brightness of a square's pixels by every parameter, and to the
 * residuals. */
INLINE void block_rows(
    const tag_t *tag, const tag_block_t *pixels, const tag_rules_t *rules, int64_t first, float (*restrict rows)[AT_ONCE * BLOCK])
{
    float u[BLOCK], v[BLOCK];
    memcpy(u, pixels->u, sizeof u);
    memcpy(v, pixels->v, sizeof v);
    for (int part = 0; part < SHARES; part++) {
        const float by_u = (float)tag->moves[2 * part], by_v = (float)tag->moves[2 * part + 1];
        for (int i = 0; i < BLOCK; i++) {
            u[i] -= pixels->share[part][i] * by_u;
            v[i] -= pixels->share[part][i] * by_v;
        }
    }
    share_t share;
    share_of_ink(tag, u, v, rules, &share);
    const float per_px = (float)(1.0 / tag->scale), a = (float)tag->a, b = (float)tag->b;
    const float light_u = (float)tag->g[0], light_v = (float)tag->g[1];
    for (int i = 0; i < BLOCK; i++) {
        const float x = pixels->u[i] * per_px, y = pixels->v[i] * per_px, counts = pixels->counts[i];
        const float light = counts * (1.0f + light_u * x + light_v * y), level = a + b * share.of[i], steep = light * b;
        const int64_t k = first + i;
        for (int part = 0; part < SHARES; part++) {
            rows[2 * part][k] = -steep * pixels->share[part][i] * share.gradient[0][i];
            rows[2 * part + 1][k] = -steep * pixels->share[part][i] * share.gradient[1][i];
        }
        rows[S][k] = steep * share.by_blur[i];
        rows[A][k] = light;
        rows[B][k] = light * share.of[i];
        rows[GX][k] = counts * level * x;
        rows[GY][k] = counts * level * y;
        rows[PARAMETERS][k] = counts * pixels->value[i] - light * level;
    }
}

/* Set the normal equations; return the sum of squared residuals. */
FOR_EACH_PROCESSOR
static double tag_equations(
    const tag_t *tag, const tag_block_t *blocks, int64_t count, const tag_rules_t *rules, double N[PARAMETERS * PARAMETERS],
    double right[PARAMETERS])
{
    lanes_t sums[(PARAMETERS + 1) * (PARAMETERS + 2) / 2];
    memset(sums, 0, sizeof sums);
    for (int64_t start = 0; start < count; start += AT_ONCE) {
        float rows[PARAMETERS + 1][AT_ONCE * BLOCK];
        if (count - start < AT_ONCE)
            memset(rows, 0, sizeof rows);
        for (int64_t k = 0; k < AT_ONCE && start + k < count; k++)
            block_rows(tag, blocks + start + k, rules, k * BLOCK, rows);
        lanes_t *sum = sums;
        for (int i = 0; i <= PARAMETERS; i++) {
            const lanes_t *one = (const lanes_t *)rows[i], o0 = one[0], o1 = one[1], o2 = one[2], o3 = one[3];
            for (int j = 0; j <= i; j++, sum++) {
                const lanes_t *other = (const lanes_t *)rows[j];
                *sum += (o0 * other[0] + o1 * other[1]) + (o2 * other[2] + o3 * other[3]);
            }
        }
    }
    double products[PARAMETERS + 1];
    const lanes_t *sum = sums;
    for (int i = 0; i <= PARAMETERS; i++)
        for (int j = 0; j <= i; j++, sum++) {
            products[j] = 0.0;
            for (int lane = 0; lane < LANES; lane++)
                products[j] += (double)(*sum)[lane];
            if (i < PARAMETERS)
                N[i * PARAMETERS + j] = products[j];
        }
    memcpy(right, products, PARAMETERS * sizeof(double));
    return products[PARAMETERS];
}

/* Add the priors of the moves of the sides' middles and of the gradient of the light, for noise of this `variance`. */
static void add_prior(
    const tag_t *tag, double curvature_sigma, double variance, const tag_rules_t *rules, double N[PARAMETERS * PARAMETERS],
    double step[PARAMETERS])
{
    const double dim = 1.0 / (rules->light_sigma * tag->scale), straight = variance / (curvature_sigma * curvature_sigma);
    for (int i = BENDS; i < MOVES; i++) {
        step[i] -= straight * tag->moves[i];
        N[i * (PARAMETERS + 1)] += straight;
    }
    for (int axis = 0; axis < 2; axis++) {
        step[GX + axis] -= dim * dim * variance * tag->g[axis];
        N[(GX + axis) * (PARAMETERS + 1)] += dim * dim * variance;
    }
}

/* Move the parameters by a step, clipped where the model is not linear; return the largest move before clipping. */
static double take_step(tag_t *tag, const double step[PARAMETERS], const tag_rules_t *rules)
{
    double largest = 0.0;
    for (int i = 0; i < MOVES; i++) {
        largest = fabs(step[i]) > largest ? fabs(step[i]) : largest;
        tag->moves[i] += limited(step[i], rules->max_move_px);
    }
    tag->s += limited(step[S], rules->max_blur_change * tag->s);
    tag->s = tag->s < rules->min_blur ? rules->min_blur : tag->s > rules->max_blur ? rules->max_blur : tag->s;
    tag->a += step[A];
    tag->b += step[B];
    tag->g[0] = limited(tag->g[0] + step[GX], 1.0);
    tag->g[1] = limited(tag->g[1] + step[GY], 1.0);
    return largest;
}

/* Write the results of a fitted tag; `N` is the factor of the normal equations. */
static void write_tag(const tag_t *tag, const double *N, double variance, double *result)
{
    memcpy(result, tag->moves, BENDS * sizeof(double));
    for (int corner = 0; corner < 4; corner++) {
        double spread = 0.0;
        for (int axis = 0; axis < 2; axis++) {
            double unit[PARAMETERS] = {0.0};
            unit[2 * corner + axis] = 1.0;
            cholesky_solve(N, PARAMETERS, unit);
            spread += unit[2 * corner + axis];
        }
        result[BENDS + corner] = sqrt(0.5 * variance * spread);
    }
    result[BENDS + 4] = tag->s;
    result[BENDS + 5] = -tag->b;
    result[BENDS + 6] = sqrt(variance);
    result[BENDS + 7] = 1.0;
}

/* Fit `count` tags by Gauss-Newton steps (reference.tags). */
void fit_tags(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *maps, const double *centres,
    const double *scales, const uint8_t *ink, int64_t cells, const double *breaks, double reach, const double *blur,
    const double *contrast, const double *curvature_sigma, const tag_rules_t *rules, int64_t capacity, double *scratch, double *out)
{
    tag_block_t *blocks = (tag_block_t *)scratch;
    for (int64_t n = 0; n < count; n++) {
        double *result = out + n * TAG_OUTCOMES;
        memset(result, 0, TAG_OUTCOMES * sizeof(double));
        tag_t tag = {.s = blur[n], .b = -contrast[n], .breaks = breaks, .ink = ink + cells * cells * n, .cells = cells};
        tag.map = maps + 2 * TAG_TERMS * n;
        tag.centre = centres + 2 * n;
        tag.scale = scales[n];
        int64_t seen;
        const int64_t squares = tag_pixels(&tag, grey, bytes, width, height, reach, blocks, capacity, &seen);
        if (seen <= PARAMETERS || cells > MAX_CELLS)
            continue;
        for (int64_t k = 0; k < squares; k++)
            for (int i = 0; i < BLOCK; i++)
                tag.a += (double)blocks[k].counts[i] * ((double)blocks[k].value[i] - 0.5 * tag.b) / (double)seen;
        double N[PARAMETERS * PARAMETERS], right[PARAMETERS], step[PARAMETERS], variance = 0.0;
        int settled = 0;
        for (int64_t k = 0; k < rules->iterations && !settled; k++) {
            const double left = tag_equations(&tag, blocks, squares, rules, N, right);
            variance = left / (double)(seen - PARAMETERS);
            variance = variance > rules->min_variance ? variance : rules->min_variance;
            memcpy(step, right, sizeof step);
            add_prior(&tag, curvature_sigma[n], variance, rules, N, step);
            if (!cholesky(N, PARAMETERS))
                break;
            cholesky_solve(N, PARAMETERS, step);
            /* The corners may converge before the light, when residuals are not yet noise and sigmas would be wrong. */
            double taken = 0.0;
            for (int i = 0; i < PARAMETERS; i++)
                taken += step[i] * right[i];
            settled = take_step(&tag, step, rules) <= rules->converged_px && taken <= rules->max_taken * left;
        }
        if (settled)
            write_tag(&tag, N, variance, result);
    }
}
