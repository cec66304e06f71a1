/* The fit of whole tags whose modules are known, one after the other: where their four corners are. The definition in
 * numpy is in tests/kernels/reference/tags.py, the numbers are in rigkit.detection.tags.whole.
 *
 * Cells between `breaks` along both sides of a tag are ink or paper: its modules, the gap around it, what lies beyond.
 * A pixel's place in the tag is a cubic polynomial of its position, from which the four corners move the picture, each
 * by the share that it has in the bilinear interpolation of the place, and in which sides bend: by 4 x (1 - x) and
 * 4 y (1 - y) times how far their middles move. Free are these moves, those of the middles as far as they are not known,
 * the blur s, and the light (1 + g . x) (a + b S), S the share of ink. */
#include "kernels.h"

enum { SHARES = 6, BENDS = 8, MOVES = 2 * SHARES, S = MOVES, A, B, GX, GY, PARAMETERS };
enum { ORDERS = 4, MOST_CELLS = 32 };

typedef struct {
    const double *map, *centre, *breaks;
    double scale, s, a, b, g[2], moves[MOVES];
    const uint8_t *ink;
    int64_t cells;
} tag_t;

typedef struct {
    double u, v, value, share[SHARES];
} tag_pixel_t;

/* A place (x, y) in the tag, and how it grows along u and v. */
typedef struct {
    double at[2], grow[2][2];
} tag_place_t;

/* How much of a pixel the cells from `first` on along one side are, and its derivatives along d / s. */
typedef struct {
    float part[ORDERS][MOST_CELLS];
    int64_t first, count;
} profile_t;

INLINE tag_place_t tag_place(const tag_t *tag, double du, double dv)
{
    const double u = du / tag->scale, v = dv / tag->scale, uu = u * u, uv = u * v, vv = v * v;
    const double terms[TAG_TERMS] = {1.0, u, v, uu, uv, vv, uu * u, uu * v, uv * v, vv * v};
    const double by_u[TAG_TERMS] = {0.0, 1.0, 0.0, 2.0 * u, v, 0.0, 3.0 * uu, 2.0 * uv, vv, 0.0};
    const double by_v[TAG_TERMS] = {0.0, 0.0, 1.0, 0.0, u, 2.0 * v, 0.0, uu, 2.0 * uv, 3.0 * vv};
    tag_place_t out = {{0.0}};
    for (int axis = 0; axis < 2; axis++) {
        for (int k = 0; k < TAG_TERMS; k++) {
            const double part = tag->map[axis * TAG_TERMS + k];
            out.at[axis] += part * terms[k];
            out.grow[axis][0] += part * by_u[k];
            out.grow[axis][1] += part * by_v[k];
        }
        out.grow[axis][0] /= tag->scale;
        out.grow[axis][1] /= tag->scale;
    }
    return out;
}

/* Set `out` to the profile at `place`, where a px is `slope` along the side. */
INLINE void profile_of(const tag_t *tag, double place, double slope, float kurtosis, const tag_rules_t *rules, profile_t *out)
{
    const int64_t breaks = tag->cells - 1;
    const double per_s = 1.0 / (slope * tag->s), reach = rules->tail_sigmas / per_s;
    int64_t first = 0, last = breaks;
    while (first < breaks && tag->breaks[first] < place - reach)
        first++;
    while (last > first && tag->breaks[last - 1] > place + reach)
        last--;
    const int count = (int)(last - first);
    float edge[ORDERS][MOST_CELLS];
    for (int k = 0; k < count; k++) {
        float step[5];
        blurred_edge((float)((place - tag->breaks[first + k]) * per_s), kurtosis, step);
        edge[0][k] = 0.5f + 0.5f * step[0];
        for (int order = 1; order < ORDERS; order++)
            edge[order][k] = 0.5f * step[order];
    }
    out->first = first;
    out->count = count + 1;
    for (int order = 0; order < ORDERS; order++) {
        float before = order ? 0.0f : 1.0f;
        for (int k = 0; k < count; k++) {
            out->part[order][k] = before - edge[order][k];
            before = edge[order][k];
        }
        out->part[order][count] = before;
    }
}

/* Return the share of ink of a pixel at (u, v) from the centre, its gradient and its derivative by the blur
 * (reference.tags.share_of_ink). */
