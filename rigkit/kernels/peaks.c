/* The saddle response of an image and its peaks. The definitions in numpy are in tests/kernels/reference/front.py,
 * the numbers in rigkit.detection.saddles. */
#include "front.h"

/* Numbers are counted in so many bins to rank them, those of so many bits. */
enum { RANK_BITS = 11, RANKS = 1 << RANK_BITS };

/* Minus the determinant of the Hessian at one pixel. */
INLINE float saddle_response(const float *at, int64_t width)
{
    const float here = 2.0f * at[0];
    const float uu = at[1] + at[-1] - here, vv = at[width] + at[-width] - here;
    const float uv = 0.25f * ((at[width + 1] + at[-width - 1]) - (at[-width + 1] + at[width - 1]));
    return uv * uv - uu * vv;
}

/* How values are counted, the smaller ones first: by their highest bits where they span magnitudes and are not negative, else
 * by where they lie between `low` and the highest one, `per_bin` apart. */
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

INLINE void count_bins(const float *values, int64_t count, const bins_t bins, int32_t often[RANKS])
{
    memset(often, 0, RANKS * sizeof(int32_t));
    for (int64_t k = 0; k < count; k++)
        often[bin_of(values[k], bins)]++;
}

/* Return what `at` of `count` values are smaller than or equal to, `often` being what `count_bins` says of them: those of its
 * bin, gathered in `room` (count), are few. */
INLINE float value_at_rank(
    const float *values, int64_t count, const bins_t bins, const int32_t often[RANKS], int64_t at, float *room)
{
    int32_t bin = 0;
    for (; at >= often[bin] && bin < RANKS - 1; bin++)
        at -= often[bin];
    int64_t few = 0;
    for (int64_t k = 0; k < count; k++)
        if (bin_of(values[k], bins) == bin)
            room[few++] = values[k];
    /* Hoare's FIND. */
    int64_t low = 0, high = few - 1;
    while (low < high) {
        const float pivot = room[at];
        int64_t i = low, j = high;
        while (i <= j) {
            while (room[i] < pivot)
                i++;
            while (pivot < room[j])
                j--;
            if (i <= j) {
                const float swap = room[i];
                room[i++] = room[j];
                room[j--] = swap;
            }
        }
        low = j < at ? i : low;
        high = at < i ? j : high;
    }
    return room[at];
}

/* Of every step-th inner pixel of every step-th inner row: set out to the upper median of |response|, and the brightness
 * that `few` of them are darker and brighter than. `room` has a place for each of them. */
FOR_EACH_PROCESSOR void typical_values(
    const float *smooth, int64_t height, int64_t width, int64_t step, int64_t few, float *response, float *brightness,
    float *room, float *out)
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

/* reference.front.thresholds: for each strip of each band `floor` times the square of how bright its brightest pixel is
 * between `darkest` and `brightest`, but not below `least`. Every fourth pixel is looked at: the edges of boards are wider
 * than the squares that could hide between them. */
FOR_EACH_PROCESSOR void fill_thresholds(
    const float *smooth, int64_t height, int64_t width, float floor, float least, float darkest, float brightest,
    float *out)
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
                /* Of all pixels, and twice, so that the compiler knows how many there are: it is done many at once. */
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

/* Return as bits, the lowest first, which of the pixels u to u + STRIP - 1 of a row may be peaks: above the threshold, and not
 * below any of the pixels beside, above and below (as `is_peak`). */
INLINE uint64_t peaks_among(float *const rows[5], int64_t u, float threshold)
{
    uint8_t peak[STRIP];
    const float *above = rows[1] + u, *here = rows[2] + u, *below = rows[3] + u;
    for (int k = 0; k < STRIP; k++) {
        /* What is no number, beside what float32 does not hold, is above nothing. */
        float most = here[k - 1] > threshold ? here[k - 1] : threshold;
        most = above[k] > most ? above[k] : most;
        peak[k] = (uint8_t)((here[k] > most) & !(here[k + 1] > here[k]) & !(below[k] > here[k]));
    }
    uint64_t bits = 0;
    for (int k = 0; k < STRIP; k += 8) {
        uint64_t eight;
        memcpy(&eight, peak + k, 8);
        /* The product gathers the lowest bits of eight bytes (the first one the lowest) in the highest byte. */
        bits |= (eight * UINT64_C(0x0102040810204080)) >> 56 << k;
    }
    return bits;
}

