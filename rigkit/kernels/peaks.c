/* The saddle response of an image and its peaks. The definitions in numpy are in tests/kernels/reference/front.py,
 * the numbers in rigkit.detection.saddles. */
#include "front.h"

/* Number of bins, and of their bits, of the histogram by which values are ranked. */
enum { RANK_BITS = 11, RANKS = 1 << RANK_BITS };

/* Return the saddle response at a pixel, minus the determinant of the Hessian, from its row and the rows above and below. */
INLINE float saddle_between(const float *above, const float *row, const float *below)
{
    const float here = 2.0f * row[0];
    const float uu = row[1] + row[-1] - here, vv = below[0] + above[0] - here;
    const float uv = 0.25f * ((below[1] + above[-1]) - (above[1] + below[-1]));
    return uv * uv - uu * vv;
}

INLINE float saddle_response(const float *at, int64_t width)
{
    return saddle_between(at - width, at, at + width);
}

/* The bins of a histogram in increasing order: the highest bits of values that span orders of magnitude and are not negative, or
 * equal intervals from `low` on, with `per_bin` the reciprocal of their width. */
typedef struct {
    float low, per_bin;
    int by_bits;
} bins_t;

INLINE int32_t bin_of(float value, const bins_t bins)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    const float place = (value - bins.low) * bins.per_bin;
    if (bins.by_bits)
        return (int32_t)(bits >> (32 - RANK_BITS - 1)) & (RANKS - 1);
    return place < (float)(RANKS - 1) ? (int32_t)place : RANKS - 1;
}

/* Set `often` to the histogram of the values. */
INLINE void count_bins(const float *values, int64_t count, const bins_t bins, int32_t often[RANKS])
{
    memset(often, 0, RANKS * sizeof(int32_t));
    for (int64_t k = 0; k < count; k++)
        often[bin_of(values[k], bins)]++;
}

/* Return the value of rank `at`, from 0, of `count` values with the histogram `often`: the few values of its bin are gathered in
 * `room` (count) and ranked. */
INLINE float value_at_rank(
    const float *values, int64_t count, const bins_t bins, const int32_t often[RANKS], int64_t at, float *room)
{
    enum { BLOCK = 32 };
    int32_t bin = 0;
    for (; at >= often[bin] && bin < RANKS - 1; bin++)
        at -= often[bin];
    int64_t few = 0;
    for (int64_t first = 0; first < count; first += BLOCK) {
        /* Most blocks contain none of them, which is tested for the whole block. */
        const int64_t here = count - first < BLOCK ? count - first : BLOCK;
        int32_t any = here < BLOCK;
        for (int64_t k = 0; k < BLOCK && here == BLOCK; k++)
            any |= bin_of(values[first + k], bins) == bin;
        for (int64_t k = first; any && k < first + here; k++)
            if (bin_of(values[k], bins) == bin)
                room[few++] = values[k];
    }
    return ranked_float(room, few, at);
}

/* Set `out` to the upper median of |response|, and to the brightness of rank `few` from below and from above, over every `step`-th
 * inner pixel of every `step`-th inner row. `room` has room for one number for each of them. */
FOR_EACH_PROCESSOR void typical_values(
    const float *smooth, int64_t height, int64_t width, int64_t step, int64_t few, float *response, float *brightness, float *room,
    float *out)
{
    int64_t count = 0;
    float low = INFINITY, high = -INFINITY;
    for (int64_t v = 1; v < height - 1; v += step)
        for (int64_t u = 1; u < width - 1; u += step) {
            const float *at = smooth + v * width + u;
            response[count] = fabsf(saddle_response(at, width));
            brightness[count++] = *at;
            low = *at < low ? *at : low;
            high = *at > high ? *at : high;
        }
    const bins_t sizes = {0.0f, 0.0f, 1}, levels = {low, high > low ? (float)(RANKS - 1) / (high - low) : 0.0f, 0};
    int32_t often[RANKS];
    count_bins(response, count, sizes, often);
    out[0] = value_at_rank(response, count, sizes, often, count / 2, room);
    count_bins(brightness, count, levels, often);
    out[1] = value_at_rank(brightness, count, levels, often, few, room);
    out[2] = value_at_rank(brightness, count, levels, often, count - 1 - few, room);
}

