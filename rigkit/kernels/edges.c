/* The fit of the edge model to chessboard corners, one corner after the other; at the end, how the lines of a lattice
 * bend. The definitions in numpy are in tests/kernels/reference/edges.py, the numbers in rigkit.detection.subpixel.
 *
 * The pixels of a corner are gathered once. Every Gauss-Newton step evaluates the model and its derivatives in float32,
 * a block of pixels at a time, which the compiler vectorises; products are summed in float32 lanes, and the normal
 * equations are solved in double: eleven, or the FEWER of a corner whose lines bend as given. */
#include "kernels.h"

enum { X, Y, T1, T2, S, A, B, GX, GY, K1, K2, PARAMETERS };
enum { FEWER = K1, ROWS = PARAMETERS + 1, LANES = 8, GROUPS = 8, BLOCK = LANES * GROUPS };
enum { STRETCH = 16, CACHE_LINE = 64 };

/* Eight numbers at once, wherever they lie. */
typedef float lanes_t __attribute__((vector_size(4 * LANES), aligned(4)));
typedef int32_t mask_t __attribute__((vector_size(4 * LANES)));

/* Pixels that are taken from the image together, wider and wider. */
typedef uint8_t bytes_t __attribute__((vector_size(STRETCH)));
typedef uint16_t halves_t __attribute__((vector_size(2 * STRETCH)));
typedef int32_t words_t __attribute__((vector_size(4 * STRETCH)));
typedef float bright_t __attribute__((vector_size(4 * STRETCH), aligned(4)));

/* What the lattice says of a corner: its cell's sides, the curvature of its lines and how uncertain it is, where their
 * neighbours are and by how much these are turned, how far its window goes towards these, in sides of the cell, where that is not by rule, which of these
 * have no corner of the lattice, and how bright it is beyond these, NaN where that is not known. Of a corner of one square
 * alone, on which side of its lines that lies, +1 or -1; of others 0. */
typedef struct {
    const double *sides, *curvature, *curvature_sigma, *gaps, *tilts, *reach, *paper, *single;
    const uint8_t *ends;
} geometry_t;

/* The pixels of a corner, relative to (centre_u, centre_v), at most `radius` from it both ways. `rows` has room for the
 * rows of reference.edges.linearise, a block of pixels after the other, `square`, `turned`, `change` and `paired` for `across`
 * x `across` pixels around the centre. */
typedef struct {
    float *u, *v, *value, *rows, *square, *turned, *change, *paired;
    int64_t count, across, radius;
    double centre_u, centre_v, size;
} window_t;

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

typedef struct {
    double lo, hi;
} range_t;

/* Return where low <= x / inverse + offset <= high: of a line along the row, with an infinite inverse, everywhere or
 * nowhere. */
INLINE range_t between(double inverse, double offset, double low, double high)
{
    const double lo = (low - offset) * inverse, hi = (high - offset) * inverse;
    return (range_t){lo < hi ? lo : hi, lo < hi ? hi : lo};
}

INLINE range_t band(double inverse, double offset, double limit)
{
    return between(inverse, offset, -limit, limit);
}

INLINE range_t both(range_t a, range_t b)
{
    return (range_t){a.lo > b.lo ? a.lo : b.lo, a.hi < b.hi ? a.hi : b.hi};
}

/* An image as the camera gave it, a byte a pixel, or of floats: windows are copied anyway. */
typedef struct {
    const void *brightness;
    int64_t width, height, bytes;
} picture_t;

/* Append `count` pixels of row `v` from column `first` on, both from the centre. */
INLINE void take(window_t *window, const picture_t image, int64_t v, int32_t first, int32_t count)
{
    const int64_t start = ((int64_t)window->centre_v + v) * image.width + (int64_t)window->centre_u + first;
    const uint8_t *restrict bytes = (const uint8_t *)image.brightness + start;
    const float *restrict floats = (const float *)image.brightness + start;
    float *restrict us = window->u + window->count, *restrict vs = window->v + window->count;
    float *restrict values = window->value + window->count;
    /* In steps of known length: what is too much is written over, or not looked at. */
    const bright_t steps = {
        0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f, 8.0f, 9.0f, 10.0f, 11.0f, 12.0f, 13.0f, 14.0f, 15.0f};
    for (int32_t k = 0; k < count; k += STRETCH) {
        *(bright_t *)(us + k) = steps + (float)(first + k);
        *(bright_t *)(vs + k) = (bright_t){0.0f} + (float)v;
    }
    if (!image.bytes)
        memcpy(values, floats, (size_t)count * sizeof(float));
    else if (start + count + STRETCH <= image.width * image.height)
        for (int32_t k = 0; k < count; k += STRETCH) {
            /* Twice as wide at a time, which is what processors can do: GCC 12 takes one pixel after the other elsewise. */
            bytes_t stretch;
            memcpy(&stretch, bytes + k, sizeof stretch);
            const words_t words = __builtin_convertvector(__builtin_convertvector(stretch, halves_t), words_t);
            *(bright_t *)(values + k) = __builtin_convertvector(words, bright_t);
        }
    else
        for (int32_t k = 0; k < count; k++)
            values[k] = (float)bytes[k];
    window->count += count;
}

