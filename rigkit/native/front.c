/* From an image to linked corners: smoothing, saddle response and its peaks, ring tests, links.
 *
 * The definitions are in rigkit.corners.response, .saddle, .ring and .links; the numbers come from there. */
#include "kernels.h"

/* Pixels that the tests of a row are made for at a time: the results stay in registers and the first cache. */
enum { STRIP = 64 };

/* The means of factor x factor pixels: out (height / factor, width / factor). `sums` (width) is scratch. */
void shrink_floats(const float *image, int64_t height, int64_t width, int64_t factor, float *sums, float *out);
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
void shrink_bytes(const uint8_t *image, int64_t height, int64_t width, int64_t factor, uint16_t *sums, float *out);
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
void smooth_floats(
    const float *image, int64_t height, int64_t width, const float *kernel, float *column, float *out, float *half);
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
void smooth_bytes(
    const uint8_t *image, int64_t height, int64_t width, const float *kernel, float whole, uint16_t *column, float *out,
    float *half);
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

/* |response| and brightness at every step-th inner pixel of every step-th inner row, row by row. */
void typical_values(
    const float *smooth, int64_t height, int64_t width, int64_t step, float *response, float *brightness);
void typical_values(
    const float *smooth, int64_t height, int64_t width, int64_t step, float *response, float *brightness)
{
    for (int64_t v = 1; v < height - 1; v += step)
        for (int64_t u = 1; u < width - 1; u += step) {
            const float *at = smooth + v * width + u;
            *response++ = fabsf(saddle_response(at, width));
            *brightness++ = *at;
        }
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

/* corners.response.peaks: (u, v) and response of the peaks, row by row; returns how many. There is at most one peak in
 * 3x3 pixels. `scratch` holds 5 * (width + STRIP + 4) floats, `high` 5 * (width / STRIP + 1) bytes. */
int64_t find_peaks(
    const float *smooth, int64_t height, int64_t width, float threshold, float *scratch, uint8_t *high, int32_t *at,
    float *response);
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

/* corners.saddle.saddle_step for one pixel; whether it is a saddle and near. */
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

/* The corners of one level among `count` peaks of `response`: `saddles` (count, 2) gets those with a saddle nearby,
 * `which`, `angles` (count, 2) and `contrast` those of them that are corners: their ring is valid and they are no sharper
 * than `most_sharp`. Returns the number of saddles and, in `found`, of corners. */
int64_t find_corners(
    image_t image, const ring_rules_t *rules, double radius, double most_step, double most_sharp, const int32_t *peaks,
    const float *response, int64_t count, double *saddles, int64_t *which, double *angles, double *contrast,
    int64_t *found);
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
        if (read_ring(image, *rules, (float)pixel[0], (float)pixel[1], (float)radius, angles + 2 * corners,
                      contrast + corners) &&
            response[k] <= most_sharp * contrast[corners] * contrast[corners])
            which[corners++] = near - 1;
    }
    *found = corners;
    return near;
}

/* Points in square buckets: those of bucket b are order[first[b]] to order[first[b + 1] - 1]. */
typedef struct {
    const double *points;
    int32_t *first, *order;
    int64_t columns, rows;
    double left, top, side;
} squares_t;

/* Smaller squares leave more of them to look into, larger ones more points that are too far. */
static const double SQUARES_A_POINT = 0.5;

INLINE int64_t square_at(double position, double least, double side, int64_t count)
{
    const double place = (position - least) / side;
    return place > 0.0 ? (place < (double)count ? (int64_t)place : count - 1) : 0;
}