/* Set the thresholds of all strips of all bands (reference.front.thresholds): `floor` times the squared relative brightness of the
 * brightest pixel, 0 at `darkest` and 1 at `brightest`, at least `least`. Every fourth pixel is read, which misses no square that
 * is large enough to be found. */
FOR_EACH_PROCESSOR void fill_thresholds(
    const float *smooth, int64_t height, int64_t width, float floor, float least, float darkest, float brightest, float *out)
{
    enum { APART = 4 };
    const int64_t strips = width / STRIP + 1, bands = height / STRIP_ROWS + 1;
    const float span = brightest > darkest ? brightest - darkest : 1.0f;
    for (int64_t band = 0; band < bands; band++)
        for (int64_t strip = 0; strip < strips; strip++) {
            const int64_t left = STRIPS_FROM + strip * STRIP, across = left + STRIP < width ? STRIP : width - left;
            const int64_t top = band * STRIP_ROWS, bottom = top + STRIP_ROWS < height ? top + STRIP_ROWS : height;
            float brightest_of[STRIP], most = darkest;
            for (int64_t k = 0; k < STRIP; k++)
                brightest_of[k] = darkest;
            for (int64_t v = top; v < bottom; v += APART) {
                const float *row = smooth + v * width + left;
                /* Written twice, so that the number of pixels is a constant and the loop is vectorised. */
                if (across == STRIP)
                    for (int64_t k = 0; k < STRIP; k++)
                        brightest_of[k] = row[k] > brightest_of[k] ? row[k] : brightest_of[k];
                else
                    for (int64_t k = 0; k < across; k++)
                        brightest_of[k] = row[k] > brightest_of[k] ? row[k] : brightest_of[k];
            }
            for (int64_t k = 0; k < across; k += APART)
                most = brightest_of[k] > most ? brightest_of[k] : most;
            const float part = most < brightest ? (most - darkest) / span : 1.0f, lower = floor * part * part;
            out[band * strips + strip] = lower > least ? lower : least;
        }
}

/* Peaks are searched in three rows at a time, a triple. A peak is the highest pixel of its column in the triple, and not lower than
 * the highest ones of the two columns on each side: few pixels remain to be compared with all neighbours within two pixels. */

#define LOWEST (-1e30f)

/* Return the larger value; `least` if `one` is NaN, as responses beyond the range of float32 are. */
INLINE float higher_of(float one, float least)
{
    return one > least ? one : least;
}

/* Return as bits, the lowest first, which of the columns u to u + STRIP - 1 may have a peak: their highest pixel, in `most`, is
 * above the threshold and not below those of the two columns on each side. */
INLINE uint64_t columns_among(const float *most, int64_t u, float threshold)
{
    uint8_t highest[STRIP];
    const float *here = most + u;
    for (int k = 0; k < STRIP; k++) {
        const float beside = higher_of(higher_of(here[k - 2], here[k - 1]), higher_of(here[k + 1], here[k + 2]));
        highest[k] = (uint8_t)((here[k] > threshold) & !(beside > here[k]));
    }
    uint64_t bits = 0;
    for (int k = 0; k < STRIP; k += 8) {
        uint64_t eight;
        memcpy(&eight, highest + k, 8);
        /* The product gathers the lowest bits of eight bytes (the first one the lowest) in the highest byte. */
        bits |= (eight * UINT64_C(0x0102040810204080)) >> 56 << k;
    }
    return bits;
}

/* Return whether pixel u of the middle row is higher than the previous neighbours within two pixels, and not lower than the
 * following ones: a corner halfway between two pixels makes them equal, and one of them is the peak. */
INLINE int is_peak(float *const rows[5], int64_t u)
{
    float before = higher_of(rows[2][u - 1], higher_of(rows[2][u - 2], LOWEST));
    float after = higher_of(rows[2][u + 1], higher_of(rows[2][u + 2], LOWEST));
    for (int k = -2; k <= 2; k++) {
        before = higher_of(rows[0][u + k], higher_of(rows[1][u + k], before));
        after = higher_of(rows[3][u + k], higher_of(rows[4][u + k], after));
    }
    return (rows[2][u] > before) & !(after > rows[2][u]);
}

/* The state of the search.
 * rows : ring buffer of the responses, row v at v % RING, `stride` apart.
 * most, high : for two triples in turn, the maximum of each column, and whether any pixel of a strip is above its threshold. */
