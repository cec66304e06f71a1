/* Chessboard corners among the peaks of the saddle response, by their saddle points and the rings around them. The definitions in
 * numpy are in tests/kernels/reference/front.py, the numbers in rigkit.detection.saddles. */
#include "rings.h"

/* Set `pixel` to the stationary point of the quadratic at pixel (u, v) (reference.front.saddle_step); return whether it is a saddle
 * and within `max_step`. */
INLINE int saddle_near(const float *smooth, int64_t width, int64_t u, int64_t v, double max_step, double pixel[2])
{
    const float *at = smooth + v * width + u;
    const double here = at[0], left = at[-1], right = at[1], above = at[-width], below = at[width];
    const double gu = 0.5 * (right - left), gv = 0.5 * (below - above);
    const double uu = right + left - 2.0 * here, vv = below + above - 2.0 * here;
    const double uv = 0.25 * (((double)at[width + 1] + at[-width - 1]) - ((double)at[-width + 1] + at[width - 1]));
    const double det = uu * vv - uv * uv;
    if (!(det < 0.0))
        return 0;
    const double inverse = 1.0 / det, step_u = (uv * gv - vv * gu) * inverse, step_v = (uv * gu - uu * gv) * inverse;
    pixel[0] = (double)u + step_u;
    pixel[1] = (double)v + step_v;
    return fabs(step_u) <= max_step && fabs(step_v) <= max_step;
}

/* Return whether (u, v) may be a corner, by every fourth sample of its ring (reference.front.may_be_corners). */
INLINE int may_be_corner(const image_t image, const ring_rules_t *rules, float u, float v, float radius, float response)
{
    enum { EVERY = 4, PAIRS = HALF / EVERY, SAMPLES = 2 * PAIRS };
    float even[PAIRS], mean = 0.0f, energy = 0.0f, odd_energy = 0.0f, seen[SAMPLES];
    sample_ring(image, rules->circle, EVERY, u, v, radius, seen);
    for (int64_t k = 0; k < PAIRS; k++) {
        even[k] = 0.5f * (seen[k] + seen[PAIRS + k]);
        mean += even[k];
        odd_energy += 0.25f * (seen[k] - seen[PAIRS + k]) * (seen[k] - seen[PAIRS + k]);
    }
    mean /= (float)PAIRS;
    for (int64_t k = 0; k < PAIRS; k++)
        energy += (even[k] - mean) * (even[k] - mean);
    const float centre = brightness_at(image, u, v) - mean, variance = energy / (float)PAIRS;
    const double max_centre = odd_energy < (float)rules->even_odd * energy ? rules->quick_even : rules->quick_centre;
    return odd_energy < (float)rules->quick_odd * energy && centre * centre < (float)(max_centre * max_centre) * variance
        && response < (float)rules->quick_sharp * variance;
}

/* Prefetch the pixels of the ring around (u, v): the image does not fit the near caches. */
INLINE void fetch_ring(const image_t image, int64_t u, int64_t v, int64_t reach)
{
    const int64_t left = u > reach ? u - reach : 0, top = v > reach ? v - reach : 0;
    const int64_t bottom = v + reach < image.height ? v + reach : image.height - 1;
    for (int64_t row = top; row <= bottom; row++)
        __builtin_prefetch(image.brightness + row * image.width + left);
}

/* Find the corners among the `count` peaks of a level (reference.front.corners). Set `saddles` to the saddles near the peaks, in
 * pixels of the full image (`scale`, `offset`), `pixels`, `angles` and `contrast` to those that are corners, whose ring is valid
 * and which are no sharper than `max_sharp`, `smeared` to the corners that need motion blur, and `found` to the numbers of
 * saddles and corners. */
static FOR_EACH_PROCESSOR void read_peaks(
    const image_t image, const int32_t *peaks, const float *response, int64_t count, double radius, double max_step,
    double max_sharp, const ring_rules_t *rules, double scale, double offset, double *saddles, double *pixels, double *angles,
    double *contrast, uint8_t *smeared, int64_t *found)
{
    enum { AHEAD = 6 };
    const int64_t reach = (int64_t)radius + 1;
    int64_t near = 0, corners = 0;
    for (int64_t k = 0; k < count; k++) {
        if (k + AHEAD < count)
            fetch_ring(image, peaks[2 * (k + AHEAD)], peaks[2 * (k + AHEAD) + 1], reach);
        double pixel[2];
        if (!saddle_near(image.brightness, image.width, peaks[2 * k], peaks[2 * k + 1], max_step, pixel))
            continue;
        double *saddle = saddles + 2 * near++;
        saddle[0] = scale * pixel[0] + offset;
        saddle[1] = scale * pixel[1] + offset;
        if (!may_be_corner(image, rules, (float)pixel[0], (float)pixel[1], (float)radius, response[k]))
            continue;
        const int ring = read_ring(
            image, *rules, (float)pixel[0], (float)pixel[1], (float)radius, sqrt((double)response[k] / max_sharp),
            angles + 2 * corners, contrast + corners);
        smeared[corners] = ring == 2;
        pixels[2 * corners] = saddle[0];
        pixels[2 * corners + 1] = saddle[1];
        corners += ring != 0;
    }
    found[0] = near;
    found[1] = corners;
}

/* The same; set `repeated` for corners within `reach` of one of `known`. Return 0 if there is no memory. */
int64_t find_corners(
    const float *smooth, int64_t width, int64_t height, const int32_t *peaks, const float *response, int64_t count, double radius,
    double max_step, double max_sharp, const ring_rules_t *rules, double scale, double offset, const double *known,
    int64_t known_count, double reach, double *saddles, double *pixels, double *angles, double *contrast, uint8_t *smeared,
    uint8_t *repeated, int64_t *found)
{
    const image_t image = {smooth, width, height};
    read_peaks(
        image, peaks, response, count, radius, max_step, max_sharp, rules, scale, offset, saddles, pixels, angles, contrast,
        smeared, found);
    memset(repeated, 0, (size_t)found[1]);
    return known_count == 0 || mark_known(pixels, found[1], known, known_count, reach, repeated);
}

/* Mark those of `fresh` (count, 2) that are within `reach` of one of `known`. Return 0 if there is no memory. */
int64_t mark_known(const double *fresh, int64_t count, const double *known, int64_t known_count, double reach, uint8_t *mark)
{
    squares_t squares;
    int32_t *scratch = malloc((size_t)SQUARES_MEMORY(known_count) * sizeof(int32_t));
    if (!scratch)
        return 0;
    /* Squares of less than a pixel gain nothing, and sides must be positive. */
    fill_squares(known, known_count, reach > 1.0 ? reach : 1.0, scratch, &squares);
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
