/* Sparse tests of an image: whether it is the raw mosaic of a colour camera, whether it has bad pixels, and whether its even and odd
 * lines differ. The definitions in numpy are in tests/kernels/reference/looks.py. */
#include "kernels.h"

/* Return whether one of the four positions in cells of 2 x 2 pixels is brighter or darker than the mean of its cell by `share` of
 * it, in the upper median over the cells whose mean is above the upper median of all and above `least`; every `step`-th cell in
 * both directions. */
int64_t has_mosaic(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t step, double least, double share, double *scratch)
{
    enum { PLACES = 4 };
    const int64_t down = height / 2 / step, across = width / 2 / step, count = down * across;
    double *mean = scratch, *ranked_mean = scratch + count;
    for (int64_t row = 0, k = 0; row < down; row++)
        for (int64_t column = 0; column < across; column++, k++) {
            const int64_t at = 2 * step * (row * width + column);
            const double upper = level_at(grey, bytes, at) + level_at(grey, bytes, at + 1);
            const double lower = level_at(grey, bytes, at + width) + level_at(grey, bytes, at + width + 1);
            mean[k] = ranked_mean[k] = (upper + lower) / 4.0;
        }
    const double middle = ranked(ranked_mean, count, count / 2), above = middle > least ? middle : least;
    /* Counting decides whether a median is above a bound faster than computing the median. */
    int64_t bright = 0, low[PLACES] = {0}, high[PLACES] = {0};
    for (int64_t row = 0, k = 0; row < down; row++)
        for (int64_t column = 0; column < across; column++, k++) {
            if (!(mean[k] > above))
                continue;
            bright++;
            for (int64_t place = 0; place < PLACES; place++) {
                const int64_t at = 2 * step * (row * width + column) + place / 2 * width + place % 2;
                const double off = level_at(grey, bytes, at) / mean[k] - 1.0;
                low[place] += off <= -share;
                high[place] += off >= share;
            }
        }
    int64_t uneven = 0;
    for (int64_t place = 0; place < PLACES; place++)
        uneven |= low[place] > bright / 2 || high[place] >= bright - bright / 2;
    return bright > 0 && uneven;
}

/* Return the number of inner pixels of every `apart`-th row, from `first` on, that are brighter than all eight neighbours, or
 * darker, by more than `step`, or by `share` of the range of these rows if that is larger; the range goes into `span`. */
int64_t count_bad_pixels(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t first, int64_t apart, double step, double share,
    double *span)
{
    double low = INFINITY, high = -INFINITY;
    for (int64_t v = first; v < height - 1; v += apart)
        for (int64_t u = 0; u < width; u++) {
            const double level = level_at(grey, bytes, v * width + u);
            low = level < low ? level : low;
            high = level > high ? level : high;
        }
    *span = high - low;
    const double least = step > share * *span ? step : share * *span;
    int64_t count = 0;
    for (int64_t v = first; v < height - 1; v += apart)
        for (int64_t u = 1; u < width - 1; u++) {
            const int64_t at = v * width + u;
            const double own = level_at(grey, bytes, at), left = level_at(grey, bytes, at - 1),
                         above = level_at(grey, bytes, at - width);
            /* Most pixels are rejected by one of these two. */
            if (fabs(own - left) <= least || fabs(own - above) <= least)
                continue;
            double most = left > above ? left : above, fewest = left < above ? left : above;
            const int64_t others[6] = {1, width, 1 - width, 1 + width, -1 - width, width - 1};
            for (int k = 0; k < 6; k++) {
                const double level = level_at(grey, bytes, at + others[k]);
                most = level > most ? level : most;
                fewest = level < fewest ? level : fewest;
            }
            count += own - most > least || fewest - own > least;
        }
    return count;
}

/* Add to `more` and `less` the places of four lines whose differences alternate, and those that lie between the first and the last
 * two; `type` is that of the image. */
#define DEFINE_COUNT_ALTERNATING(name, type) \
    INLINE void name(const type *lines, int64_t width, int64_t across, float step, int64_t *more, int64_t *less) \
    { \
        const type *second = lines + width, *third = second + width, *fourth = third + width; \
        int32_t alternating_here = 0, between_here = 0; \
        for (int64_t u = 0; u < across; u++) { \
            const float outer = (float)lines[u] - (float)fourth[u], inner = (float)second[u] - (float)third[u]; \
            const float alternating = fabsf(outer - inner), between = fabsf(outer + inner); \
            alternating_here += alternating > (between > step ? between : step); \
            between_here += between > (alternating > step ? alternating : step); \
        } \
        *more += alternating_here; \
        *less += between_here; \
    }

DEFINE_COUNT_ALTERNATING(count_alternating_bytes, uint8_t)
DEFINE_COUNT_ALTERNATING(count_alternating_floats, float)

/* Set `more` and `less` (tiles, tiles) to the numbers of places of `groups` (a multiple of `tiles`) of four lines whose differences
 * alternate, and of those that lie between the first and the last two (reference.looks.alternating). */
FOR_EACH_PROCESSOR void count_alternating(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t groups, int64_t tiles, double step, int64_t *more,
    int64_t *less)
{
    const int64_t across = width / tiles, last = groups > 1 ? groups - 1 : 1;
    memset(more, 0, (size_t)(tiles * tiles) * sizeof(int64_t));
    memset(less, 0, (size_t)(tiles * tiles) * sizeof(int64_t));
    for (int64_t group = 0; group < groups; group++) {
        const int64_t first = 2 * (group * ((height - 4) / 2) / last), row = group / (groups / tiles);
        for (int64_t column = 0; column < tiles; column++) {
            const int64_t at = first * width + column * across, tile = row * tiles + column;
            if (bytes)
                count_alternating_bytes((const uint8_t *)grey + at, width, across, (float)step, more + tile, less + tile);
            else
                count_alternating_floats((const float *)grey + at, width, across, (float)step, more + tile, less + tile);
        }
    }
}