typedef struct {
    const float *smooth, *thresholds;
    int64_t height, width, stride, strips;
    float *rows, *most;
    uint8_t *high;
} search_t;

INLINE float *responses_of(const search_t s, int64_t v)
{
    return s.rows + v % RING * s.stride;
}

INLINE float threshold_at(const search_t s, int64_t v, int64_t strip)
{
    return s.thresholds[v / STRIP_ROWS * s.strips + strip];
}

/* Return the lower threshold of the triple from row v on, which may extend over two bands. */
INLINE float lowest_threshold(const search_t s, int64_t v, int64_t strip)
{
    const float above = threshold_at(s, v, strip), below = threshold_at(s, v + TRIPLE - 1, strip);
    return above < below ? above : below;
}

/* Set the saddle response at `count` pixels of a row and of the two below, and the maximum of each column; return whether any is
 * above the threshold. */
INLINE uint8_t fill_strip(
    const float *restrict from, int64_t width, int64_t count, float threshold, float *restrict first, float *restrict second,
    float *restrict third, float *restrict most)
{
    /* A pointer to each row, so that the compiler keeps one register per row. */
    const float *above = from - width, *middle = from + width, *last = middle + width, *below = last + width;
    int32_t high = 0;
    for (int64_t k = 0; k < count; k++) {
        const float one = saddle_between(above + k, from + k, middle + k);
        const float two = saddle_between(from + k, middle + k, last + k);
        const float three = saddle_between(middle + k, last + k, below + k);
        const float highest = higher_of(three, higher_of(two, higher_of(one, LOWEST)));
        first[k] = one;
        second[k] = two;
        third[k] = three;
        most[k] = highest;
        high |= highest > threshold;
    }
    return (uint8_t)high;
}

/* The same for the first or last triple of the image, with rows that have no response. */
INLINE void fill_border(const search_t s, int64_t v)
{
    float *most = s.most + v / TRIPLE % 2 * s.stride;
    for (int64_t u = 1; u < s.width - 1; u++)
        most[u] = LOWEST;
    for (int64_t row = v; row < v + TRIPLE; row++) {
        float *to = responses_of(s, row);
        const int inside = row > 0 && row < s.height - 1;
        for (int64_t u = 1; u < s.width - 1; u++) {
            to[u] = inside ? saddle_response(s.smooth + row * s.width + u, s.width) : LOWEST;
            most[u] = higher_of(to[u], most[u]);
        }
    }
    memset(s.high + v / TRIPLE % 2 * s.strips, 1, (size_t)s.strips);
}

INLINE void fill_triple(const search_t s, int64_t v)
{
    const int64_t last = v + TRIPLE - 1;
    if (v == 0 || last >= s.height - 1) {
        fill_border(s, v);
        return;
    }
    float *one = responses_of(s, v), *two = responses_of(s, v + 1), *three = responses_of(s, last);
    float *most = s.most + v / TRIPLE % 2 * s.stride;
    uint8_t *high = s.high + v / TRIPLE % 2 * s.strips;
    const float *from = s.smooth + v * s.width;
    fill_strip(from + 1, s.width, STRIPS_FROM - 1, 0.0f, one + 1, two + 1, three + 1, most + 1);
    for (int64_t u = STRIPS_FROM, strip = 0; u < s.width - 1; u += STRIP, strip++) {
        const float least = lowest_threshold(s, v, strip);
        /* The last strip overlaps the previous one, so that the number of pixels is a constant. */
        const int64_t at = u + STRIP < s.width ? u : s.width - 1 - STRIP;
        high[strip] = at >= STRIPS_FROM
            ? fill_strip(from + at, s.width, STRIP, least, one + at, two + at, three + at, most + at)
            : fill_strip(from + u, s.width, s.width - 1 - u, least, one + u, two + u, three + u, most + u);
    }
}

/* Set `columns` (TRIPLE, width / 3 + 1) to the columns of the peaks in each row of the triple from v on, and `found` to their
 * numbers. */
