/* From an image to linked corners: smoothing, saddle response and its peaks, ring tests, links.
 *
 * The definitions in numpy are in tests/kernels/reference/front.py, the numbers in rigkit.detection: saddles and lattice.links. */
#include "kernels.h"

/* So many bits of a number at a time are counted to rank it. */
#define RANK_BITS 11

/* The means of factor x factor pixels: out (height / factor, width / factor). `sums` (width) is scratch. */
FOR_EACH_PROCESSOR void shrink_floats(
    const float *restrict image, int64_t height, int64_t width, int64_t factor, float *restrict sums,
    float *restrict out)
{
    const int64_t rows = height / factor, columns = width / factor;
    const float share = 1.0f / (float)(factor * factor);
    for (int64_t row = 0; row < rows; row++) {
        const float *restrict from = image + row * factor * width;
        memcpy(sums, from, (size_t)(columns * factor) * sizeof(float));
        for (int64_t k = 1; k < factor; k++)
            for (int64_t u = 0; u < columns * factor; u++)
                sums[u] += from[k * width + u];
        float *restrict to = out + row * columns;
        for (int64_t u = 0; u < columns; u++) {
            float sum = 0.0f;
            for (int64_t k = 0; k < factor; k++)
                sum += sums[factor * u + k];
            to[u] = share * sum;
        }
    }
}

/* The same of bytes; sums of at most 256 rows fit 16 bits. */
FOR_EACH_PROCESSOR void shrink_bytes(
    const uint8_t *restrict image, int64_t height, int64_t width, int64_t factor, uint16_t *restrict sums,
    float *restrict out)
{
    const int64_t rows = height / factor, columns = width / factor;
    const float share = 1.0f / (float)(factor * factor);
    for (int64_t row = 0; row < rows; row++) {
        const uint8_t *restrict from = image + row * factor * width;
        for (int64_t u = 0; u < columns * factor; u++)
            sums[u] = from[u];
        for (int64_t k = 1; k < factor; k++)
            for (int64_t u = 0; u < columns * factor; u++)
                sums[u] = (uint16_t)(sums[u] + from[k * width + u]);
        float *restrict to = out + row * columns;
        for (int64_t u = 0; u < columns; u++) {
            uint32_t sum = 0;
            for (int64_t k = 0; k < factor; k++)
                sum += sums[factor * u + k];
            to[u] = share * (float)sum;
        }
    }
}

/* The rows of an image two above to two below row v, the border repeated. */
typedef struct {
    int64_t above2, above, here, below, below2;
} rows_t;

INLINE rows_t rows_around(int64_t v, int64_t height, int64_t width)
{
    return (rows_t){(v > 2 ? v - 2 : 0) * width, (v > 1 ? v - 1 : 0) * width, v * width,
                    (v < height - 1 ? v + 1 : height - 1) * width, (v < height - 2 ? v + 2 : height - 1) * width};
}

/* Smooth with the kernel (outer, inner, centre, inner, outer) both ways, the border repeated; `half` gets every second
 * pixel of every second row. `column` (width + 4) is scratch. */
FOR_EACH_PROCESSOR void smooth_floats(
    const float *restrict image, int64_t height, int64_t width, const float *restrict kernel, float *restrict column,
    float *restrict out, float *restrict half)
{
    const float outer = kernel[0], inner = kernel[1], centre = kernel[2];
    const int64_t half_width = (width + 1) / 2;
    float *restrict middle = column + 2;
    for (int64_t v = 0; v < height; v++) {
        const rows_t at = rows_around(v, height, width);
        const float *restrict above2 = image + at.above2, *restrict above = image + at.above;
        const float *restrict below2 = image + at.below2, *restrict below = image + at.below;
        const float *restrict here = image + at.here;
        for (int64_t u = 0; u < width; u++)
            middle[u] = outer * (above2[u] + below2[u]) + inner * (above[u] + below[u]) + centre * here[u];
        column[0] = column[1] = middle[0];
        middle[width] = middle[width + 1] = middle[width - 1];
        float *restrict to = out + v * width;
        for (int64_t u = 0; u < width; u++)
            to[u] = outer * (column[u] + column[u + 4]) + inner * (column[u + 1] + column[u + 3]) +
                    centre * column[u + 2];
        if (v % 2 == 0)
            for (int64_t u = 0; u < half_width; u++)
                half[v / 2 * half_width + u] = to[2 * u];
    }
}