/* Return how far the window reaches towards neighbouring line `k` of cells that are `across` px wide that way
 * (reference.edges._reach). */
INLINE double reach_to(const geometry_t at, int k, double blur, double across, const edge_rules_t *rules)
{
    if (isfinite(at.reach[k]))
        return at.reach[k] < rules->reach ? at.reach[k] : rules->reach;
    if (!at.ends[k])
        return rules->reach;
    const double sigmas = isfinite(at.paper[k]) ? rules->paper_sigmas : rules->end_sigmas;
    const double far = at.gaps[k] - sigmas * blur, least = rules->least_reach * at.gaps[k];
    const double left = (far > least ? far : least) / across;
    return left < rules->reach ? left : rules->reach;
}

/* Gather the pixels inside the cell, the radius and the image (reference.edges.collect): of every row one or two stretches
 * near the two lines. */
FOR_EACH_PROCESSOR
static void collect(
    window_t *window, const picture_t image, const double pixel[2], const geometry_t at, double blur, const edge_rules_t *rules)
{
    const double *a = at.sides, *b = at.sides + 2;
    double area = a[0] * b[1] - a[1] * b[0];
    area = fabs(area) > 1.0 ? area : 1.0;
    window->count = 0;
    window->size = 2.0;
    if (!isfinite(a[0] + a[1] + b[0] + b[1] + pixel[0] + pixel[1]))
        return;
    window->centre_u = rint(pixel[0]);
    window->centre_v = rint(pixel[1]);
    const double off_u = pixel[0] - window->centre_u, off_v = pixel[1] - window->centre_v;
    const double across_u = fabs(a[0]) + fabs(b[0]), across_v = fabs(a[1]) + fabs(b[1]);
    double radius = rules->reach * (across_u > across_v ? across_u : across_v);
    radius = radius < rules->radius_px ? radius : rules->radius_px;
    window->size = radius > 2.0 ? radius : 2.0;
    const double near = (rules->near_sigmas * blur + rules->near_px) / fabs(area);
    const double far1 = near * hypot(b[0], b[1]), far2 = near * hypot(a[0], a[1]);
    const double tallest = rules->reach * across_v + 1.0;
    const int64_t most = (int64_t)floor(tallest < rules->radius_px ? tallest : rules->radius_px);
    const range_t columns = {-window->centre_u, (double)image.width - 1.0 - window->centre_u};
    const double high = fabs(area) / hypot(a[0], a[1]), wide = fabs(area) / hypot(b[0], b[1]);
    const double left = reach_to(at, 3, blur, wide, rules), right = reach_to(at, 2, blur, wide, rules);
    const double above = reach_to(at, 0, blur, high, rules), below = reach_to(at, 1, blur, high, rules);
    const double columns_a = area / b[1], columns_b = -area / a[1], per_area = 1.0 / area;
    const double square = rules->radius_px * rules->radius_px, rest = (double)image.height - 1.0 - window->centre_v;
    const int64_t top = -window->centre_v > -(double)most ? -(int64_t)window->centre_v : -most;
    const int64_t bottom = rest < (double)most ? (int64_t)rest : most;
    for (int64_t start = top; start <= bottom; start += BLOCK) {
        /* Where the one or two stretches of each row lie: without branches, many rows at once. */
        const int32_t rows = bottom - start < BLOCK ? (int32_t)(bottom - start) + 1 : BLOCK;
        int32_t first[2][BLOCK], count[2][BLOCK];
        for (int32_t k = 0; k < rows; k++) {
            const double v = (double)((int32_t)start + k), half = sqrt(square - v * v);
            /* Position in cells along side a and along side b, in the column of the centre; it grows by one in so many
             * columns. */
            const double cells_a = (-b[0] * (v - off_v) - b[1] * off_u) * per_area;
            const double cells_b = (a[0] * (v - off_v) + a[1] * off_u) * per_area;
            range_t whole = both(between(columns_a, cells_a, -left, right), between(columns_b, cells_b, -above, below));
            whole = both(both(whole, columns), (range_t){-half, half});
            const range_t near_a = both(whole, band(columns_a, cells_a, far1));
            const range_t near_b = both(whole, band(columns_b, cells_b, far2));
            const int a_first = near_a.lo <= near_b.lo || !(near_b.lo <= near_b.hi), some_a = near_a.lo <= near_a.hi;
            const int swap = !some_a || !a_first;
            const double lo1 = ceil(swap ? near_b.lo : near_a.lo), hi1 = floor(swap ? near_b.hi : near_a.hi);
            const double lo2 = ceil(swap ? near_a.lo : near_b.lo), hi2 = floor(swap ? near_a.hi : near_b.hi);
            const int one = lo1 <= hi1, two = lo2 <= hi2, joined = one & two & (hi1 + 1.0 >= lo2);
            const double end = joined ? (hi1 > hi2 ? hi1 : hi2) : hi1;
            first[0][k] = one ? (int32_t)lo1 : 0;
            count[0][k] = one ? (int32_t)(end - lo1) + 1 : 0;
            first[1][k] = two ? (int32_t)lo2 : 0;
            count[1][k] = (two & !joined) ? (int32_t)(hi2 - lo2) + 1 : 0;
        }
        for (int32_t k = 0; k < rows; k++)
            for (int part = 0; part < 2; part++)
                if (count[part][k])
                    take(window, image, start + k, first[part][k], count[part][k]);
    }
}

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