/* Sort `count` > 0 points into squares of at least `side`. Returns 0 without memory. */
static int fill_squares(const double *points, int64_t count, double side, squares_t *out)
{
    double left = points[0], right = left, top = points[1], bottom = top;
    for (int64_t i = 1; i < count; i++) {
        const double u = points[2 * i], v = points[2 * i + 1];
        left = u < left ? u : left;
        right = u > right ? u : right;
        top = v < top ? v : top;
        bottom = v > bottom ? v : bottom;
    }
    const double most = SQUARES_A_POINT * (double)count + 8.0;
    while (((right - left) / side + 1.0) * ((bottom - top) / side + 1.0) > most)
        side *= 1.4;
    const squares_t squares = {points, NULL, NULL, (int64_t)((right - left) / side) + 1,
                               (int64_t)((bottom - top) / side) + 1, left, top, side};
    const int64_t size = squares.columns * squares.rows;
    *out = squares;
    out->first = calloc((size_t)(size + 1 + count), sizeof(int32_t));
    if (!out->first)
        return 0;
    out->order = out->first + size + 1;
    for (int pass = 0; pass < 2; pass++) {
        for (int64_t i = count - 1; i >= 0; i--) {
            const int64_t at = square_at(points[2 * i + 1], top, side, squares.rows) * squares.columns +
                               square_at(points[2 * i], left, side, squares.columns);
            if (pass == 0)
                out->first[at]++;
            else
                out->order[--out->first[at]] = (int32_t)i;
        }
        /* After the first pass the end of each square; the second moves it to its start. */
        for (int64_t b = 1; pass == 0 && b <= size; b++)
            out->first[b] += out->first[b - 1];
    }
    return 1;
}

/* Mark those of `fresh` (count, 2) that lie within `reach` of one of `known`. Returns 0 without memory. */
int64_t mark_known(
    const double *fresh, int64_t count, const double *known, int64_t known_count, double reach, uint8_t *mark);
int64_t mark_known(
    const double *fresh, int64_t count, const double *known, int64_t known_count, double reach, uint8_t *mark)
{
    squares_t squares;
    if (!fill_squares(known, known_count, reach, &squares))
        return 0;
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
    free(squares.first);
    return 1;
}

/* The constants of corners.links. */
typedef struct {
    int64_t neighbours, places, most;
    const double *along;
    double arm_cosine, contrast_ratio, length_ratio, aside, least_aside;
} link_rules_t;

/* The corners and the level that their edges are read from. */
typedef struct {
    const double *pixels, *lines, *contrast, *least, *most, *reach;
    int64_t count;
} corners_t;

/* A corner that may be the neighbour along an arm. */
typedef struct {
    float square;
    int64_t arm, end, back;
} candidate_t;

/* A corner in the order of the squares: what the search reads lies side by side. */
typedef struct {
    double u, v;
    float lines[4], contrast;
    int32_t corner;
} place_t;

/* The corners around one: square of the distance, chord, both lines' unit vectors, contrast, index; and the test. */
enum { SQUARE, CHORD_U, CHORD_V, A_U, A_V, B_U, B_V, CONTRAST, COLUMNS };
typedef struct {
    float *columns[COLUMNS];
    int32_t *corner, *meets;
} near_t;

/* Collect the corners around `home` whose contrast lies within the bounds: at least the `wanted` nearest. Returns how
 * many. */