/* Return whether pixel u of the middle row, one of `peaks_among`, is not lower than the neighbours that follow within two
 * pixels, and higher than those before: a corner between pixels makes two equal ones. */
INLINE int is_peak(float *const rows[5], int64_t u)
{
    const float here = rows[2][u];
    if (rows[1][u - 1] >= here || rows[1][u + 1] >= here || rows[3][u - 1] > here || rows[3][u + 1] > here)
        return 0;
    int higher = (rows[2][u - 2] >= here) | (rows[2][u + 2] > here) | (rows[1][u - 2] >= here) | (rows[1][u + 2] >= here) |
                 (rows[3][u - 2] > here) | (rows[3][u + 2] > here);
    for (int k = -2; k <= 2; k++)
        higher |= (rows[0][u + k] >= here) | (rows[4][u + k] > here);
    return !higher;
}

/* The saddle response at the `count` pixels from u on of a row, into `to`; whether any is above the threshold. */
INLINE int32_t fill_response(const float *restrict from, int64_t width, int64_t count, float threshold, float *restrict to)
{
    int32_t high = 0;
    for (int64_t k = 0; k < count; k++) {
        const float response = saddle_response(from + k, width);
        to[k] = response;
        high |= response > threshold;
    }
    return high;
}

/* reference.front.peaks: (u, v) and response of the peaks, row by row; returns how many. There is at most one peak in
 * 3x3 pixels. `scratch` holds 5 * (width + STRIP + 4) floats, `high` 5 * (width / STRIP + 1) bytes. */
FOR_EACH_PROCESSOR int64_t find_peaks(
    const float *smooth, int64_t height, int64_t width, const float *thresholds, float *scratch, uint8_t *high, int32_t *at,
    float *response)
{
    const int64_t stride = width + STRIP + 4, strips = width / STRIP + 1;
    for (int64_t k = 0; k < 5 * stride; k++)
        scratch[k] = -1e30f;
    int64_t count = 0;
    for (int64_t v = 1; v < height - 1; v++) {
        const float *from = smooth + v * width;
        float *last = scratch + v % 5 * stride;
        uint8_t *mark = high + v % 5 * strips;
        const float *threshold = thresholds + v / STRIP_ROWS * strips;
        last[1] = saddle_response(from + 1, width);
        last[2] = saddle_response(from + 2, width);
        for (int64_t u = STRIPS_FROM; u < width - 1; u += STRIP, mark++, threshold++)
            /* Twice, so that the compiler knows how many there are. */
            *mark = (uint8_t)(u + STRIP < width ? fill_response(from + u, width, STRIP, *threshold, last + u)
                                                : fill_response(from + u, width, width - 1 - u, *threshold, last + u));
        /* The middle one of the five rows is v - 2. */
        if (v < 5)
            continue;
        float *rows[5];
        for (int k = 0; k < 5; k++)
            rows[k] = scratch + (v + 1 + k) % 5 * stride;
        mark = high + (v - 2) % 5 * strips;
        threshold = thresholds + (v - 2) / STRIP_ROWS * strips;
        for (int64_t u = STRIPS_FROM; u < width - 3; u += STRIP, mark++, threshold++) {
            if (!*mark)
                continue;
            for (uint64_t left = peaks_among(rows, u, *threshold); left; left &= left - 1) {
                const int64_t at_u = u + __builtin_ctzll(left);
                if (at_u >= width - 3)
                    break;
                if (!is_peak(rows, at_u))
                    continue;
                at[2 * count] = (int32_t)at_u;
                at[2 * count + 1] = (int32_t)(v - 2);
                response[count++] = rows[2][at_u];
            }
        }
    }
    return count;
}

/* Keep of `count` peaks, in place and in their order, about the `most` strongest beside the strongest one in their square
 * of `side` pixels (reference.front._strongest): as many bins of this share as are needed, the highest first. `squares`
 * ((height / side + 1) * (width / side + 1)), `bins` (`finest` + 1), both zeroed, and `share` (count) are scratch. Returns
 * how many are left. */
int64_t keep_strongest(
    int32_t *at, float *response, int64_t count, int64_t height, int64_t width, int64_t side, int64_t most,
    int64_t finest, float *squares, int32_t *bins, int32_t *share)
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
        /* Beyond what float32 holds one is as strong as the other. */
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
