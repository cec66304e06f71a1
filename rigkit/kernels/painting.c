/* Printed rectangles, painted into the sub-samples of a tile of an image, and the reduction of these to pixels. The definitions in
 * numpy are in tests/kernels/reference/painting.py, their meaning in rigkit.synthetic.raycast.
 *
 * A cell is the area of a sub-sample. Seen along a coordinate of the plane it is the convolution of two boxes, the extents of its
 * sides along u and along v, so that the shares on both sides of an edge sum up to 1 for every direction of the edge. */
#include "places.h"

/* Return the share of a cell on the positive side of an edge minus 1/2, from the signed distance of its centre: the integral of a
 * trapezoid that rises over the narrow box, is constant, and falls over the narrow box. */
INLINE float beyond(float distance, float wide, float narrow)
{
    const float far = fabsf(distance), reach = 0.5f * (wide + narrow);
    float slope = far - 0.5f * (wide - narrow);
    slope = slope < 0.0f ? 0.0f : slope > narrow ? narrow : slope;
    const float share = far < reach ? (far - slope * slope / (2.0f * narrow)) / wide : 0.5f;
    return copysignf(share, distance);
}

/* Return the share of a cell between low and high. */
INLINE float inside(float place, float low, float high, float wide, float narrow)
{
    const float upper = high - place, lower = place - low;
    return beyond(upper < lower ? upper : lower, wide, narrow) + 0.5f;
}

/* Set `within` to the mean over a cell of the indicator of -1 <= place <= count, and return that of the wave within it, which is +1
 * on [0, 1) and changes its sign at every inner corner 0 .. count - 1. A cell is narrower than a square: it contains at most one
 * edge. */
INLINE float wave_of(float place, int64_t count, float wide, float narrow, float *within)
{
    *within = inside(place, -1.0f, (float)count, wide, narrow);
    /* Triangle wave: 0 at every corner, slope +-1 there, positive on [0, 1). */
    float wave = (place - 0.5f) * 0.5f;
    wave = fabsf(wave - rintf(wave)) * -2.0f + 0.5f;
    wave = beyond(wave, wide, narrow) * 2.0f;
    const float last = count % 2 ? 1.0f : -1.0f;
    return place<-0.5f ? -*within : place>(float) count - 0.5f ? last * *within : wave;
}

/* Paint sheet and squares into the sub-samples of pixel (row, column) of the box. */
INLINE void paint_pixel(
    float *restrict fine, int64_t stride, const places_t *places, const surface_t *surface, int64_t row, int64_t column)
{
    const int64_t per_pixel = places->per_pixel, columns = places->box.columns, pixel = row * (columns / per_pixel) + column;
    const float wide_x = places->wide[0][pixel], narrow_x = places->narrow[0][pixel];
    const float wide_y = places->wide[1][pixel], narrow_y = places->narrow[1][pixel];
    const float white = (float)surface->white, half = (float)(0.5 * (surface->black - surface->white));
    const float sign = surface->first_black ? 1.0f : -1.0f;
    for (int64_t v = row * per_pixel; v < (row + 1) * per_pixel; v++) {
        const float *x = places->axes[0] + v * columns, *y = places->axes[1] + v * columns;
        for (int64_t u = column * per_pixel; u < (column + 1) * per_pixel; u++) {
            const float share = inside(x[u], (float)surface->ends[0], (float)surface->ends[2], wide_x, narrow_x)
                * inside(y[u], (float)surface->ends[1], (float)surface->ends[3], wide_y, narrow_y);
            float value = fine[v * stride + u];
            value += share * (white - value);
            if (surface->columns) {
                float in_x, in_y;
                const float wave_x = wave_of(x[u], surface->columns, wide_x, narrow_x, &in_x);
                const float wave_y = wave_of(y[u], surface->rows, wide_y, narrow_y, &in_y);
                value += half * (sign * wave_x * wave_y + in_x * in_y);
            }
            fine[v * stride + u] = value;
        }
    }
}

/* Return whether no edge of the sheet or its squares along coordinate k crosses a cell of the pixel; then `within` is 1 on the
 * sheet and 0 outside, `wave` the wave of the squares, 0 beyond them. */
INLINE int is_even(
    const places_t *places, const surface_t *surface, int k, int64_t pixel, int64_t count, float *within, float *wave)
{
    const float reach = 0.5f * (places->wide[k][pixel] + places->narrow[k][pixel]);
    const float low = places->least[k][pixel] - reach, high = places->most[k][pixel] + reach;
    const float begin = (float)surface->ends[k], end = (float)surface->ends[2 + k];
    *wave = 0.0f;
    *within = 0.0f;
    if (high < begin || low > end)
        return 1;
    if (!(low > begin && high < end))
        return 0;
    *within = 1.0f;
    if (!count || high < -1.0f || low > (float)count)
        return 1;
    const float cell = floorf(low);
    if (!(low > -1.0f && high < (float)count && high < cell + 1.0f && low > cell))
        return 0;
    *wave = (int64_t)cell % 2 ? -1.0f : 1.0f;
    return 1;
}