INLINE void search_triple(const search_t s, int64_t v, int32_t *columns, int64_t found[TRIPLE])
{
    const float *most = s.most + v / TRIPLE % 2 * s.stride;
    const uint8_t *high = s.high + v / TRIPLE % 2 * s.strips;
    float *rows[TRIPLE + 4];
    for (int k = 0; k < TRIPLE + 4; k++)
        rows[k] = responses_of(s, v - 2 + k);
    for (int64_t u = STRIPS_FROM, strip = 0; u < s.width - 3; u += STRIP, strip++) {
        if (!high[strip])
            continue;
        for (uint64_t left = columns_among(most, u, lowest_threshold(s, v, strip)); left; left &= left - 1) {
            const int64_t at = u + __builtin_ctzll(left);
            if (at >= s.width - 3)
                break;
            /* The row of the column's maximum, the first of several; without branches, which are unpredictable here. */
            const int64_t above = rows[2][at] != most[at], row = above + (above & (rows[3][at] != most[at]));
            int32_t *next = columns + row * (s.width / 3 + 1) + found[row];
            *next = (int32_t)at;
            found[row] += (v + row < s.height - 3) & (most[at] > threshold_at(s, v + row, strip)) & is_peak(rows + row, at);
        }
    }
}

/* Set `at` and `response` to (u, v) and response of the peaks, row by row; return their number, at most one in 3 x 3 pixels
 * (reference.front.peaks). `scratch` holds RING + 2 rows of width + STRIP + 4 floats, `high` 2 * (width / STRIP + 1) bytes,
 * `columns` TRIPLE * (width / 3 + 1) numbers. */
FOR_EACH_PROCESSOR int64_t find_peaks(
    const float *smooth, int64_t height, int64_t width, const float *thresholds, float *scratch, uint8_t *high, int32_t *columns,
    int32_t *at, float *response)
{
    const int64_t stride = width + STRIP + 4;
    const search_t s = {smooth, thresholds, height, width, stride, width / STRIP + 1, scratch, scratch + RING * stride, high};
    for (int64_t k = 0; k < (RING + 2) * stride; k++)
        scratch[k] = LOWEST;
    int64_t count = 0;
    fill_triple(s, 0);
    fill_triple(s, TRIPLE);
    for (int64_t v = TRIPLE; v < height - 3; v += TRIPLE) {
        int64_t found[TRIPLE] = {0};
        fill_triple(s, v + TRIPLE);
        search_triple(s, v, columns, found);
        for (int64_t row = 0; row < TRIPLE; row++)
            for (int64_t k = 0; k < found[row]; k++, count++) {
                at[2 * count] = columns[row * (width / 3 + 1) + k];
                at[2 * count + 1] = (int32_t)(v + row);
                response[count] = responses_of(s, v + row)[at[2 * count]];
            }
    }
    return count;
}

/* Keep about the `most` strongest of `count` peaks, in place and in order, by their response relative to the strongest in their
 * square of `side` pixels (reference.front._strongest): the highest bins of a histogram of this ratio that hold so many. `squares`
 * ((height / side + 1) * (width / side + 1)) and `bins` (`finest` + 1), both zeroed, and `share` (count) are scratch. Return the
 * number of peaks kept. */
int64_t keep_strongest(
    int32_t *at, float *response, int64_t count, int64_t height, int64_t width, int64_t side, int64_t most, int64_t finest,
    float *squares, int32_t *bins, int32_t *share)
{
    (void)height;
    const int32_t across = (int32_t)(width / side) + 1, step = (int32_t)side;
    for (int32_t k = 0, row = -1, first = 0; k < (int32_t)count; k++) {
        if (at[2 * k + 1] != row) {
            row = at[2 * k + 1];
            first = row / step * across;
        }
        share[k] = first + at[2 * k] / step;
        float *strongest = squares + share[k];
        *strongest = response[k] > *strongest ? response[k] : *strongest;
    }
    for (int64_t k = 0; k < count; k++) {
        const float part = response[k] / squares[share[k]];
        /* Infinite responses, whose ratio is NaN, count as equally strong. */
        share[k] = part < 1.0f ? (int32_t)((float)finest * part) : (int32_t)finest;
        bins[share[k]]++;
    }
    int64_t least = finest, kept = bins[finest];
    while (least > 0 && kept < most)
        kept += bins[--least];
    kept = 0;
    for (int64_t k = 0; k < count; k++) {
        at[2 * kept] = at[2 * k];
        at[2 * kept + 1] = at[2 * k + 1];
        response[kept] = response[k];
        kept += share[k] >= least;
    }
    return kept;
}