INLINE double share_of_ink(const tag_t *tag, double u, double v, const tag_rules_t *rules, double gradient[2], double *by_blur)
{
    const tag_place_t here = tag_place(tag, u, v);
    double slope[2], n[2][2];
    profile_t along[2];
    const double sharp = tag->s > rules->sharp_blur ? tag->s : rules->sharp_blur;
    for (int axis = 0; axis < 2; axis++) {
        slope[axis] = hypot(here.grow[axis][0], here.grow[axis][1]);
        slope[axis] = slope[axis] > 1e-9 ? slope[axis] : 1e-9;
        n[axis][0] = here.grow[axis][0] / slope[axis];
        n[axis][1] = here.grow[axis][1] / slope[axis];
        const double c2 = n[axis][0] * n[axis][0], s2 = n[axis][1] * n[axis][1];
        const float kurtosis = (float)(rules->pixel_kurtosis * (c2 * c2 + s2 * s2) / (sharp * sharp * sharp * sharp));
        profile_of(tag, here.at[axis], slope[axis], kurtosis, rules, along + axis);
    }
    float sums[ORDERS][ORDERS] = {{0.0f}};
    for (int64_t j = 0; j < along[1].count; j++) {
        const uint8_t *ink = tag->ink + (along[1].first + j) * tag->cells + along[0].first;
        float row[ORDERS] = {0.0f};
        for (int64_t i = 0; i < along[0].count; i++)
            for (int order = 0; order < ORDERS; order++)
                row[order] += ink[i] ? along[0].part[order][i] : 0.0f;
        for (int k = 0; k < ORDERS; k++)
            for (int order = 0; order < ORDERS; order++)
                sums[order][k] += row[order] * along[1].part[k][j];
    }
    /* Blur along the two normals is correlated: Mehler's series, as in edges.c. */
    const double rho = n[0][0] * n[1][0] + n[0][1] * n[1][1], half = 0.5 * rho * rho;
    const double by_x = (sums[1][0] + rho * sums[2][1] + half * sums[3][2]) / tag->s;
    const double by_y = (sums[0][1] + rho * sums[1][2] + half * sums[2][3]) / tag->s;
    gradient[0] = by_x * n[0][0] + by_y * n[1][0];
    gradient[1] = by_x * n[0][1] + by_y * n[1][1];
    *by_blur = (sums[2][0] + sums[0][2] + 2.0 * rho * sums[1][1]) / tag->s;
    return sums[0][0] + rho * sums[1][1] + half * (sums[2][2] + rho / 3.0 * sums[3][3]);
}