/* Paint the rectangle and its squares into the box. */
INLINE void paint_sheet(float *fine, int64_t stride, const places_t *places, const surface_t *surface)
{
    const int64_t per_pixel = places->per_pixel, across = places->box.columns / per_pixel, down = places->box.rows / per_pixel;
    const float white = (float)surface->white, half = (float)(0.5 * (surface->black - surface->white));
    const float sign = surface->first_black ? 1.0f : -1.0f;
    for (int64_t row = 0; row < down; row++)
        for (int64_t column = 0; column < across; column++) {
            float in_x, in_y, wave_x, wave_y;
            const int64_t pixel = row * across + column;
            const int even_x = is_even(places, surface, 0, pixel, surface->columns, &in_x, &wave_x);
            const int even_y = is_even(places, surface, 1, pixel, surface->rows, &in_y, &wave_y);
            if ((even_x && in_x == 0.0f) || (even_y && in_y == 0.0f))
                continue;
            if (!(even_x && even_y)) {
                paint_pixel(fine, stride, places, surface, row, column);
                continue;
            }
            const float pattern = wave_x == 0.0f || wave_y == 0.0f ? 0.0f : half * (sign * wave_x * wave_y + 1.0f);
            for (int64_t v = row * per_pixel; v < (row + 1) * per_pixel; v++)
                for (int64_t u = column * per_pixel; u < (column + 1) * per_pixel; u++)
                    fine[v * stride + u] = white + pattern;
        }
}

/* Add `change` times the share of a rectangle in squares, (low x, low y, high x, high y), to the box. */
INLINE void add_rectangle(float *fine, int64_t stride, const places_t *places, const double ends[4], float change)
{
    const int64_t per_pixel = places->per_pixel, columns = places->box.columns, across = columns / per_pixel;
    const float low[2] = {(float)ends[0], (float)ends[1]}, high[2] = {(float)ends[2], (float)ends[3]};
    const int64_t pixels = across * (places->box.rows / per_pixel);
    for (int64_t pixel = 0; pixel < pixels; pixel++) {
        int near = 1;
        for (int k = 0; k < 2; k++) {
            const float reach = 0.5f * (places->wide[k][pixel] + places->narrow[k][pixel]);
            near &= places->most[k][pixel] > low[k] - reach && places->least[k][pixel] < high[k] + reach;
        }
        if (!near)
            continue;
        const int64_t row = pixel / across, column = pixel % across;
        for (int64_t v = row * per_pixel; v < (row + 1) * per_pixel; v++)
            for (int64_t u = column * per_pixel; u < (column + 1) * per_pixel; u++) {
                const float x = places->axes[0][v * columns + u], y = places->axes[1][v * columns + u];
                fine[v * stride + u] += change * inside(x, low[0], high[0], places->wide[0][pixel], places->narrow[0][pixel])
                    * inside(y, low[1], high[1], places->wide[1][pixel], places->narrow[1][pixel]);
            }
    }
}

/* Set the range of x and y over the cells of the box. */
static void set_range(const places_t *places, float low[2], float high[2])
{
    const int64_t pixels = places->box.columns / places->per_pixel * (places->box.rows / places->per_pixel);
    for (int k = 0; k < 2; k++) {
        low[k] = INFINITY, high[k] = -INFINITY;
        for (int64_t pixel = 0; pixel < pixels; pixel++) {
            const float reach = 0.5f * (places->wide[k][pixel] + places->narrow[k][pixel]);
            low[k] = places->least[k][pixel] - reach < low[k] ? places->least[k][pixel] - reach : low[k];
            high[k] = places->most[k][pixel] + reach > high[k] ? places->most[k][pixel] + reach : high[k];
        }
    }
}

/* Paint the black marks, which may touch but do not overlap. */
INLINE void paint_marks(float *fine, int64_t stride, const places_t *places, const surface_t *surface)
{
    float low[2], high[2];
    set_range(places, low, high);
    for (int64_t n = 0; n < surface->mark_count; n++) {
        const double *mark = surface->marks + 4 * n;
        const double ends[4] = {mark[0], mark[1], mark[0] + mark[2], mark[1] + mark[3]};
        if (ends[2] > low[0] && ends[0] < high[0] && ends[3] > low[1] && ends[1] < high[1])
            add_rectangle(fine, stride, places, ends, (float)(surface->black - surface->white));
    }
}

