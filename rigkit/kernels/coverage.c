/* The pixels of an image that boards have covered. */
#include "kernels.h"

/* Determinant of the scatter matrix of a single row or column, relative to its squared trace, up to rounding. */
#define ONE_LINE 1e-9

/* Return the longer side of a square of a board in the image, px, from the affine map fitted to its corners. For a single row or
 * column the other side is zero, by the pseudo-inverse of rank one. */
static double longer_side(const int64_t *grid, const double *corners, int64_t count)
{
    double mean[4] = {0.0}, xx = 0.0, xy = 0.0, yy = 0.0, xu = 0.0, yu = 0.0, xv = 0.0, yv = 0.0;
    for (int64_t c = 0; c < count; c++)
        for (int64_t k = 0; k < 2; k++) {
            mean[k] += (double)grid[2 * c + k] / (double)count;
            mean[2 + k] += corners[2 * c + k] / (double)count;
        }
    for (int64_t c = 0; c < count; c++) {
        const double x = (double)grid[2 * c] - mean[0], y = (double)grid[2 * c + 1] - mean[1];
        const double u = corners[2 * c] - mean[2], v = corners[2 * c + 1] - mean[3];
        xx += x * x;
        xy += x * y;
        yy += y * y;
        xu += x * u;
        yu += y * u;
        xv += x * v;
        yv += y * v;
    }
    const double size = xx + yy;
    double whole = xx * yy - xy * xy;
    if (whole <= ONE_LINE * size * size) {
        const double other = xx;
        whole = size > 1.0 ? size * size : 1.0;
        xx = yy;
        yy = other;
        xy = -xy;
    }
    const double along = hypot(yy * xu - xy * yu, yy * xv - xy * yv), across = hypot(xx * yu - xy * xu, xx * yv - xy * xv);
    return (along > across ? along : across) / whole;
}

/* Set `covered` for the pixels within `squares` sides of a square of a corner of any view. */
EXPORT void cover_pixels(
    const int64_t *grid, const double *corners, int64_t count, const int64_t *counts, int64_t views, double squares,
    const double *pixels, int64_t asked, uint8_t *covered)
{
    (void)count;
    memset(covered, 0, (size_t)asked);
    for (int64_t view = 0, first = 0; view < views; first += counts[view++]) {
        const double *own = corners + 2 * first;
        const double reach = squares * longer_side(grid + 2 * first, own, counts[view]);
        double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
        for (int64_t c = 0; c < counts[view]; c++)
            for (int64_t k = 0; k < 2; k++) {
                low[k] = own[2 * c + k] < low[k] ? own[2 * c + k] : low[k];
                high[k] = own[2 * c + k] > high[k] ? own[2 * c + k] : high[k];
            }
        for (int64_t n = 0; n < asked; n++) {
            const double u = pixels[2 * n], v = pixels[2 * n + 1];
            if (covered[n] || !(u >= low[0] - reach && u <= high[0] + reach && v >= low[1] - reach && v <= high[1] + reach))
                continue;
            for (int64_t c = 0; c < counts[view] && !covered[n]; c++) {
                const double du = own[2 * c] - u, dv = own[2 * c + 1] - v;
                covered[n] = du * du + dv * dv <= reach * reach;
            }
        }
    }
}
