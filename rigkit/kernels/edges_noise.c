/* The residuals of the fitted edge model, and the part of them that is noise: their differences under a point reflection at the
 * corner, since errors of the model are nearly symmetric. */
#include "edges.h"

/* Update the residuals, the last of the window's rows, for the last `step` of `parameters`, small enough for the linear model;
 * return the sum of their squares. */
FOR_EACH_PROCESSOR
double leave_residuals(window_t *window, const double *step, int parameters)
{
    lanes_t sums = {0.0f};
    for (int64_t start = 0; start < window->count; start += BLOCK) {
        block_row_t *restrict rows = rows_of(window, start);
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

/* Return the variance of the noise, from the differences between residuals and their point reflection at the corner, or -1 if few
 * pixels have a mirror image (reference.edges._noise). */
FOR_EACH_PROCESSOR
double unmirrored(const double *values, window_t *window, int parameters, const edge_rules_t *rules)
{
    /* NaN, from images with pixels that are not finite, fails too. */
    if (!(fabs(values[X]) <= rules->max_mirrored && fabs(values[Y]) <= rules->max_mirrored))
        return -1.0;
    /* The residuals as an image, and that image rotated by 180 degrees, so that mirrored pixels are read in the same order. */
    const int32_t across = (int32_t)window->across, middle = across / 2, radius = (int32_t)window->radius;
    float *square = window->square + middle * across + middle, *turned = window->turned + middle * across + middle;
    float *changes = window->change + middle * across + middle, *shown = window->paired + middle * across + middle;
    const double left = floor(2.0 * values[X]), top = floor(2.0 * values[Y]);
    const int32_t first = (int32_t)window->v[0], last = (int32_t)window->v[window->count - 1];
    /* The rows of `turned` that are written or read. */
    const int32_t low = -last < first - (int32_t)top - 1 ? -last : first - (int32_t)top - 1;
    const int32_t high = -first > last - (int32_t)top ? -first : last - (int32_t)top;
    memset(window->square + (middle + first) * across, 0xff, (size_t)((last - first + 1) * across) * sizeof(float)); /* NaN */
    memset(window->turned + (middle + low) * across, 0xff, (size_t)((high - low + 1) * across) * sizeof(float));
    for (int64_t start = 0; start < window->count; start += BLOCK) {
        const int64_t used = window->count - start < BLOCK ? window->count - start : BLOCK;
        const float *u = window->u + start, *v = window->v + start, *rest = rows_of(window, start)[parameters];
        for (int64_t i = 0; i < used; i++) {
            const int32_t at = (int32_t)v[i] * across + (int32_t)u[i];
            square[at] = turned[-at] = rest[i];
        }
    }
    const float right = (float)(2.0 * values[X] - left), below = (float)(2.0 * values[Y] - top);
    const float w00 = (1.0f - right) * (1.0f - below), w10 = right * (1.0f - below);
    const float w01 = (1.0f - right) * below, w11 = right * below;
    const lanes_t one = (lanes_t){0.0f} + 1.0f;
    lanes_t sums = {0.0f};
    mask_t pairs = {0};
    for (int32_t v = first; v <= last; v++) {
        const float *restrict here = square + v * across - radius;
        const float *restrict there = turned + (v - (int32_t)top) * across - (int32_t)left - radius;
        const float *restrict above = there - across;
        /* There are no pixels beyond the radius. */
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
    return count >= rules->min_mirrored ? sum / (double)count / spread : -1.0;
}

/* Set `out` to the sums over pairs of pixels, for each of LAGS lags, of the products of their mirrored differences, followed by the
 * numbers of pairs. Only the half of the window above `y` is used; the other half is its reflection
 * (reference.edges._lag_products). */
FOR_EACH_PROCESSOR
void lag_products(const window_t *window, double y, double *out)
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
        /* Within a row, lags to the left equal those to the right. */
        for (int k = up ? 0 : LAG; k < ACROSS_LAGS; k++, out++) {
            out[0] = out[LAGS] = 0.0;
            for (int lane = 0; lane < LANES; lane++) {
                out[0] += (double)sums[k][lane];
                out[LAGS] += (double)pairs[k][lane];
            }
        }
    }
}