/* Return the change of a coordinate from one sub-sample to the next, mm, clipped to MAX_CELL squares. */
INLINE float side_of(const float *value, int64_t k, int64_t count, int64_t stride, float square_mm)
{
    const float slope = k == 0 ? value[stride] - value[0]
        : k == count - 1       ? value[0] - value[-stride]
                               : 0.5f * (value[stride] - value[-stride]);
    return (slope < -MAX_CELL ? -MAX_CELL : slope > MAX_CELL ? MAX_CELL : slope) * square_mm;
}

/* Return the share of a sub-sample's cell inside a disc (x, y, radius in mm), with its edge approximated by its tangent. */
INLINE float share_of_disc(const places_t *places, const surface_t *surface, const double *disc, int64_t v, int64_t u)
{
    const int64_t columns = places->box.columns, rows = places->box.rows;
    const float scale[2] = {(float)surface->width_mm, (float)surface->height_mm};
    float off[2], down[2], across[2];
    for (int k = 0; k < 2; k++) {
        const float *at = places->axes[k] + v * columns + u;
        off[k] = *at * scale[k] - (float)disc[k];
        down[k] = side_of(at, v, rows, columns, scale[k]);
        across[k] = side_of(at, u, columns, 1, scale[k]);
    }
    float distance = sqrtf(off[0] * off[0] + off[1] * off[1]);
    distance = distance > 1e-9f ? distance : 1e-9f;
    float one = fabsf((off[0] * down[0] + off[1] * down[1]) / distance);
    float other = fabsf((off[0] * across[0] + off[1] * across[1]) / distance);
    one = one > MIN_CELL ? one : MIN_CELL;
    other = other > MIN_CELL ? other : MIN_CELL;
    return beyond((float)disc[2] - distance, one > other ? one : other, one > other ? other : one) + 0.5f;
}

/* Paint the discs, which do not overlap, on their ground. `covered` is scratch for the shares of the box's sub-samples. */
INLINE void paint_discs(float *fine, int64_t stride, const places_t *places, const surface_t *surface, float *covered)
{
    const int64_t per_pixel = places->per_pixel, columns = places->box.columns, rows = places->box.rows;
    const int64_t across = columns / per_pixel, pixels = across * (rows / per_pixel);
    const double scale[2] = {surface->width_mm, surface->height_mm};
    float change = (float)(surface->black - surface->white), low[2], high[2];
    for (int64_t k = 0; k < surface->grounds; k++) {
        add_rectangle(fine, stride, places, surface->ground + 4 * k, change);
        change = -change;
    }
    memset(covered, 0, sizeof(float) * (size_t)(rows * columns));
    set_range(places, low, high);
    for (int64_t n = 0; n < surface->disc_count; n++) {
        const double *disc = surface->discs + 3 * n;
        double begin[2], end[2];
        int seen = 1;
        for (int k = 0; k < 2; k++) {
            begin[k] = (disc[k] - disc[2]) / scale[k], end[k] = (disc[k] + disc[2]) / scale[k];
            seen &= end[k] > low[k] && begin[k] < high[k];
        }
        for (int64_t pixel = 0; seen && pixel < pixels; pixel++) {
            double reach_mm = 0.0;
            int near = 1;
            /* An upper bound of a cell's extent towards the disc: the sum of those along x and y. */
            for (int k = 0; k < 2; k++)
                reach_mm += scale[k] * (double)(places->wide[k][pixel] + places->narrow[k][pixel]);
            for (int k = 0; k < 2; k++) {
                const double reach = reach_mm / scale[k];
                near &= places->most[k][pixel] > begin[k] - reach && places->least[k][pixel] < end[k] + reach;
            }
            if (!near)
                continue;
            const int64_t row = pixel / across, column = pixel % across;
            for (int64_t v = row * per_pixel; v < (row + 1) * per_pixel; v++)
                for (int64_t u = column * per_pixel; u < (column + 1) * per_pixel; u++) {
                    const float share = share_of_disc(places, surface, disc, v, u);
                    float *most = covered + v * columns + u;
                    *most = share > *most ? share : *most;
                }
        }
    }
    for (int64_t v = 0; v < rows; v++)
        for (int64_t u = 0; u < columns; u++)
            fine[v * stride + u] += change * covered[v * columns + u];
}