/* The same of bytes with a kernel of small integers over `whole`: exact, as long as whole^2 * 255 fits 16 bits. */
FOR_EACH_PROCESSOR void smooth_bytes(
    const uint8_t *restrict image, int64_t height, int64_t width, const float *restrict kernel, float whole,
    uint16_t *restrict column, float *restrict out, float *restrict half)
{
    const uint16_t outer = (uint16_t)lrintf(whole * kernel[0]), inner = (uint16_t)lrintf(whole * kernel[1]);
    const uint16_t centre = (uint16_t)lrintf(whole * kernel[2]);
    const float share = 1.0f / (whole * whole);
    const int64_t half_width = (width + 1) / 2;
    uint16_t *restrict middle = column + 2;
    for (int64_t v = 0; v < height; v++) {
        const rows_t at = rows_around(v, height, width);
        const uint8_t *restrict above2 = image + at.above2, *restrict above = image + at.above;
        const uint8_t *restrict below2 = image + at.below2, *restrict below = image + at.below;
        const uint8_t *restrict here = image + at.here;
        for (int64_t u = 0; u < width; u++)
            middle[u] = (uint16_t)(outer * (uint16_t)(above2[u] + below2[u]) + inner * (uint16_t)(above[u] + below[u]) +
                                   centre * here[u]);
        column[0] = column[1] = middle[0];
        middle[width] = middle[width + 1] = middle[width - 1];
        float *restrict to = out + v * width;
        for (int64_t u = 0; u < width; u++)
            to[u] = share * (float)(uint16_t)(outer * (uint16_t)(column[u] + column[u + 4]) +
                                              inner * (uint16_t)(column[u + 1] + column[u + 3]) +
                                              centre * column[u + 2]);
        if (v % 2 == 0)
            for (int64_t u = 0; u < half_width; u++)
                half[v / 2 * half_width + u] = to[2 * u];
    }
}

/* Minus the determinant of the Hessian at one pixel. */
INLINE float saddle_response(const float *at, int64_t width)
{
    const float here = 2.0f * at[0];
    const float uu = at[1] + at[-1] - here, vv = at[width] + at[-width] - here;
    const float uv = 0.25f * ((at[width + 1] + at[-width - 1]) - (at[-width + 1] + at[width - 1]));
    return uv * uv - uu * vv;
}

/* Return a number of the order of `value` among all floats: as integers of their bits positive ones are in order. */
INLINE uint32_t order_of(float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits ^ (bits >> 31 ? UINT32_MAX : UINT32_C(1) << 31);
}

/* Return what `at` of `count` values are smaller than or equal to: its bits from the highest downwards, by counting the
 * values that share those found so far. */
static float value_at_rank(const float *values, int64_t count, int64_t at)
{
    uint32_t found = 0;
    int32_t often[1 << RANK_BITS];
    for (int left = 32; left > 0;) {
        const int low = left > RANK_BITS ? left - RANK_BITS : 0;
        const uint32_t mask = (UINT32_C(1) << (left - low)) - 1;
        memset(often, 0, sizeof often);
        for (int64_t k = 0; k < count; k++) {
            const uint32_t order = order_of(values[k]);
            /* A shift by 32 is undefined. */
            if (((uint64_t)(order ^ found) >> left) == 0)
                often[order >> low & mask]++;
        }
        uint32_t bits = 0;
        for (; at >= often[bits] && bits < mask; bits++)
            at -= often[bits];
        found |= bits << low;
        left = low;
    }
    const uint32_t sign = found >> 31 ? UINT32_C(1) << 31 : UINT32_MAX, back = found ^ sign;
    float value;
    memcpy(&value, &back, sizeof value);
    return value;
}

/* Of every step-th inner pixel of every step-th inner row: set out to the upper median of |response|, and the brightness
 * that `few` of them are darker and brighter than. */
void typical_values(
    const float *smooth, int64_t height, int64_t width, int64_t step, int64_t few, float *response, float *brightness,
    float *out)
{
    int64_t count = 0;
    for (int64_t v = 1; v < height - 1; v += step)
        for (int64_t u = 1; u < width - 1; u += step) {
            const float *at = smooth + v * width + u;
            response[count] = fabsf(saddle_response(at, width));
            brightness[count++] = *at;
        }
    out[0] = value_at_rank(response, count, count / 2);
    out[1] = value_at_rank(brightness, count, few);
    out[2] = value_at_rank(brightness, count, count - 1 - few);
}

