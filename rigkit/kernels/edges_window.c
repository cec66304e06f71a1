/* The window of a corner: the pixels of every row near the corner's two lines. */
#include "edges.h"

enum { STRETCH = 16 };

/* Vectors of STRETCH pixels, for the conversion from bytes to float. */
typedef uint8_t bytes_t __attribute__((vector_size(STRETCH)));
typedef uint16_t halves_t __attribute__((vector_size(2 * STRETCH)));
typedef int32_t words_t __attribute__((vector_size(4 * STRETCH)));
typedef float bright_t __attribute__((vector_size(4 * STRETCH), aligned(4)));

typedef struct {
    double lo, hi;
} range_t;

/* Return the range of x with low <= x / inverse + offset <= high; for an infinite inverse (a line along the row) all or none. */
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

/* Append `count` pixels of row `v` from column `first` on, both relative to the centre. */
INLINE void take(window_t *window, const picture_t image, int64_t v, int32_t first, int32_t count)
{
    const int64_t start = ((int64_t)window->centre_v + v) * image.width + (int64_t)window->centre_u + first;
    const uint8_t *restrict bytes = (const uint8_t *)image.brightness + start;
    const float *restrict floats = (const float *)image.brightness + start;
    float *restrict us = window->u + window->count, *restrict vs = window->v + window->count;
    float *restrict values = window->value + window->count;
    /* In steps of constant length: excess values are overwritten later or not used. */
    const bright_t steps = {0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f, 8.0f, 9.0f, 10.0f, 11.0f, 12.0f, 13.0f, 14.0f, 15.0f};
    for (int32_t k = 0; k < count; k += STRETCH) {
        *(bright_t *)(us + k) = steps + (float)(first + k);
        *(bright_t *)(vs + k) = (bright_t){0.0f} + (float)v;
    }
    if (!image.bytes)
        memcpy(values, floats, (size_t)count * sizeof(float));
    else if (start + count + STRETCH <= image.width * image.height)
        for (int32_t k = 0; k < count; k += STRETCH) {
            /* Each conversion doubles the width, as instructions do; otherwise GCC 12 converts pixel by pixel. */
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

/* Repeat the last pixel to the end of its block: whether a block is evaluated depends on all of its pixels (all_beyond), and would
 * otherwise depend on uninitialised memory. */
INLINE void fill_up(window_t *window)
{
    for (int64_t i = window->count; i % BLOCK != 0; i++) {
        window->u[i] = window->u[window->count - 1];
        window->v[i] = window->v[window->count - 1];
    }
}

/* Return the reach of the window towards the neighbouring line `k`, in sides of the cell, which is `across` px wide in that
 * direction (reference.edge_model._reach). */
INLINE double reach_to(const geometry_t at, int k, double blur, double across, const edge_rules_t *rules)
{
    if (isfinite(at.reach[k]))
        return at.reach[k] < rules->reach ? at.reach[k] : rules->reach;
    if (!at.ends[k])
        return rules->reach;
    const double sigmas = isfinite(at.paper[k]) ? rules->paper_sigmas : rules->end_sigmas;
    const double far = at.gaps[k] - sigmas * blur, least = rules->min_reach * at.gaps[k];
    const double left = (far > least ? far : least) / across;
    return left < rules->reach ? left : rules->reach;
}

/* Gather the pixels inside the cell, the radius and the image (reference.edge_model.collect): in every row one or two intervals
 * near the two lines. There are none for a pixel whose coordinates may exceed int64_t. */
FOR_EACH_PROCESSOR
void collect_window(
    window_t *window, const picture_t image, const double pixel[2], const geometry_t at, double blur, const edge_rules_t *rules)
{
    const double *a = at.sides, *b = at.sides + 2;
    const double crossed = a[0] * b[1] - a[1] * b[0], area = fabs(crossed) > 1.0 ? crossed : 1.0;
    window->count = 0;
    window->size = 2.0;
    window->centre_u = rint(pixel[0]);
    window->centre_v = rint(pixel[1]);
    if (!isfinite(a[0] + a[1] + b[0] + b[1]) || !(fabs(pixel[0]) + fabs(pixel[1]) < 1e9))
        return;
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
        /* The one or two intervals of each row, without branches, many rows at once. */
        const int32_t rows = bottom - start < BLOCK ? (int32_t)(bottom - start) + 1 : BLOCK;
        int32_t first[2][BLOCK], count[2][BLOCK];
        for (int32_t k = 0; k < rows; k++) {
            const double v = (double)((int32_t)start + k), half = sqrt(square - v * v);
            /* Position in cells along side a and along side b in the column of the centre; it grows by one every `columns_a`
             * and `columns_b` columns. */
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
        for (int32_t k = 0; k < rows; k++) {
            take(window, image, start + k, first[0][k], count[0][k]);
            take(window, image, start + k, first[1][k], count[1][k]);
        }
    }
    fill_up(window);
}

/* Return whether there are two or more pixels on each side of (x, y) (reference.edges._surrounded). */
FOR_EACH_PROCESSOR
int is_surrounded(const window_t *window, float x, float y)
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