/* Paint a rectangle with its pattern into the sub-samples of a tile; return 0 if there is no memory, else 1. */
EXPORT FOR_EACH_PROCESSOR int64_t paint_surface(float *fine, const tile_t *tile, const surface_t *surface)
{
    const int64_t per_pixel = tile->per_pixel, height = tile->rows / per_pixel, width = tile->columns / per_pixel;
    const int64_t pixels = height * width, samples = tile->rows * tile->columns;
    double *memory =
        malloc(sizeof(double) * (size_t)(2 * pixels + 3 * tile->columns) + sizeof(float) * (size_t)(8 * pixels + 3 * samples));
    if (!memory)
        return 0;
    double *coarse = memory, *rows = memory + 2 * pixels, values[3][TILE_NODES * TILE_NODES];
    const double *matrix = surface->plane_from_ray;
    const int terms = tile->ray_rows ? 3 : set_node_values(tile, matrix, values);
    for (int64_t v = 0; v < height; v++)
        set_row(
            tile, matrix, values, terms, v * per_pixel, 0, per_pixel, width, coarse + v * width, coarse + pixels + v * width, rows);
    places_t places = {.per_pixel = per_pixel};
    if (set_box(coarse, height, width, surface, per_pixel, &places.box)) {
        float *room = (float *)(rows + 3 * tile->columns);
        for (int k = 0; k < 2; k++) {
            places.wide[k] = room + (4 * k) * pixels, places.narrow[k] = room + (4 * k + 1) * pixels;
            places.least[k] = room + (4 * k + 2) * pixels, places.most[k] = room + (4 * k + 3) * pixels;
            places.axes[k] = room + 8 * pixels + k * samples;
        }
        set_cells(coarse, height, width, &places);
        set_axes(tile, matrix, &places, rows);
        float *target = fine + places.box.top * tile->columns + places.box.left;
        paint_sheet(target, tile->columns, &places, surface);
        if (surface->mark_count)
            paint_marks(target, tile->columns, &places, surface);
        if (surface->disc_count)
            paint_discs(target, tile->columns, &places, surface, room + 8 * pixels + 2 * samples);
    }
    free(memory);
    return 1;
}

/* Return whether the rectangle covers the tile: NOT_COVERED, COVERED_WHOLLY, or COVERED_PARTLY also where this is uncertain. */
EXPORT int64_t tile_cover(const tile_t *tile, const surface_t *surface)
{
    if (tile->ray_rows)
        return COVERED_PARTLY;
    double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
    int in_front = 0;
    for (int n = 0; n < TILE_NODES * TILE_NODES; n++) {
        const double *ray = tile->nodes + 3 * n, *matrix = surface->plane_from_ray;
        const double depth = matrix[6] * ray[0] + matrix[7] * ray[1] + matrix[8] * ray[2];
        if (!(depth > MIN_DEPTH))
            continue;
        in_front++;
        for (int k = 0; k < 2; k++) {
            const double place = (matrix[3 * k] * ray[0] + matrix[3 * k + 1] * ray[1] + matrix[3 * k + 2] * ray[2]) / depth;
            low[k] = place < low[k] ? place : low[k];
            high[k] = place > high[k] ? place : high[k];
        }
    }
    if (in_front < TILE_NODES * TILE_NODES)
        return in_front ? COVERED_PARTLY : NOT_COVERED;
    int wholly = 1;
    for (int k = 0; k < 2; k++) {
        /* The nodes do not reach the tile's border; half their range is a generous margin. */
        const double pad = 0.5 * (high[k] - low[k]), begin = surface->ends[k], end = surface->ends[2 + k];
        if (!(high[k] + pad >= begin && low[k] - pad <= end))
            return NOT_COVERED;
        wholly &= low[k] - pad >= begin && high[k] + pad <= end;
    }
    return wholly ? COVERED_WHOLLY : COVERED_PARTLY;
}

/* Reduce sub-samples to pixels by the same `kernel` along both axes. */
EXPORT FOR_EACH_PROCESSOR void reduce_tile(
    const float *fine, int64_t rows, int64_t columns, const float *kernel, int64_t length, int64_t per_pixel, float *memory,
    float *out, int64_t height, int64_t width)
{
    (void)rows;
    for (int64_t v = 0; v < height; v++) {
        memset(memory, 0, sizeof(float) * (size_t)columns);
        for (int64_t k = 0; k < length; k++) {
            const float *row = fine + (v * per_pixel + k) * columns;
            for (int64_t u = 0; u < columns; u++)
                memory[u] += kernel[k] * row[u];
        }
        for (int64_t u = 0; u < width; u++) {
            float sum = 0.0f;
#pragma omp simd reduction(+ : sum)
            for (int64_t k = 0; k < length; k++)
                sum += kernel[k] * memory[u * per_pixel + k];
            out[v * width + u] = sum;
        }
    }
}