/* Return as bits, the lowest first, which of the pixels u to u + STRIP - 1 of a row are peaks: not lower than the
 * neighbours that follow within two pixels, higher than those before (a corner between pixels makes two equal ones), and
 * above the threshold. */
INLINE uint64_t peaks_among(float *const rows[5], int64_t u, float threshold)
{
    float before[STRIP + 4], after[STRIP + 4];
    uint8_t peak[STRIP];
    const float *above2 = rows[0] + u - 2, *above = rows[1] + u - 2, *here = rows[2] + u;
    const float *below = rows[3] + u - 2, *below2 = rows[4] + u - 2;
    for (int k = 0; k < STRIP + 4; k++) {
        before[k] = above[k] > above2[k] ? above[k] : above2[k];
        after[k] = below[k] > below2[k] ? below[k] : below2[k];
    }
    for (int k = 0; k < STRIP; k++) {
        float most = before[k];
        most = before[k + 1] > most ? before[k + 1] : most;
        most = before[k + 2] > most ? before[k + 2] : most;
        most = before[k + 3] > most ? before[k + 3] : most;
        most = before[k + 4] > most ? before[k + 4] : most;
        most = here[k - 2] > most ? here[k - 2] : most;
        most = here[k - 1] > most ? here[k - 1] : most;
        most = threshold > most ? threshold : most;
        float least = after[k];
        least = after[k + 1] > least ? after[k + 1] : least;
        least = after[k + 2] > least ? after[k + 2] : least;
        least = after[k + 3] > least ? after[k + 3] : least;
        least = after[k + 4] > least ? after[k + 4] : least;
        least = here[k + 1] > least ? here[k + 1] : least;
        least = here[k + 2] > least ? here[k + 2] : least;
        peak[k] = (uint8_t)((here[k] > most) & (here[k] >= least));
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
    const float *smooth, int64_t height, int64_t width, float threshold, float *scratch, uint8_t *high, int32_t *at,
    float *response)
{
    enum { FIRST = 3 };
    const int64_t stride = width + STRIP + 4, strips = width / STRIP + 1;
    for (int64_t k = 0; k < 5 * stride; k++)
        scratch[k] = -1e30f;
    int64_t count = 0;
    for (int64_t v = 1; v < height - 1; v++) {
        const float *from = smooth + v * width;
        float *last = scratch + v % 5 * stride;
        uint8_t *mark = high + v % 5 * strips;
        last[1] = saddle_response(from + 1, width);
        last[2] = saddle_response(from + 2, width);
        for (int64_t u = FIRST; u < width - 1; u += STRIP, mark++)
            /* Twice, so that the compiler knows how many there are. */
            *mark = (uint8_t)(u + STRIP < width ? fill_response(from + u, width, STRIP, threshold, last + u)
                                                : fill_response(from + u, width, width - 1 - u, threshold, last + u));
        /* The middle one of the five rows is v - 2. */
        if (v < 5)
            continue;
        float *rows[5];
        for (int k = 0; k < 5; k++)
            rows[k] = scratch + (v + 1 + k) % 5 * stride;
        mark = high + (v - 2) % 5 * strips;
        for (int64_t u = FIRST; u < width - 3; u += STRIP, mark++) {
            if (!*mark)
                continue;
            for (uint64_t left = peaks_among(rows, u, threshold); left; left &= left - 1) {
                const int64_t at_u = u + __builtin_ctzll(left);
                if (at_u >= width - 3)
                    break;
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

/* reference.front.saddle_step for one pixel; whether it is a saddle and near. */
INLINE int saddle_near(const float *smooth, int64_t width, int64_t u, int64_t v, double most_step, double pixel[2])
{
    const float *at = smooth + v * width + u;
    const double here = at[0], left = at[-1], right = at[1], above = at[-width], below = at[width];
    const double gu = 0.5 * (right - left), gv = 0.5 * (below - above);
    const double uu = right + left - 2.0 * here, vv = below + above - 2.0 * here;
    const double uv = 0.25 * (((double)at[width + 1] + at[-width - 1]) - ((double)at[-width + 1] + at[width - 1]));
    const double det = uu * vv - uv * uv;
    if (!(det < 0.0))
        return 0;
    const double step_u = (uv * gv - vv * gu) / det, step_v = (uv * gu - uu * gv) / det;
    pixel[0] = (double)u + step_u;
    pixel[1] = (double)v + step_v;
    return fabs(step_u) <= most_step && fabs(step_v) <= most_step;
}

/* Return whether every fourth sample of the ring around (u, v) leaves it possible that there is a corner
 * (reference.front.may_be_corners). */
INLINE int may_be_corner(
    const image_t image, const ring_rules_t *rules, float u, float v, float radius, float response)
{
    enum { PAIRS = HALF / 4 };
    float even[PAIRS], mean = 0.0f, energy = 0.0f, odd_energy = 0.0f;
    for (int64_t k = 0; k < PAIRS; k++) {
        const float *one = rules->circle + 8 * k, *other = one + 2 * HALF;
        const float here = brightness_at(image, u + radius * one[0], v + radius * one[1]);
        const float there = brightness_at(image, u + radius * other[0], v + radius * other[1]);
        even[k] = 0.5f * (here + there);
        mean += even[k];
        odd_energy += 0.25f * (here - there) * (here - there);
    }
    mean /= (float)PAIRS;
    for (int64_t k = 0; k < PAIRS; k++)
        energy += (even[k] - mean) * (even[k] - mean);
    const float centre = brightness_at(image, u, v) - mean, variance = energy / (float)PAIRS;
    return odd_energy < (float)rules->quick_odd * energy &&
           centre * centre < (float)(rules->quick_centre * rules->quick_centre) * variance &&
           response < (float)rules->quick_sharp * variance;
}

/* The corners of one level among `count` peaks of `response`: `saddles` (count, 2) gets those with a saddle nearby,
 * `which`, `angles` (count, 2) and `contrast` those of them that are corners: their ring is valid and they are no sharper
 * than `most_sharp`. Returns the number of saddles and, in `found`, of corners. */
FOR_EACH_PROCESSOR int64_t find_corners(
    image_t image, const ring_rules_t *rules, double radius, double most_step, double most_sharp, const int32_t *peaks,
    const float *response, int64_t count, double *saddles, int64_t *which, double *angles, double *contrast,
    int64_t *found)
{
    int64_t near = 0, corners = 0;
    for (int64_t k = 0; k < count; k++) {
        double *pixel = saddles + 2 * near;
        if (!saddle_near(image.brightness, image.width, peaks[2 * k], peaks[2 * k + 1], most_step, pixel))
            continue;
        near++;
        if (may_be_corner(image, rules, (float)pixel[0], (float)pixel[1], (float)radius, response[k]) &&
            read_ring(image, *rules, (float)pixel[0], (float)pixel[1], (float)radius, sqrt((double)response[k] / most_sharp),
                      angles + 2 * corners, contrast + corners))
            which[corners++] = near - 1;
    }
    *found = corners;
    return near;
}

/* Mark those of `fresh` (count, 2) that lie within `reach` of one of `known`. Returns 0 without memory. */
int64_t mark_known(
    const double *fresh, int64_t count, const double *known, int64_t known_count, double reach, uint8_t *mark)
{
    squares_t squares;
    int32_t *scratch = malloc((size_t)SQUARES_MEMORY(known_count) * sizeof(int32_t));
    if (!scratch)
        return 0;
    fill_squares(known, known_count, reach, scratch, &squares);
    for (int64_t i = 0; i < count; i++) {
        const double u = fresh[2 * i], v = fresh[2 * i + 1];
        const int64_t left = square_at(u - reach, squares.left, squares.side, squares.columns);
        const int64_t right = square_at(u + reach, squares.left, squares.side, squares.columns);
        const int64_t bottom = square_at(v + reach, squares.top, squares.side, squares.rows);
        mark[i] = 0;
        for (int64_t row = square_at(v - reach, squares.top, squares.side, squares.rows); row <= bottom; row++) {
            const int32_t *first = squares.first + row * squares.columns;
            for (int32_t k = first[left]; k < first[right + 1]; k++) {
                const double du = known[2 * squares.order[k]] - u, dv = known[2 * squares.order[k] + 1] - v;
                mark[i] |= du * du + dv * dv <= reach * reach;
            }
        }
    }
    free(scratch);
    return 1;
}

/* A corner that may be the neighbour along an arm. */
typedef struct {
    float square;
    int64_t arm, end, back;
} candidate_t;

/* Corners that are looked at together; memory behind all lists is long enough for so many more. */
enum { TOGETHER = 8 };

/* The corners in the order of the squares, so that those of a row of squares lie side by side: position, the unit
 * vectors of both lines, contrast. */
enum { A_U, A_V, B_U, B_V, CONTRAST, COLUMNS };
typedef struct {
    double *u, *v;
    float *columns[COLUMNS];
} places_t;

/* What is found around a corner: square of the distance, infinite where the contrast is not like its own; the place;
 * whether they point an arm of the other kind at each other. */
typedef struct {
    float *square;
    int32_t *place, *meets;
} near_t;

/* The corner whose neighbours are looked for, and the bounds of their contrast. */
typedef struct {
    double u, v;
    float lines[4], contrast, least, most, ratio, square_of_cosine;
} home_t;

/* Look at the places `from` to `to` - 1 and append them to the `count` near ones; return how many there are then. */
INLINE int64_t look_at(
    const places_t *places, int64_t from, int64_t to, const home_t *home, const near_t *near, int64_t count)
{
    const float mine_a_u = home->lines[0], mine_a_v = home->lines[1];
    const float mine_b_u = home->lines[2], mine_b_v = home->lines[3];
    const float contrast = home->contrast, ratio = home->ratio, cosine = home->square_of_cosine;
    for (int64_t first = from; first < to; first += TOGETHER) {
        const double *us = places->u + first, *vs = places->v + first;
        const float *a_u = places->columns[A_U] + first, *a_v = places->columns[A_V] + first;
        const float *b_u = places->columns[B_U] + first, *b_v = places->columns[B_V] + first;
        const float *theirs = places->columns[CONTRAST] + first;
        float *restrict square = near->square + count + first - from;
        int32_t *restrict place = near->place + count + first - from;
        int32_t *restrict meets = near->meets + count + first - from;
        for (int32_t k = 0; k < TOGETHER; k++) {
            const float u = (float)(us[k] - home->u), v = (float)(vs[k] - home->v), here = u * u + v * v;
            const float a = u * mine_a_u + v * mine_a_v, b = u * mine_b_u + v * mine_b_v;
            const float home_a = u * a_u[k] + v * a_v[k], home_b = u * b_u[k] + v * b_v[k];
            const float along = a * a > b * b ? a * a : b * b;
            const float back = home_a * home_a > home_b * home_b ? home_a * home_a : home_b * home_b;
            const int32_t alike = (theirs[k] > home->least) & (theirs[k] < home->most);
            square[k] = alike ? here : INFINITY;
            place[k] = (int32_t)first + k;
            meets[k] = alike & (along > cosine * here) & (back > cosine * here) &
                       ((b * b > a * a) != (home_b * home_b > home_a * home_a)) & (contrast > ratio * theirs[k]) &
                       (theirs[k] > ratio * contrast);
        }
    }
    return count + to - from;
}

/* How many of the `count` near corners are alike and nearer than the square root of `most`. */
INLINE int32_t count_nearer(const near_t *near, int64_t count, float most)
{
    const float *restrict square = near->square;
    int32_t nearer = 0;
    for (int64_t k = 0; k < count; k++)
        nearer += square[k] < most;
    return nearer;
}

/* Look at the corners around `home`, square by square: at least the `wanted` nearest alike. Returns how many. */
INLINE int64_t gather(
    const squares_t *squares, const places_t *places, const home_t *home, int64_t wanted, const near_t *near)
{
    /* Squares to each side that mostly have enough. */
    enum { AT_ONCE = 3 };
    const double u = home->u, v = home->v, side = squares->side;
    const int64_t column = square_at(u, squares->left, side, squares->columns);
    const int64_t row = square_at(v, squares->top, side, squares->rows);
    const double in_u = u - squares->left - (double)column * side, in_v = v - squares->top - (double)row * side;
    double inner = in_u < in_v ? in_u : in_v;
    inner = side - in_u < inner ? side - in_u : inner;
    inner = side - in_v < inner ? side - in_v : inner;
    int64_t count = 0;
    for (int64_t ring = AT_ONCE;; ring++) {
        const int64_t left = column - ring, right = column + ring, top = row - ring, bottom = row + ring;
        for (int64_t r = top > 0 ? top : 0; r <= bottom && r < squares->rows; r++) {
            const int32_t *first = squares->first + r * squares->columns;
            /* Whole rows above and below, the two ends of the others. */
            const int whole = ring == AT_ONCE || r == top || r == bottom;
            for (int part = 0; part < (whole ? 1 : 2); part++) {
                int64_t from = part == 0 ? left : right, to = whole ? right : from;
                if (to < 0 || from >= squares->columns)
                    continue;
                from = from > 0 ? from : 0;
                to = to < squares->columns ? to : squares->columns - 1;
                count = look_at(places, first[from], first[to + 1], home, near, count);
            }
        }
        if (left <= 0 && top <= 0 && right >= squares->columns - 1 && bottom >= squares->rows - 1)
            return count;
        /* All corners within the root of `safe` are among them by now. */
        const float safe = (float)((inner + (double)ring * side) * (inner + (double)ring * side));
        if (count >= wanted && count_nearer(near, count, safe) >= wanted)
            return count;
    }
}

/* The arm (A, B, -A, -B) that points most along the chord. */
INLINE int64_t arm_along(double a, double b)
{
    return fabs(b) > fabs(a) ? (b < 0.0 ? 3 : 1) : (a < 0.0 ? 2 : 0);
}

/* Whether the edge from corner i is there (reference.front._edge_seen). */
INLINE int link_seen(
    const corners_t *corners, const image_t image, double scale, double offset, const link_rules_t *rules, int64_t i,
    const candidate_t *link)
{
    const int64_t j = link->end;
    const double u = (corners->pixels[2 * i] - offset) / scale, v = (corners->pixels[2 * i + 1] - offset) / scale;
    const double end_u = (corners->pixels[2 * j] - offset) / scale;
    const double end_v = (corners->pixels[2 * j + 1] - offset) / scale;
    double aside = rules->aside * sqrt((end_u - u) * (end_u - u) + (end_v - v) * (end_v - v));
    const double most = corners->reach[i];
    aside = aside > rules->least_aside ? aside : rules->least_aside;
    aside = aside < most ? aside : most;
    const double there = corners->contrast[j], here = corners->contrast[i];
    const double weakest = rules->contrast_ratio * (there < here ? there : here);
    return edge_seen(image, rules->along, rules->places, rules->most, u, v, end_u, end_v, link->arm % 2 ? -1.0 : 1.0,
                     aside, weakest);
}

/* The nearest corner along each of the four arms of the corner at `place` whose edge is seen: to[arm] = 4 * corner +
 * arm, or -1. */
INLINE void link_arms(
    const corners_t *corners, const squares_t *squares, const places_t *places, int64_t place, const image_t image,
    double scale, double offset, const link_rules_t *rules, const near_t *near, int64_t *to)
{
    enum { MOST_CANDIDATES = 512 };
    candidate_t candidates[MOST_CANDIDATES];
    const int64_t i = squares->order[place], wanted = rules->neighbours + 1;
    const home_t home = {places->u[place], places->v[place],
                         {places->columns[A_U][place], places->columns[A_V][place], places->columns[B_U][place],
                          places->columns[B_V][place]},
                         places->columns[CONTRAST][place], (float)corners->least[i], (float)corners->most[i],
                         (float)rules->contrast_ratio, (float)(rules->arm_cosine * rules->arm_cosine)};
    const int64_t count = gather(squares, places, &home, wanted, near);
    int64_t listed = 0;
    for (int64_t first = 0; first < count; first += TOGETHER) {
        int32_t any = 0;
        for (int64_t k = first; k < first + TOGETHER; k++)
            any |= near->meets[k];
        if (!any)
            continue;
        const int64_t end = first + TOGETHER < count ? first + TOGETHER : count;
        for (int64_t k = first; k < end && listed < MOST_CANDIDATES; k++) {
            const float square = near->square[k];
            if (!near->meets[k] || count_nearer(near, count, square) >= wanted)
                continue;
            const int32_t at = near->place[k];
            const float u = (float)(places->u[at] - home.u), v = (float)(places->v[at] - home.v);
            const candidate_t fresh = {
                square, arm_along(u * home.lines[0] + v * home.lines[1], u * home.lines[2] + v * home.lines[3]),
                squares->order[at],
                arm_along(-(u * places->columns[A_U][at] + v * places->columns[A_V][at]),
                          -(u * places->columns[B_U][at] + v * places->columns[B_V][at]))};
            int64_t rank = listed++;
            for (; rank > 0 && candidates[rank - 1].square > square; rank--)
                candidates[rank] = candidates[rank - 1];
            candidates[rank] = fresh;
        }
    }
    for (int64_t k = 0; k < listed; k++) {
        const candidate_t *link = candidates + k;
        if (to[link->arm] < 0 && link_seen(corners, image, scale, offset, rules, i, link))
            to[link->arm] = 4 * link->end + link->back;
    }
}

static double link_length(const double *pixels, int64_t i, int64_t to)
{
    const double du = pixels[2 * (to / 4)] - pixels[2 * i], dv = pixels[2 * (to / 4) + 1] - pixels[2 * i + 1];
    return sqrt(du * du + dv * dv);
}

/* reference.front.links: both[4 * i + arm] = 4 * neighbour + its arm, -1 for none. Of the corners, `lines` (count, 4)
 * are the unit vectors of A and B, `least` and `most` bound the contrast of those looked at, `reach` is the most `aside`.
 * `nearest` (count, 4) is scratch. Returns 0 without memory. */
FOR_EACH_PROCESSOR int64_t find_links(
    const corners_t *corners, image_t image, double scale, double offset, const link_rules_t *rules, int64_t *nearest,
    int64_t *both)
{
    const int64_t count = corners->count, room = count + TOGETHER;
    squares_t squares;
    double *memory = calloc((size_t)room, 2 * sizeof(double) + (COLUMNS + 1) * sizeof(float) + 2 * sizeof(int32_t));
    int32_t *scratch = malloc((size_t)SQUARES_MEMORY(count) * sizeof(int32_t));
    if (!memory || !scratch) {
        free(memory);
        free(scratch);
        return 0;
    }
    fill_squares(corners->pixels, count, 1.0, scratch, &squares);
    places_t places = {memory, memory + room, {NULL}};
    for (int k = 0; k < COLUMNS; k++)
        places.columns[k] = (float *)(memory + 2 * room) + k * room;
    const near_t near = {places.columns[COLUMNS - 1] + room, (int32_t *)(places.columns[COLUMNS - 1] + 2 * room),
                         (int32_t *)(places.columns[COLUMNS - 1] + 3 * room)};
    for (int64_t k = 0; k < count; k++) {
        const int32_t i = squares.order[k];
        places.u[k] = corners->pixels[2 * i];
        places.v[k] = corners->pixels[2 * i + 1];
        for (int part = 0; part < 4; part++)
            places.columns[A_U + part][k] = (float)corners->lines[4 * i + part];
        places.columns[CONTRAST][k] = (float)corners->contrast[i];
    }
    for (int64_t k = 0; k < 4 * count; k++)
        nearest[k] = both[k] = -1;
    /* In the order of the squares: neighbours look at the same corners and pixels. */
    for (int64_t k = 0; k < count; k++)
        link_arms(corners, &squares, &places, k, image, scale, offset, rules, &near,
                  nearest + 4 * (int64_t)squares.order[k]);
    free(memory);
    free(scratch);
    for (int64_t k = 0; k < 4 * count; k++)
        if (nearest[k] >= 0 && nearest[nearest[k]] == k)
            both[k] = nearest[k];
    /* Both halves of a link go, so what is dropped is marked before it is. */
    for (int64_t k = 0; k < 4 * count; k++) {
        const int64_t opposite = k / 4 * 4 + (k + 2) % 4;
        nearest[k] = both[k] >= 0 && both[opposite] >= 0 &&
                     link_length(corners->pixels, k / 4, both[k]) >
                         rules->length_ratio * link_length(corners->pixels, k / 4, both[opposite]);
    }
    for (int64_t k = 0; k < 4 * count; k++)
        if (nearest[k] && both[k] >= 0) {
            both[both[k]] = -1;
            both[k] = -1;
        }
    return 1;
}
