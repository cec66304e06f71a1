/* The levels of the image pyramid in which saddles are searched: reduction and smoothing. The definitions in numpy are in
 * tests/kernels/reference/front.py. */
#include "front.h"

/* Set `out` (height / factor, width / factor) to the means of factor x factor pixels. `sums` (width) is scratch. */
FOR_EACH_PROCESSOR void shrink_floats(
    const float *restrict image, int64_t height, int64_t width, int64_t factor, float *restrict sums, float *restrict out)
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

/* Return the sum of two adjacent numbers of 16 bits, read as one of 32 bits: vectorised without permutations of lanes. */
INLINE uint32_t sum_of_two(const uint16_t *sums)
{
    uint32_t both;
    memcpy(&both, sums, sizeof both);
    return (both & UINT16_MAX) + (both >> 16);
}

/* The same for bytes. 16 bits hold sums of up to 257 rows, or of 16 x 16 pixels; so factor <= 257. `sums` (2 * width) is
 * scratch. */
FOR_EACH_PROCESSOR void shrink_bytes(
    const uint8_t *restrict image, int64_t height, int64_t width, int64_t factor, uint16_t *restrict sums, float *restrict out)
{
    enum { MAX_SUMMED = 16 };
    const int64_t rows = height / factor, columns = width / factor;
    const float share = 1.0f / (float)(factor * factor);
    for (int64_t row = 0; row < rows; row++) {
        const uint8_t *restrict from = image + row * factor * width;
        uint16_t *restrict across = sums, *restrict fewer = sums + width;
        int64_t left = factor, count = columns * factor;
        for (int64_t u = 0; u < count; u++)
            across[u] = from[u];
        for (int64_t k = 1; k < factor; k++)
            for (int64_t u = 0; u < count; u++)
                across[u] = (uint16_t)(across[u] + from[k * width + u]);
        for (; left > 2 && left % 2 == 0 && factor <= MAX_SUMMED; left /= 2) {
            count /= 2;
            for (int64_t u = 0; u < count; u++)
                fewer[u] = (uint16_t)sum_of_two(across + 2 * u);
            uint16_t *const other = across;
            across = fewer;
            fewer = other;
        }
        float *restrict to = out + row * columns;
        if (left == 2)
            for (int64_t u = 0; u < columns; u++)
                to[u] = share * (float)(int32_t)sum_of_two(across + 2 * u);
        else
            for (int64_t u = 0; u < columns; u++) {
                uint32_t sum = 0;
                for (int64_t k = 0; k < left; k++)
                    sum += across[left * u + k];
                to[u] = share * (float)sum;
            }
    }
}

/* Offsets of the rows from two above to two below row v, the border repeated. */
typedef struct {
    int64_t above2, above, here, below, below2;
} rows_t;

INLINE rows_t rows_around(int64_t v, int64_t height, int64_t width)
{
    return (rows_t){
        (v > 2 ? v - 2 : 0) * width, (v > 1 ? v - 1 : 0) * width, v * width, (v < height - 1 ? v + 1 : height - 1) * width,
        (v < height - 2 ? v + 2 : height - 1) * width};
}

/* Smooth with the kernel (outer, inner, centre, inner, outer) along both axes, the border repeated; `half` gets every second pixel
 * of every second row. `column` (width + 4) is scratch. */
static FOR_EACH_PROCESSOR void smooth_floats(
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
            to[u] = outer * (column[u] + column[u + 4]) + inner * (column[u + 1] + column[u + 3]) + centre * column[u + 2];
        if (v % 2 == 0)
            for (int64_t u = 0; u < half_width; u++)
                half[v / 2 * half_width + u] = to[2 * u];
    }
}

/* The same for bytes, with a kernel of small integers over `whole`: exact if whole^2 * 255 fits 16 bits. */
static FOR_EACH_PROCESSOR void smooth_bytes(
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
            middle[u] =
                (uint16_t)(outer * (uint16_t)(above2[u] + below2[u]) + inner * (uint16_t)(above[u] + below[u]) + centre * here[u]);
        column[0] = column[1] = middle[0];
        middle[width] = middle[width + 1] = middle[width - 1];
        float *restrict to = out + v * width;
        for (int64_t u = 0; u < width; u++)
            to[u] = share
                * (float)(uint16_t)(outer * (uint16_t)(column[u] + column[u + 4])
                                    + inner * (uint16_t)(column[u + 1] + column[u + 3]) + centre * column[u + 2]);
        if (v % 2 == 0)
            for (int64_t u = 0; u < half_width; u++)
                half[v / 2 * half_width + u] = to[2 * u];
    }
}

/* Set a level of the pyramid from `image`, the `half` of the previous one (reference.front.level): `smooth`, `half` for the next
 * level, and the thresholds, from every `step`-th pixel along both axes. */
void make_level(
    const void *image, int64_t bytes, int64_t width, int64_t height, int64_t step, const level_rules_t *rules, float *scratch,
    float *smooth, float *half, float *thresholds)
{
    const int64_t seen = ((height - 3) / step + 1) * ((width - 3) / step + 1);
    float *room = scratch + width + 4, typical[3];
    if (bytes)
        smooth_bytes(image, height, width, rules->kernel, (float)rules->whole, (uint16_t *)scratch, smooth, half);
    else
        smooth_floats(image, height, width, rules->kernel, scratch, smooth, half);
    typical_values(
        smooth, height, width, step, (int64_t)(rules->extreme * (double)seen), room, room + seen, room + 2 * seen, typical);
    double span = (double)typical[2] - (double)typical[1];
    span = (span > rules->min_span ? span : rules->min_span) / 200.0;
    const double contrast = span * span;
    const double noise = rules->noise_factor * (double)typical[0], most = rules->ceiling * contrast;
    fill_thresholds(
        smooth, height, width, (float)(rules->floor * contrast), (float)(noise < most ? noise : most), typical[1], typical[2],
        thresholds);
}