/* The rows of the block of pixels that begins with `start`. */
INLINE float (*rows_of(const window_t *window, int64_t start))[BLOCK]
{
    return (float(*)[BLOCK])(window->rows + start * ROWS);
}

/* reference.edges._mixed. */
INLINE float mixed(const edge_t *one, const edge_t *two, float rho, int i)
{
    return -(one->value[i] * two->value[i]
             + rho * (one->slope[i] * two->slope[i]
                      + rho * (0.5f * one->bow[i] * two->bow[i] + (1.0f / 6.0f) * rho * one->curl[i] * two->curl[i])));
}

/* Set the window's rows to the first `parameters` of reference.edges.linearise and the last, the residuals, and `products`
 * (rows of ROWS, lower half) to those of these rows over all pixels. */
INLINE void multiply_rows(
    const int parameters, const int papered, const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules,
    double *products)
{
    const float x = (float)values[X], y = (float)values[Y], blur = (float)values[S];
    const float base = (float)values[A], half = (float)values[B], per_size = (float)(1.0 / window->size);
    const float light_u = (float)values[GX] * per_size, light_v = (float)values[GY] * per_size;
    const float rho = (float)cos(values[T1] - values[T2]);
    const line_t line1 = line_of(values[T1], values[K1], at.gaps, at.tilts, at.paper, values[S], rules);
    const line_t line2 = line_of(values[T2], values[K2], at.gaps + 2, at.tilts + 2, at.paper + 2, values[S], rules);
    const float half_rho = 0.5f * rho, single1 = (float)at.single[0], single2 = (float)at.single[1];
    lanes_t sums[ROWS * (ROWS + 1) / 2];
    memset(sums, 0, sizeof sums);
    for (int64_t start = 0; start < window->count; start += BLOCK) {
        const float *restrict u = window->u + start, *restrict v = window->v + start;
        const float *restrict value = window->value + start;
        /* Where they are not asked for afterwards, in one place, which stays in the cache. */
        float(*restrict rows)[BLOCK] = rows_of(window, rules->mirrored ? start : 0);
        edge_t one, two;
        along_line(line1, u, v, x, y, &one);
        along_line(line2, u, v, x, y, &two);
        beyond_t past1, past2;
        if (papered) {
            beyond_line(line1, &one, &past1);
            beyond_line(line2, &two, &past2);
        }
        for (int i = 0; i < BLOCK; i++) {
            float pattern = mixed(&one, &two, rho, i);
            if (papered)
                pattern += past1.paper[i] * (1.0f - 0.5f * past2.seen[i]) + past2.paper[i] * (1.0f - 0.5f * past1.seen[i]);
            if (papered)
                pattern -= single2 * one.value[i] + single1 * two.value[i];
            const float plain = base + half * pattern;
            const float light = 1.0f + light_u * u[i] + light_v * v[i];
            const float scale = -light * half / blur;
            float by_d1 = scale * (one.slope[i] * two.value[i]
                                   + rho * (one.bow[i] * two.slope[i] + half_rho * one.curl[i] * two.bow[i]));
            float by_d2 = scale * (two.slope[i] * one.value[i]
                                   + rho * (two.bow[i] * one.slope[i] + half_rho * two.curl[i] * one.bow[i]));
            float grown = one.grown[i] * two.value[i] + two.grown[i] * one.value[i];
            if (papered) {
                by_d1 += scale * single2 * one.slope[i];
                by_d2 += scale * single1 * two.slope[i];
                grown += single2 * one.grown[i] + single1 * two.grown[i];
                const float rest1 = 1.0f - 0.5f * past1.seen[i], rest2 = 1.0f - 0.5f * past2.seen[i];
                const float half1 = 0.5f * past1.paper[i], half2 = 0.5f * past2.paper[i];
                by_d1 -= scale * (past1.slope[i] * rest2 - half2 * past1.seen_slope[i]);
                by_d2 -= scale * (past2.slope[i] * rest1 - half1 * past2.seen_slope[i]);
                grown -= past1.grown[i] * rest2 - half2 * past1.seen_grown[i];
                grown -= past2.grown[i] * rest1 - half1 * past2.seen_grown[i];
            }
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
        const int64_t used = window->count - start;
        for (int row = 0; row <= parameters && used < BLOCK; row++)
            memset(rows[row] + used, 0, (size_t)(BLOCK - used) * sizeof(float));
        lanes_t *sum = sums;
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
    for (int i = 0, k = 0; i <= parameters; i++)
        for (int j = 0; j <= i; j++, k++) {
            double total = 0.0;
            for (int lane = 0; lane < LANES; lane++)
                total += (double)sums[k][lane];
            products[i * ROWS + j] = total;
        }
}

FOR_EACH_PROCESSOR
static void normal_equations(
    const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products)
{
    multiply_rows(FEWER, 0, values, window, at, rules, products);
}

FOR_EACH_PROCESSOR
static void all_normal_equations(
    const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products)
{
    multiply_rows(PARAMETERS, 0, values, window, at, rules, products);
}

/* Beside paper of known brightness, and at corners of single squares. */
FOR_EACH_PROCESSOR
static void papered_equations(
    const int n, const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules,
    double *products)
{
    multiply_rows(n == FEWER ? FEWER : PARAMETERS, 1, values, window, at, rules, products);
}

/* Set a and b by linear least squares with everything else as it stands (reference.edges._brightness); every second block says
 * enough. */
FOR_EACH_PROCESSOR
static void brightness(double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double sign)
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

/* Start from the contrast 2 b and a mean brightness: the first step finds the latter, in which the model is linear. */
static void level(double *values, const window_t *window, double half)
{
    lanes_t sums = {0.0f};
    const int64_t whole = window->count / LANES * LANES;
    for (int64_t i = 0; i < whole; i += LANES)
        sums += *(const lanes_t *)(window->value + i);
    double sum = 0.0;
    for (int lane = 0; lane < LANES; lane++)
        sum += (double)sums[lane];
    for (int64_t i = whole; i < window->count; i++)
        sum += (double)window->value[i];
    values[A] = sum / (double)(window->count > 0 ? window->count : 1);
    values[B] = half;
}

/* Factor the lower half of `matrix` (n rows of ROWS) in place, Cholesky, with one over the diagonal on the diagonal;
 * return whether it is positive definite. */
static int factor(double *matrix, int n)
{
    for (int j = 0; j < n; j++) {
        double *row = matrix + j * ROWS, rest = row[j];
        for (int k = 0; k < j; k++)
            rest -= row[k] * row[k];
        if (!(rest > 0.0))
            return 0;
        row[j] = 1.0 / sqrt(rest);
        for (int i = j + 1; i < n; i++) {
            double *below = matrix + i * ROWS, sum = below[j];
            for (int k = 0; k < j; k++)
                sum -= below[k] * row[k];
            below[j] = sum * row[j];
        }
    }
    return 1;
}

static void forward(const double *lower, double *right, int n)
{
    for (int i = 0; i < n; i++) {
        double sum = right[i];
        for (int k = 0; k < i; k++)
            sum -= lower[i * ROWS + k] * right[k];
        right[i] = sum * lower[i * ROWS + i];
    }
}

static void backward(const double *lower, double *right, int n)
{
    for (int i = n - 1; i >= 0; i--) {
        double sum = right[i];
        for (int k = i + 1; k < n; k++)
            sum -= lower[k * ROWS + i] * right[k];
        right[i] = sum * lower[i * ROWS + i];
    }
}

/* Return element (k, k) of the inverse of what `lower` is the factor of. */
static double inverse_at(const double *lower, int k, int n)
{
    double unit[PARAMETERS] = {0.0}, total = 0.0;
    unit[k] = 1.0;
    forward(lower, unit, n);
    for (int i = k; i < n; i++)
        total += unit[i] * unit[i];
    return total;
}

static double clipped(double value, double low, double high)
{
    return value < low ? low : value > high ? high : value;
}

/* Move `values` by `step`, cut where it would leave the region in which the model is nearly linear (reference.edges._limited). */
static void move(double *values, const double *step, int n, const edge_rules_t *rules)
{
    const double limits[PARAMETERS] = {
        rules->most_move_px, rules->most_move_px, rules->most_turn, rules->most_turn, rules->most_blur_change * values[S],
        INFINITY, INFINITY, rules->most_light_change, rules->most_light_change, INFINITY, INFINITY};
    for (int k = 0; k < n; k++)
        values[k] += clipped(step[k], -limits[k], limits[k]);
    values[S] = clipped(values[S], rules->least_blur, rules->most_blur);
}

/* Set the residuals, the last of the window's rows, to what they are after the last `step` of `parameters`, small enough
 * for them to be linear; return the sum of their squares. */
FOR_EACH_PROCESSOR
static double leave(window_t *window, const double *step, int parameters)
{
    lanes_t sums = {0.0f};
    for (int64_t start = 0; start < window->count; start += BLOCK) {
        float(*restrict rows)[BLOCK] = rows_of(window, start);
        lanes_t *rest = (lanes_t *)rows[parameters];
        for (int k = 0; k < parameters; k++) {
            const lanes_t *row = (const lanes_t *)rows[k];
            const float by = (float)step[k];
            for (int group = 0; group < GROUPS; group++)
                rest[group] -= by * row[group];
        }
        for (int group = 0; group < GROUPS; group++)
            sums += rest[group] * rest[group];
    }
    double sum = 0.0;
    for (int lane = 0; lane < LANES; lane++)
        sum += (double)sums[lane];
    return sum;
}

/* Return the mean square of what the model leaves and mirroring at the corner changes, as that of independent noise, or
 * -1 where few pixels have a mirror image (reference.edges._noise). */
FOR_EACH_PROCESSOR
static double unmirrored(const double *values, window_t *window, int parameters, const edge_rules_t *rules)
{
    if (fabs(values[X]) > rules->most_mirrored || fabs(values[Y]) > rules->most_mirrored)
        return -1.0;
    /* What is left as a picture, and turned by half a turn: then mirror images are read in the order of the pixels. */
    const int32_t across = (int32_t)window->across, middle = across / 2, radius = (int32_t)window->radius;
    float *square = window->square + middle * across + middle, *turned = window->turned + middle * across + middle;
    float *changes = window->change + middle * across + middle, *shown = window->paired + middle * across + middle;
    memset(window->square, 0xff, (size_t)(across * across) * sizeof(float)); /* NaN */
    memset(window->turned, 0xff, (size_t)(across * across) * sizeof(float));
    for (int64_t start = 0; start < window->count; start += BLOCK) {
        const int64_t used = window->count - start < BLOCK ? window->count - start : BLOCK;
        const float *u = window->u + start, *v = window->v + start, *rest = rows_of(window, start)[parameters];
        for (int64_t i = 0; i < used; i++) {
            const int32_t at = (int32_t)v[i] * across + (int32_t)u[i];
            square[at] = turned[-at] = rest[i];
        }
    }
    const double left = floor(2.0 * values[X]), top = floor(2.0 * values[Y]);
    const float right = (float)(2.0 * values[X] - left), below = (float)(2.0 * values[Y] - top);
    const float w00 = (1.0f - right) * (1.0f - below), w10 = right * (1.0f - below);
    const float w01 = (1.0f - right) * below, w11 = right * below;
    const lanes_t one = (lanes_t){0.0f} + 1.0f;
    lanes_t sums = {0.0f};
    mask_t pairs = {0};
    for (int32_t v = (int32_t)window->v[0]; v <= (int32_t)window->v[window->count - 1]; v++) {
        const float *restrict here = square + v * across - radius;
        const float *restrict there = turned + (v - (int32_t)top) * across - (int32_t)left - radius;
        const float *restrict above = there - across;
        /* Beyond the radius there is nothing. */
        for (int32_t u = 0; u <= 2 * radius; u += LANES) {
            const lanes_t near = w00 * *(const lanes_t *)(there + u) + w10 * *(const lanes_t *)(there + u - 1);
            const lanes_t far = w01 * *(const lanes_t *)(above + u) + w11 * *(const lanes_t *)(above + u - 1);
            const lanes_t change = *(const lanes_t *)(here + u) - (near + far);
            const mask_t paired = change == change;
            const lanes_t part = (lanes_t)((mask_t)change & paired);
            *(lanes_t *)(changes + v * across - radius + u) = part;
            *(lanes_t *)(shown + v * across - radius + u) = (lanes_t)((mask_t)one & paired);
            sums += part * part;
            pairs -= paired;
        }
    }
    double sum = 0.0;
    int64_t count = 0;
    for (int lane = 0; lane < LANES; lane++) {
        sum += (double)sums[lane];
        count += pairs[lane];
    }
    const double spread = 1.0 + (double)(w00 * w00 + w10 * w10 + w01 * w01 + w11 * w11);
    return count >= rules->fewest_mirrored ? sum / (double)count / spread : -1.0;
}

/* Set `out` to the sums of the products of what mirroring changes at two pixels that are one of LAGS apart, and behind them
 * to the numbers of such pairs, in the half of the window above `y`: the other half mirrors it (reference.edges._lag_products). */
FOR_EACH_PROCESSOR
static void lag_products(const window_t *window, double y, double *out)
{
    const int32_t across = (int32_t)window->across, middle = across / 2, radius = (int32_t)window->radius;
    const float *changes = window->change + middle * across + middle - radius;
    const float *shown = window->paired + middle * across + middle - radius;
    const int32_t first = (int32_t)window->v[0], last = (int32_t)floor(y);
    for (int32_t up = 0; up <= LAG; up++) {
        lanes_t s0 = {0.0f}, s1 = s0, s2 = s0, s3 = s0, s4 = s0, n0 = s0, n1 = s0, n2 = s0, n3 = s0, n4 = s0;
        for (int32_t v = first + up; v <= last; v++) {
            const float *here = changes + v * across, *seen = shown + v * across;
            const float *above = here - up * across, *beyond = seen - up * across;
            for (int32_t u = 0; u <= 2 * radius; u += LANES) {
                const lanes_t change = *(const lanes_t *)(here + u), paired = *(const lanes_t *)(seen + u);
                s0 += change * *(const lanes_t *)(above + u - 2);
                s1 += change * *(const lanes_t *)(above + u - 1);
                s2 += change * *(const lanes_t *)(above + u);
                s3 += change * *(const lanes_t *)(above + u + 1);
                s4 += change * *(const lanes_t *)(above + u + 2);
                n0 += paired * *(const lanes_t *)(beyond + u - 2);
                n1 += paired * *(const lanes_t *)(beyond + u - 1);
                n2 += paired * *(const lanes_t *)(beyond + u);
                n3 += paired * *(const lanes_t *)(beyond + u + 1);
                n4 += paired * *(const lanes_t *)(beyond + u + 2);
            }
        }
        const lanes_t sums[ACROSS_LAGS] = {s0, s1, s2, s3, s4}, pairs[ACROSS_LAGS] = {n0, n1, n2, n3, n4};
        /* In the row itself, lags to the left are those to the right. */
        for (int k = up ? 0 : LAG; k < ACROSS_LAGS; k++, out++) {
            out[0] = out[LAGS] = 0.0;
            for (int lane = 0; lane < LANES; lane++) {
                out[0] += (double)sums[k][lane];
                out[LAGS] += (double)pairs[k][lane];
            }
        }
    }
}

/* Return whether there are pixels on all sides of (x, y) (reference.edges._surrounded). */
FOR_EACH_PROCESSOR
static int surrounded(const window_t *window, float x, float y)
{
    int32_t right = 0, left = 0, below = 0, above = 0;
    for (int64_t i = 0; i < window->count; i++) {
        right += window->u[i] - x > 0.5f;
        left += x - window->u[i] > 0.5f;
        below += window->v[i] - y > 0.5f;
        above += y - window->v[i] > 0.5f;
    }
    return right >= 2 && left >= 2 && below >= 2 && above >= 2;
}

/* Fit one corner, of a `contrast` that may be unknown (NaN); `out` is u, v, sigma, s, 2 b, RMS residual, RMS noise, valid,
 * pixels, sums and numbers of `lag_products`, none where the noise is not known or is that of rounding. */
static void fit_corner(
    window_t *window, const double pixel[2], const geometry_t at, double sign, double blur, double contrast,
    const edge_rules_t *rules, double *out)
{
    const double turn = 1.0 / (rules->angle_sigma * rules->angle_sigma);
    const double width = 1.0 / (rules->log_blur_sigma * rules->log_blur_sigma * blur * blur);
    const double light = 1.0 / (rules->light_sigma * rules->light_sigma * window->size * window->size);
    const double bend1 = at.curvature_sigma[0], bend2 = at.curvature_sigma[1];
    const int n = bend1 > 0.0 && bend2 > 0.0 ? PARAMETERS : FEWER;
    const double prior[PARAMETERS] = {
        0.0, 0.0, turn, turn, width, 0.0, 0.0, light, light, 1.0 / (bend1 * bend1), 1.0 / (bend2 * bend2)};
    const double mean[PARAMETERS] = {
        0.0, 0.0, atan2(at.sides[1], at.sides[0]), atan2(at.sides[3], at.sides[2]), blur, 0.0, 0.0, 0.0, 0.0,
        at.curvature[0], at.curvature[1]};
    double values[PARAMETERS], products[ROWS * ROWS], variance = INFINITY;
    memcpy(values, mean, sizeof values);
    values[X] = pixel[0] - window->centre_u;
    values[Y] = pixel[1] - window->centre_v;
    if (isfinite(contrast))
        level(values, window, 0.5 * contrast * sign);
    else
        brightness(values, window, at, rules, sign);
    const int64_t more = window->count - FEWER;
    double last[PARAMETERS] = {0.0};
    int solved = 0, papered = at.single[0] != 0.0;
    for (int k = 0; k < 4; k++)
        papered |= isfinite(at.paper[k]) != 0;
    for (int64_t turns = 0; turns < rules->iterations; turns++) {
        if (papered)
            papered_equations(n, values, window, at, rules, products);
        else
            (n == FEWER ? normal_equations : all_normal_equations)(values, window, at, rules, products);
        variance = products[n * ROWS + n] / (double)(more > 1 ? more : 1);
        variance = variance > rules->least_variance ? variance : rules->least_variance;
        double step[PARAMETERS];
        for (int k = 0; k < n; k++) {
            products[k * ROWS + k] += prior[k] * variance + rules->ridge;
            step[k] = products[n * ROWS + k] + prior[k] * variance * (mean[k] - values[k]);
        }
        solved = factor(products, n);
        if (!solved)
            break;
        forward(products, step, n);
        backward(products, step, n);
        for (int k = 0; k < n; k++)
            last[k] = -values[k];
        move(values, step, n, rules);
        for (int k = 0; k < n; k++)
            last[k] += values[k];
        if (fabs(step[X]) <= rules->converged_px && fabs(step[Y]) <= rules->converged_px
            && fabs(step[S]) <= rules->blur_lag * rules->converged_px * values[S])
            break;
    }
    double noise = variance;
    memset(out + OUTCOMES - 2 * LAGS, 0, 2 * LAGS * sizeof(double));
    if (rules->mirrored && more > 0) {
        variance = leave(window, last, n) / (double)more;
        variance = variance > rules->least_variance ? variance : rules->least_variance;
        const double mean = unmirrored(values, window, n, rules);
        noise = mean < 0.0 ? variance : mean * (double)window->count / (double)more;
        if (mean >= 0.0 && noise > rules->least_variance)
            lag_products(window, values[Y], out + OUTCOMES - 2 * LAGS);
        noise = noise > rules->least_variance ? noise : rules->least_variance;
    }
    const double spread = solved ? 0.5 * noise * (inverse_at(products, X, n) + inverse_at(products, Y, n)) : NAN;
    const double u = window->centre_u + values[X], v = window->centre_v + values[Y];
    const double side1 = hypot(at.sides[0], at.sides[1]), side2 = hypot(at.sides[2], at.sides[3]);
    double most = rules->valid_move_cells * (side1 > side2 ? side1 : side2);
    most = most > rules->valid_move_px ? most : rules->valid_move_px;
    const int valid = hypot(u - pixel[0], v - pixel[1]) < most && spread > 0.0 && isfinite(spread) && more > 0
        && surrounded(window, (float)values[X], (float)values[Y]);
    out[0] = u;
    out[1] = v;
    out[2] = valid ? sqrt(spread) : 0.0;
    out[3] = values[S];
    out[4] = 2.0 * values[B] * sign;
    out[5] = sqrt(variance);
    out[6] = sqrt(noise);
    out[7] = (double)valid;
    out[8] = (double)window->count;
}

/* Side of the square that holds the window and, around it, nothing where mirror images may fall. */
static int64_t across_square(const edge_rules_t *rules)
{
    return 2 * ((int64_t)floor(rules->radius_px) + (int64_t)ceil(2.0 * rules->most_mirrored) + LANES) + 1;
}

static int64_t room_of_window(double radius_px)
{
    const int64_t side = 2 * (int64_t)floor(radius_px) + 1;
    return (side * side / BLOCK + 2) * BLOCK;
}

/* Return how many floats of scratch fit_edges needs. */
int64_t edges_scratch(const edge_rules_t *rules)
{
    const int64_t across = across_square(rules);
    return (3 + ROWS) * room_of_window(rules->radius_px) + 4 * across * across + CACHE_LINE / (int64_t)sizeof(float);
}

/* Fit the edge model around `count` corners (reference.edges.fit_corners). pixels (N, 2), sides (N, 2, 2), curvature and its sigma
 * and single (N, 2), gaps, tilts, reach, paper and ends (N, 2, 2), sign, blur and contrast (N), out (N, OUTCOMES); scratch as `edges_scratch`
 * says, zeroed; `grey` is of uint8_t if `bytes`, else of float. */
void fit_edges(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *pixels, const double *sides,
    const double *curvature, const double *curvature_sigma, const double *gaps, const double *tilts, const double *reach, const double *paper, const double *single,
    const double *sign, const double *blur, const double *contrast, const uint8_t *ends, const edge_rules_t *rules,
    float *scratch, double *out)
{
    const picture_t image = {grey, width, height, bytes};
    const int64_t room = room_of_window(rules->radius_px), across = across_square(rules);
    /* Vectors that lie across two lines of the cache take twice the time. */
    scratch += (CACHE_LINE - (uintptr_t)scratch % CACHE_LINE) % CACHE_LINE / sizeof(float);
    float *pictures = scratch + (3 + ROWS) * room;
    window_t window = {
        .u = scratch, .v = scratch + room, .value = scratch + 2 * room, .rows = scratch + 3 * room,
        .square = pictures, .turned = pictures + across * across, .change = pictures + 2 * across * across,
        .paired = pictures + 3 * across * across, .across = across,
        .radius = (int64_t)floor(rules->radius_px)};
    for (int64_t n = 0; n < count; n++) {
        const geometry_t at = {
            sides + 4 * n, curvature + 2 * n, curvature_sigma + 2 * n, gaps + 4 * n, tilts + 4 * n, reach + 4 * n, paper + 4 * n, single + 2 * n,
            ends + 4 * n};
        collect(&window, image, pixels + 2 * n, at, blur[n], rules);
        fit_corner(&window, pixels + 2 * n, at, sign[n], blur[n], contrast[n], rules, out + OUTCOMES * n);
    }
}

enum { TERMS = 6 };

/* The normal equations of a line's Taylor coefficients, in sides of the cell, without their prior: row i, column j of the
 * matrix is moment i + j. */
typedef struct {
    double moment[2 * TERMS - 1], right[TERMS][2];
} taylor_t;

/* Set `out` to the most probable coefficients along both axes, if they are known beforehand to be of size `sigma`, and
 * return the standard deviation of the second. */
INLINE double most_probable(const taylor_t *line, const double sigma[TERMS], double free, double out[TERMS][2])
{
    /* Beside the two axes, a column of the inverse; one over the diagonal on the diagonal. */
    double lower[TERMS][TERMS], right[TERMS][3] = {{0.0}};
    right[2][2] = 1.0;
    for (int j = 0; j < TERMS; j++) {
        right[j][0] = line->right[j][0] * sigma[j];
        right[j][1] = line->right[j][1] * sigma[j];
        for (int i = j; i < TERMS; i++) {
            double sum = line->moment[i + j] * sigma[i] * sigma[j] + (i > j ? 0.0 : j < 2 ? free : 1.0);
            for (int k = 0; k < j; k++)
                sum -= lower[i][k] * lower[j][k];
            lower[i][j] = i == j ? 1.0 / sqrt(sum) : sum * lower[j][j];
        }
        for (int axis = 0; axis < 3; axis++) {
            for (int k = 0; k < j; k++)
                right[j][axis] -= lower[j][k] * right[k][axis];
            right[j][axis] *= lower[j][j];
        }
    }
    for (int j = TERMS - 1; j >= 0; j--)
        for (int axis = 0; axis < 3; axis++) {
            for (int k = j + 1; k < TERMS; k++)
                right[j][axis] -= lower[k][j] * right[k][axis];
            right[j][axis] *= lower[j][j];
        }
    for (int j = 0; j < TERMS; j++)
        for (int axis = 0; axis < 2; axis++)
            out[j][axis] = right[j][axis] * sigma[j];
    return sqrt(right[2][2]) * sigma[2];
}

/* Set `out` to the curvature at place `at` of a line of `count` corners, `stride` cells apart, and its sigma. */
INLINE void line_bend(
    const double *pixels, const double *sigma, int64_t stride, int64_t at, int64_t count, double side,
    const bend_rules_t *rules, double *out, double *out_sigma)
{
    taylor_t line = {0};
    const double per_side = 1.0 / side;
    for (int64_t step = -rules->reach; step <= rules->reach; step++) {
        if (at + step < 0 || at + step >= count)
            continue;
        const double *other = pixels + 2 * step * stride;
        double wide = sigma[step * stride];
        if (!isfinite(wide) || !isfinite(other[0]))
            continue;
        wide = per_side * (wide > rules->least_sigma ? wide : rules->least_sigma);
        const double u = (other[0] - pixels[0]) * per_side, v = (other[1] - pixels[1]) * per_side;
        double moment = 1.0 / (wide * wide);
        for (int k = 0; k < 2 * TERMS - 1; k++) {
            line.moment[k] += moment;
            if (k < TERMS) {
                line.right[k][0] += moment * u;
                line.right[k][1] += moment * v;
            }
            moment *= (double)step;
        }
    }
    double expected[TERMS] = {1.0}, found[TERMS][2];
    for (int k = 1; k < TERMS; k++)
        expected[k] = expected[k - 1] * rules->decay;
    double wide = most_probable(&line, expected, rules->free, found);
    const double second = 2.0 * hypot(found[2][0], found[2][1]), third = sqrt(2.0 * hypot(found[3][0], found[3][1]));
    const double turn = second > third ? second : third;
    if (turn > rules->bent) {
        double size = 0.5;
        for (int k = 2; k < TERMS; k++) {
            size *= turn;
            expected[k] = expected[k] > size ? expected[k] : size;
        }
        wide = most_probable(&line, expected, rules->free, found);
    }
    const double cross = 2.0 * (found[1][0] * found[2][1] - found[1][1] * found[2][0]);
    double square = found[1][0] * found[1][0] + found[1][1] * found[1][1];
    square = square > 1e-12 ? square : 1e-12;
    *out = cross / (square * sqrt(square) * side);
    *out_sigma = 2.0 * wide / (square * side);
}

/* Set `out` (M, 2) to the curvature of row and column at the M wanted cells and `out_sigma` to its standard deviation
 * (reference.edges.line_bends). */
FOR_EACH_PROCESSOR
void line_bends(
    const double *pixels, const double *sigma, const uint8_t *wanted, int64_t rows, int64_t columns, int64_t count,
    const double *sides, const bend_rules_t *rules, double *out, double *out_sigma)
{
    (void)count;
    for (int64_t row = 0; row < rows; row++)
        for (int64_t column = 0; column < columns; column++) {
            const int64_t cell = row * columns + column;
            if (!wanted[cell])
                continue;
            line_bend(pixels + 2 * cell, sigma + cell, 1, column, columns, *sides++, rules, out++, out_sigma++);
            line_bend(pixels + 2 * cell, sigma + cell, columns, row, rows, *sides++, rules, out++, out_sigma++);
        }
}
