/* The brightness of the modules of tags, and the codes with the largest correlation. The definitions in numpy are in
 * tests/kernels/reference/surface.py, the numbers in rigkit.detection.tags.codes. */
#include "kernels.h"

/* Set `h` to the homography of the unit square, corners (0, 0) (1, 0) (1, 1) (0, 1), to the four corners of `quad` (Heckbert,
 * Fundamentals of Texture Mapping and Image Warping, 1989, section 2.2.3). */
INLINE void map_of_quad(const double quad[8], double h[9])
{
    double total[2], one[2], two[2];
    for (int64_t k = 0; k < 2; k++) {
        total[k] = quad[k] - quad[2 + k] + quad[4 + k] - quad[6 + k];
        one[k] = quad[2 + k] - quad[4 + k];
        two[k] = quad[6 + k] - quad[4 + k];
    }
    const double crossed = one[0] * two[1] - one[1] * two[0], area = fabs(crossed) < 1e-12 ? 1e-12 : crossed;
    h[6] = (total[0] * two[1] - total[1] * two[0]) / area;
    h[7] = (one[0] * total[1] - one[1] * total[0]) / area;
    h[8] = 1.0;
    for (int64_t k = 0; k < 2; k++) {
        h[3 * k] = quad[2 + k] - quad[k] + h[6] * quad[2 + k];
        h[3 * k + 1] = quad[6 + k] - quad[k] + h[7] * quad[6 + k];
        h[3 * k + 2] = quad[k];
    }
}

void maps_of_quads(const double *quads, int64_t count, double *out)
{
    for (int64_t n = 0; n < count; n++)
        map_of_quad(quads + 8 * n, out + 9 * n);
}

/* Set `bright` to the brightness of the modules of a tag, of mean 0 and length 1; return its standard deviation before. */
INLINE double read_tag(
    const void *grey, int64_t bytes, int64_t width, int64_t height, const double *quad, int64_t side, double *bright)
{
    const int64_t modules = side * side;
    double h[9], mean = 0.0, square = 0.0;
    map_of_quad(quad, h);
    for (int64_t row = 0; row < side; row++)
        for (int64_t column = 0; column < side; column++) {
            const double x = ((double)column + 0.5) / (double)side, y = ((double)row + 0.5) / (double)side;
            const double per_depth = 1.0 / (h[6] * x + h[7] * y + h[8]);
            const double u = (h[0] * x + h[1] * y + h[2]) * per_depth, v = (h[3] * x + h[4] * y + h[5]) * per_depth;
            const double level = grey_level_at(grey, bytes, width, height, u, v);
            bright[row * side + column] = level;
            mean += level;
        }
    mean /= (double)modules;
    for (int64_t k = 0; k < modules; k++) {
        bright[k] -= mean;
        square += bright[k] * bright[k];
    }
    const double scale = square > 1e-18 ? 1.0 / sqrt(square) : 0.0;
    for (int64_t k = 0; k < modules; k++)
        bright[k] *= scale;
    return sqrt(square / (double)modules);
}

FOR_EACH_PROCESSOR void read_modules(
    const void *grey, int64_t bytes, int64_t width, int64_t height, const double *quads, int64_t count, int64_t side,
    double *bright, double *spread)
{
    for (int64_t n = 0; n < count; n++)
        spread[n] = read_tag(grey, bytes, width, height, quads + 8 * n, side, bright + side * side * n);
}

/* Set `best` to the code with the largest correlation with each tag, the first of several, and `likeness` to that correlation;
 * both 0 where the standard deviation of the modules is below `min_contrast`. `bright` (count, side, side) is scratch. */
FOR_EACH_PROCESSOR void read_codes(
    const void *grey, int64_t bytes, int64_t width, int64_t height, const double *quads, int64_t count, int64_t side,
    const double *patterns, int64_t codes, double min_contrast, double *bright, int64_t *best, double *likeness)
{
    const int64_t modules = side * side, last = codes - 1;
    for (int64_t n = 0; n < count; n++) {
        /* -1 for tags that no code is compared with. */
        best[n] = read_tag(grey, bytes, width, height, quads + 8 * n, side, bright + modules * n) >= min_contrast ? 0 : -1;
        likeness[n] = best[n] < 0 ? 0.0 : -INFINITY;
    }
    /* Four codes at once, whose sums are independent, for all tags: the codes of a board do not fit the first-level cache. */
    for (int64_t c = 0; c < codes; c += 4) {
        const double *one = patterns + modules * c, *two = patterns + modules * (c + 1 < last ? c + 1 : last);
        const double *three = patterns + modules * (c + 2 < last ? c + 2 : last);
        const double *four = patterns + modules * (c + 3 < last ? c + 3 : last);
        for (int64_t n = 0; n < count; n++) {
            const double *own = bright + modules * n;
            double sum1 = 0.0, sum2 = 0.0, sum3 = 0.0, sum4 = 0.0;
            if (best[n] < 0)
                continue;
#pragma omp simd reduction(+ : sum1, sum2, sum3, sum4)
            for (int64_t k = 0; k < modules; k++) {
                sum1 += own[k] * one[k];
                sum2 += own[k] * two[k];
                sum3 += own[k] * three[k];
                sum4 += own[k] * four[k];
            }
            const double sums[4] = {sum1, sum2, sum3, sum4};
            for (int64_t k = 0; k < 4 && c + k < codes; k++)
                if (sums[k] > likeness[n]) {
                    best[n] = c + k;
                    likeness[n] = sums[k];
                }
        }
    }
    for (int64_t n = 0; n < count; n++)
        best[n] = best[n] < 0 ? 0 : best[n];
}