/* Gather the pixels that lie in the tag, or up to `reach` of its side beside it; return how many, at most `most`. */
static int64_t tag_pixels(
    const tag_t *tag, const void *grey, int64_t bytes, int64_t width, int64_t height, double reach, tag_pixel_t *pixels, int64_t most)
{
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
    for (int64_t v = top; v <= bottom; v++)
        for (int64_t u = left; u <= right; u++) {
            const double du = (double)u - tag->centre[0], dv = (double)v - tag->centre[1];
            const tag_place_t here = tag_place(tag, du, dv);
            const double x = here.at[0], y = here.at[1];
            if (!(x >= -reach && x <= 1.0 + reach && y >= -reach && y <= 1.0 + reach) || count == most)
                continue;
            const int64_t k = v * width + u;
            const double value = bytes ? (double)((const uint8_t *)grey)[k] : (double)((const float *)grey)[k];
            pixels[count++] = (tag_pixel_t){
                du, dv, value,
                {(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y, 4.0 * x * (1.0 - x), 4.0 * y * (1.0 - y)}};
        }
    return count;
}

/* Fill the normal equations; return the sum of squared residuals. */
FOR_EACH_PROCESSOR
static double tag_equations(
    const tag_t *tag, const tag_pixel_t *pixels, int64_t count, const tag_rules_t *rules,
    double N[PARAMETERS * PARAMETERS], double right[PARAMETERS])
{
    double sum = 0.0;
    memset(N, 0, PARAMETERS * PARAMETERS * sizeof(double));
    memset(right, 0, PARAMETERS * sizeof(double));
    for (int64_t k = 0; k < count; k++) {
        const tag_pixel_t *here = pixels + k;
        double u = here->u, v = here->v, gradient[2], by_blur;
        for (int part = 0; part < SHARES; part++) {
            u -= here->share[part] * tag->moves[2 * part];
            v -= here->share[part] * tag->moves[2 * part + 1];
        }
        const double share = share_of_ink(tag, u, v, rules, gradient, &by_blur);
        const double x = here->u / tag->scale, y = here->v / tag->scale, light = 1.0 + tag->g[0] * x + tag->g[1] * y;
        const double level = tag->a + tag->b * share, off = here->value - light * level, steep = light * tag->b;
        double row[PARAMETERS];
        for (int part = 0; part < SHARES; part++) {
            row[2 * part] = -steep * here->share[part] * gradient[0];
            row[2 * part + 1] = -steep * here->share[part] * gradient[1];
        }
        row[S] = steep * by_blur;
        row[A] = light;
        row[B] = light * share;
        row[GX] = level * x;
        row[GY] = level * y;
        sum += off * off;
        add_residual(N, right, row, PARAMETERS, off);
    }
    return sum;
}

void fit_tags(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *maps, const double *centres,
    const double *scales, const uint8_t *ink, int64_t cells, const double *breaks, double reach, const double *blur,
    const double *contrast, const double *bend_sigma, const tag_rules_t *rules, int64_t most, double *scratch, double *out)
{
    tag_pixel_t *pixels = (tag_pixel_t *)scratch;
    for (int64_t n = 0; n < count; n++) {
        double *result = out + n * TAG_OUTCOMES;
        memset(result, 0, TAG_OUTCOMES * sizeof(double));
        tag_t tag = {
            .map = maps + 2 * TAG_TERMS * n, .centre = centres + 2 * n, .breaks = breaks, .scale = scales[n], .s = blur[n],
            .b = -contrast[n], .ink = ink + cells * cells * n, .cells = cells};
        const int64_t seen = tag_pixels(&tag, grey, bytes, width, height, reach, pixels, most);
        if (seen <= PARAMETERS || cells > MOST_CELLS)
            continue;
        for (int64_t k = 0; k < seen; k++)
            tag.a += (pixels[k].value - 0.5 * tag.b) / (double)seen;
        const double dim = 1.0 / (rules->light_sigma * tag.scale);
        double N[PARAMETERS * PARAMETERS], step[PARAMETERS], variance = 0.0;
        int solved = 1, settled = 0;
        for (int64_t k = 0; k < rules->iterations && solved && !settled; k++) {
            variance = tag_equations(&tag, pixels, seen, rules, N, step) / (double)(seen - PARAMETERS);
            variance = variance > rules->least_variance ? variance : rules->least_variance;
            const double straight = variance / (bend_sigma[n] * bend_sigma[n]);
            for (int i = BENDS; i < MOVES; i++) {
                step[i] -= straight * tag.moves[i];
                N[i * (PARAMETERS + 1)] += straight;
            }
            for (int axis = 0; axis < 2; axis++) {
                step[GX + axis] -= dim * dim * variance * tag.g[axis];
                N[(GX + axis) * (PARAMETERS + 1)] += dim * dim * variance;
            }
            solved = cholesky(N, PARAMETERS);
            if (!solved)
                break;
            cholesky_solve(N, PARAMETERS, step);
            double largest = 0.0;
            for (int i = 0; i < MOVES; i++) {
                largest = fabs(step[i]) > largest ? fabs(step[i]) : largest;
                tag.moves[i] += limited(step[i], rules->most_move_px);
            }
            tag.s += limited(step[S], rules->most_blur_change * tag.s);
            tag.s = tag.s < rules->least_blur ? rules->least_blur : tag.s > rules->most_blur ? rules->most_blur : tag.s;
            tag.a += step[A];
            tag.b += step[B];
            tag.g[0] = limited(tag.g[0] + step[GX], 1.0);
            tag.g[1] = limited(tag.g[1] + step[GY], 1.0);
            settled = largest <= rules->converged_px;
        }
        if (!solved || !settled)
            continue;
        memcpy(result, tag.moves, BENDS * sizeof(double));
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
        result[BENDS + 4] = tag.s;
        result[BENDS + 5] = -tag.b;
        result[BENDS + 6] = sqrt(variance);
        result[BENDS + 7] = 1.0;
    }
}