INLINE int64_t gather(
    const squares_t *squares, const place_t *places, const place_t *home, float least, float most, int64_t wanted,
    const near_t *near)
{
    const double u = home->u, v = home->v, side = squares->side;
    const int64_t column = square_at(u, squares->left, side, squares->columns);
    const int64_t row = square_at(v, squares->top, side, squares->rows);
    const double in_u = u - squares->left - (double)column * side, in_v = v - squares->top - (double)row * side;
    double inner = in_u < in_v ? in_u : in_v;
    inner = side - in_u < inner ? side - in_u : inner;
    inner = side - in_v < inner ? side - in_v : inner;
    int64_t count = 0;
    for (int64_t ring = 0;; ring++) {
        const int64_t left = column - ring, right = column + ring, top = row - ring, bottom = row + ring;
        for (int64_t r = top > 0 ? top : 0; r <= bottom && r < squares->rows; r++) {
            const int32_t *first = squares->first + r * squares->columns;
            /* Whole rows above and below, the two ends of the others. */
            const int whole = r == top || r == bottom;
            for (int part = 0; part < (whole || ring == 0 ? 1 : 2); part++) {
                int64_t from = part == 0 ? left : right, to = whole ? right : from;
                if (to < 0 || from >= squares->columns)
                    continue;
                from = from > 0 ? from : 0;
                to = to < squares->columns ? to : squares->columns - 1;
                for (const place_t *place = places + first[from]; place < places + first[to + 1]; place++) {
                    const float du = (float)(place->u - u), dv = (float)(place->v - v);
                    near->columns[SQUARE][count] = du * du + dv * dv;
                    near->columns[CHORD_U][count] = du;
                    near->columns[CHORD_V][count] = dv;
                    for (int k = 0; k < 4; k++)
                        near->columns[A_U + k][count] = place->lines[k];
                    near->columns[CONTRAST][count] = place->contrast;
                    near->corner[count] = place->corner;
                    count += (place->contrast > least) & (place->contrast < most);
                }
            }
        }
        if (left <= 0 && top <= 0 && right >= squares->columns - 1 && bottom >= squares->rows - 1)
            return count;
        if (count < wanted)
            continue;
        /* All corners within `safe` are among them by now. */
        const float safe = (float)((inner + (double)ring * side) * (inner + (double)ring * side));
        int32_t within = 0;
        for (int64_t k = 0; k < count; k++)
            within += near->columns[SQUARE][k] <= safe;
        if (within >= wanted)
            return count;
    }
}

/* Mark which of the corners around `home` are like it in contrast and point an arm of the other kind at it, as it does. */
INLINE void mark_facing(const place_t *home, const link_rules_t *rules, const near_t *near, int64_t count)
{
    const float ratio = (float)rules->contrast_ratio, contrast = home->contrast;
    const float cosine = (float)(rules->arm_cosine * rules->arm_cosine);
    const float mine_a_u = home->lines[0], mine_a_v = home->lines[1];
    const float mine_b_u = home->lines[2], mine_b_v = home->lines[3];
    const float *restrict square = near->columns[SQUARE], *restrict theirs = near->columns[CONTRAST];
    const float *restrict u = near->columns[CHORD_U], *restrict v = near->columns[CHORD_V];
    const float *restrict a_u = near->columns[A_U], *restrict a_v = near->columns[A_V];
    const float *restrict b_u = near->columns[B_U], *restrict b_v = near->columns[B_V];
    int32_t *restrict meets = near->meets;
    for (int64_t k = 0; k < count; k++) {
        const float a = u[k] * mine_a_u + v[k] * mine_a_v, b = u[k] * mine_b_u + v[k] * mine_b_v;
        const float home_a = u[k] * a_u[k] + v[k] * a_v[k], home_b = u[k] * b_u[k] + v[k] * b_v[k];
        const float along = a * a > b * b ? a * a : b * b;
        const float back = home_a * home_a > home_b * home_b ? home_a * home_a : home_b * home_b;
        meets[k] = (along > cosine * square[k]) & (back > cosine * square[k]) &
                   ((b * b > a * a) != (home_b * home_b > home_a * home_a)) & (contrast > ratio * theirs[k]) &
                   (theirs[k] > ratio * contrast);
    }
}

/* The arm (A, B, -A, -B) that points most along the chord. */
INLINE int64_t arm_along(double a, double b)
{
    return fabs(b) > fabs(a) ? (b < 0.0 ? 3 : 1) : (a < 0.0 ? 2 : 0);
}

/* Whether the edge from corner i is there (corners.links._edge_seen). */
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
    return edge_seen(image, rules->along, rules->places, u, v, end_u, end_v, link->arm % 2 ? -1.0 : 1.0, aside,
                     weakest) >= rules->most;
}

/* The nearest corner along each of the four arms of `home` whose edge is seen: to[arm] = 4 * corner + arm, or -1. */
INLINE void link_arms(
    const corners_t *corners, const squares_t *squares, const place_t *places, const place_t *home, const image_t image,
    double scale, double offset, const link_rules_t *rules, const near_t *near, int64_t *to)
{
    enum { MOST_CANDIDATES = 512 };
    candidate_t candidates[MOST_CANDIDATES];
    const int64_t i = home->corner, wanted = rules->neighbours + 1;
    const int64_t count =
        gather(squares, places, home, (float)corners->least[i], (float)corners->most[i], wanted, near);
    mark_facing(home, rules, near, count);
    int64_t listed = 0;
    for (int64_t k = 0; k < count && listed < MOST_CANDIDATES; k++) {
        if (!near->meets[k])
            continue;
        const float square = near->columns[SQUARE][k], u = near->columns[CHORD_U][k], v = near->columns[CHORD_V][k];
        int32_t nearer = 0;
        for (int64_t n = 0; n < count; n++)
            nearer += near->columns[SQUARE][n] < square;
        if (nearer >= wanted)
            continue;
        const candidate_t fresh = {
            square, arm_along(u * home->lines[0] + v * home->lines[1], u * home->lines[2] + v * home->lines[3]),
            near->corner[k],
            arm_along(-(u * near->columns[A_U][k] + v * near->columns[A_V][k]),
                      -(u * near->columns[B_U][k] + v * near->columns[B_V][k]))};
        int64_t at = listed++;
        for (; at > 0 && candidates[at - 1].square > square; at--)
            candidates[at] = candidates[at - 1];
        candidates[at] = fresh;
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

/* corners.links.find_links: both[4 * i + arm] = 4 * neighbour + its arm, -1 for none. Of the corners, `lines` (count, 4)
 * are the unit vectors of A and B, `least` and `most` bound the contrast of those looked at, `reach` is the most `aside`.
 * `nearest` (count, 4) is scratch. Returns 0 without memory. */
int64_t find_links(
    const corners_t *corners, image_t image, double scale, double offset, const link_rules_t *rules, int64_t *nearest,
    int64_t *both);
FOR_EACH_PROCESSOR int64_t find_links(
    const corners_t *corners, image_t image, double scale, double offset, const link_rules_t *rules, int64_t *nearest,
    int64_t *both)
{
    const int64_t count = corners->count;
    squares_t squares;
    if (!fill_squares(corners->pixels, count, 1.0, &squares))
        return 0;
    place_t *places = malloc((size_t)count * (sizeof(place_t) + COLUMNS * sizeof(float) + 2 * sizeof(int32_t)));
    if (!places) {
        free(squares.first);
        return 0;
    }
    near_t near;
    for (int k = 0; k < COLUMNS; k++)
        near.columns[k] = (float *)(places + count) + k * count;
    near.corner = (int32_t *)(near.columns[COLUMNS - 1] + count);
    near.meets = near.corner + count;
    for (int64_t k = 0; k < count; k++) {
        const int32_t i = squares.order[k];
        const double *line = corners->lines + 4 * i;
        const place_t place = {corners->pixels[2 * i], corners->pixels[2 * i + 1],
                               {(float)line[0], (float)line[1], (float)line[2], (float)line[3]},
                               (float)corners->contrast[i], i};
        places[k] = place;
    }
    for (int64_t k = 0; k < 4 * count; k++)
        nearest[k] = both[k] = -1;
    /* In the order of the squares: neighbours look at the same corners and pixels. */
    for (int64_t k = 0; k < count; k++)
        link_arms(corners, &squares, places, places + k, image, scale, offset, rules, &near,
                  nearest + 4 * (int64_t)places[k].corner);
    free(places);
    free(squares.first);
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
