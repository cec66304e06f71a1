/* The places of pixels on a chessboard, in squares from its first corner, with a cubic spline as its map to the image. Purpose and
 * constants are in rigkit.detection.subpixel.whole_board, checks against closed forms in tests/kernels/test_boards.py. */
#include "kernels.h"
#include "boards.h"

enum { TAPS = 4, NEWTON_STEPS = 8, LANES = 4, GROUPS = 16 };

/* Residual, px, from which a Newton step is the last: it ends within 1e-8 px. */
#define PLACED_PX 1e-3

/* Largest distance of a searched place from the centre of a square, squares, along each axis. */
#define BEYOND 1.5

/* The same for the place predicted from the pixel above, beyond which a pixel is not searched. */
#define NEAR_BY 0.75

/* Smallest area of a square, px^2, that a step divides by. */
#define MIN_SCALE 1e-9

/* Places outside a square by less than this, squares, are in it. */
#define SQUARE_SLACK 1e-9

/* Coefficients, by powers of the position between two nodes, of the four basis functions of a uniform cubic B-spline. */
static const double SPLINE[TAPS][TAPS] = {
    {1.0 / 6.0, -0.5, 0.5, -1.0 / 6.0}, {4.0 / 6.0, 0.0, -1.0, 0.5}, {1.0 / 6.0, 0.5, 0.5, -0.5}, {0.0, 0.0, 0.0, 1.0 / 6.0}};

/* The map of a square to u and v: coefficients by powers of y and of x, and those of its derivative by x. */
typedef struct {
    double value[2][TAPS][TAPS], slope[2][TAPS][TAPS - 1];
} square_t;

/* Set `out` to the square whose coefficients begin at `first`. */
INLINE void read_square(const double *first, int64_t stride, square_t *out)
{
    memset(out, 0, sizeof *out);
    for (int axis = 0; axis < 2; axis++) {
        double along[TAPS][TAPS] = {{0.0}};
        for (int j = 0; j < TAPS; j++)
            for (int i = 0; i < TAPS; i++)
                for (int power = 0; power < TAPS; power++)
                    along[j][power] += SPLINE[i][power] * first[2 * (j * stride + i) + axis];
        for (int j = 0; j < TAPS; j++)
            for (int down = 0; down < TAPS; down++)
                for (int power = 0; power < TAPS; power++)
                    out->value[axis][down][power] += SPLINE[j][down] * along[j][power];
        for (int down = 0; down < TAPS; down++)
            for (int power = 1; power < TAPS; power++)
                out->slope[axis][down][power - 1] = (double)power * out->value[axis][down][power];
    }
}

/* Set `at` to the pixel of (x, y) in the square, and `grow` to its derivatives; for numbers or vectors of them. */
#define SEEN_AT(square, x, y, at, grow) \
    _Pragma("GCC unroll 2") for (int axis = 0; axis < 2; axis++) \
    { \
        __typeof__(x) value[TAPS], slope[TAPS]; \
        _Pragma("GCC unroll 4") for (int down = 0; down < TAPS; down++) \
        { \
            const double *c = (square)->value[axis][down], *d = (square)->slope[axis][down]; \
            value[down] = c[0] + x * (c[1] + x * (c[2] + x * c[3])); \
            slope[down] = d[0] + x * (d[1] + x * d[2]); \
        } \
        at[axis] = value[0] + y * (value[1] + y * (value[2] + y * value[3])); \
        grow[axis][0] = slope[0] + y * (slope[1] + y * (slope[2] + y * slope[3])); \
        grow[axis][1] = value[1] + y * (2.0 * value[2] + y * (3.0 * value[3])); \
    }

typedef double lanes_t __attribute__((vector_size(8 * LANES)));
typedef int64_t mask_t __attribute__((vector_size(8 * LANES)));

/* Select `one` where `mask` is set, else `other`; clip x to -most ... most; the absolute value of x. Macros, as the calling
 * convention of functions of vectors depends on the instruction set. */
#define CHOSEN(mask, one, other) ((lanes_t)(((mask_t)(one) & (mask)) | ((mask_t)(other) & ~(mask))))
#define LIMIT(x, most) \
    x = CHOSEN(x > (most), (lanes_t){0.0} + (most), x); \
    x = CHOSEN(x < -(most), (lanes_t){0.0} - (most), x)
#define SIZE(x) CHOSEN((x) < 0.0, -(x), x)

/* Places in a square, their derivatives by v, the pixels (u, v) whose places are searched, and the residuals of their maps. */
typedef struct {
    lanes_t x, y, x_down, y_down, u, off;
    double v;
} found_t;

/* Move the places by a step of Newton's method. */
INLINE void step_places(const square_t *square, found_t *found)
{
    lanes_t at[2], grow[2][2];
    SEEN_AT(square, found->x, found->y, at, grow)
    const lanes_t off_u = found->u - at[0], off_v = found->v - at[1];
    lanes_t area = grow[0][0] * grow[1][1] - grow[0][1] * grow[1][0];
    area = CHOSEN(SIZE(area) < MIN_SCALE, (lanes_t){0.0} + MIN_SCALE, area);
    const lanes_t by_area = 1.0 / area;
    lanes_t x = (off_u * grow[1][1] - off_v * grow[0][1]) * by_area, y = (off_v * grow[0][0] - off_u * grow[1][0]) * by_area;
    LIMIT(x, 1.0);
    LIMIT(y, 1.0);
    x += found->x - 0.5;
    y += found->y - 0.5;
    /* Far outside its square the cubic is not that of the map. */
    LIMIT(x, BEYOND);
    LIMIT(y, BEYOND);
    found->x = 0.5 + x;
    found->y = 0.5 + y;
    found->x_down = -grow[0][1] * by_area;
    found->y_down = grow[0][0] * by_area;
    found->off = SIZE(off_u) + SIZE(off_v);
}

INLINE void find_places(const square_t *square, found_t *found)
{
    int open = 1;
    for (int turn = 0; turn < NEWTON_STEPS && open; turn++) {
        step_places(square, found);
        const lanes_t x = found->x - 0.5, y = found->y - 0.5;
        const mask_t inside = (found->off >= PLACED_PX) & (SIZE(x) < BEYOND) & (SIZE(y) < BEYOND);
        open = 0;
        for (int k = 0; k < LANES; k++)
            open |= inside[k] != 0;
    }
}

INLINE int in_square(const found_t *found, int k)
{
    const double x = found->x[k], y = found->y[k];
    return found->off[k] < PLACED_PX && fabs(x - 0.5) <= 0.5 + SQUARE_SLACK && fabs(y - 0.5) <= 0.5 + SQUARE_SLACK;
}

/* Set the `places` of those of `count` pixels of a row that are in the square at (column, row) and have no place yet. */
INLINE void fill_lanes(const square_t *square, found_t *found, double v, int64_t count, double column, double row, double *places)
{
    const lanes_t x = found->x - 0.5, y = found->y - 0.5;
    const mask_t near = ~(found->off < PLACED_PX) | ((SIZE(x) < NEAR_BY) & (SIZE(y) < NEAR_BY));
    int wanted = 0;
    for (int k = 0; k < count; k++)
        wanted |= near[k] && !isfinite(places[2 * k]);
    if (wanted) {
        found->v = v;
        find_places(square, found);
        for (int k = 0; k < count; k++)
            if (in_square(found, k) && !isfinite(places[2 * k])) {
                places[2 * k] = column + found->x[k];
                places[2 * k + 1] = row + found->y[k];
            }
    }
    /* The linear prediction for the pixels below. */
    found->x += found->x_down;
    found->y += found->y_down;
}

/* Set the `places` in the square at (column, row) of the pixels in a box of the image that have none yet. */
FOR_EACH_PROCESSOR
static void fill_box(
    const square_t *square, const int64_t box[4], int64_t left, int64_t top, int64_t width, double column, double row,
    double *places)
{
    /* Row by row, in the order of the memory. */
    for (int64_t start = box[0]; start <= box[2]; start += LANES * GROUPS) {
        const int64_t pixels = box[2] - start + 1 < LANES * GROUPS ? box[2] - start + 1 : LANES * GROUPS;
        found_t across[GROUPS] = {0};
        for (int64_t k = 0; k < pixels; k++) {
            found_t *found = across + k / LANES;
            found->x[k % LANES] = found->y[k % LANES] = 0.5;
            found->u[k % LANES] = (double)(start + left + k);
            found->off[k % LANES] = INFINITY;
        }
        for (int64_t v = box[1]; v <= box[3]; v++)
            for (int64_t first = 0; first < pixels; first += LANES)
                fill_lanes(
                    square, across + first / LANES, (double)(v + top), pixels - first < LANES ? pixels - first : LANES, column, row,
                    places + 2 * (v * width + start + first));
    }
}

void board_places(
    const double *coefficients, int64_t rows, int64_t columns, int64_t left, int64_t top, int64_t width, int64_t height,
    double around, double *places)
{
    const int64_t stride = columns + 2;
    for (int64_t k = 0; k < 2 * width * height; k++)
        places[k] = NAN;
    for (int64_t j = 0; j + 1 < rows; j++)
        for (int64_t i = 0; i + 1 < columns; i++) {
            square_t square;
            read_square(coefficients + 2 * (j * stride + i), stride, &square);
            double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
            for (int corner = 0; corner < 4; corner++) {
                double at[2], grow[2][2];
                double x = (double)(corner % 2), y = (double)(corner / 2);
                SEEN_AT(&square, x, y, at, grow)
                (void)grow;
                for (int axis = 0; axis < 2; axis++) {
                    low[axis] = at[axis] < low[axis] ? at[axis] : low[axis];
                    high[axis] = at[axis] > high[axis] ? at[axis] : high[axis];
                }
            }
            /* A margin for curved sides. */
            const double more_u = around * (high[0] - low[0]), more_v = around * (high[1] - low[1]);
            double from_u = ceil(low[0] - more_u) - (double)left, to_u = floor(high[0] + more_u) - (double)left;
            double from_v = ceil(low[1] - more_v) - (double)top, to_v = floor(high[1] + more_v) - (double)top;
            if (!(from_u <= (double)width && to_u >= 0.0 && from_v <= (double)height && to_v >= 0.0))
                continue;
            from_u = from_u > 0.0 ? from_u : 0.0;
            from_v = from_v > 0.0 ? from_v : 0.0;
            to_u = to_u < (double)(width - 1) ? to_u : (double)(width - 1);
            to_v = to_v < (double)(height - 1) ? to_v : (double)(height - 1);
            const int64_t box[4] = {(int64_t)from_u, (int64_t)from_v, (int64_t)to_u, (int64_t)to_v};
            fill_box(&square, box, left, top, width, (double)i, (double)j, places);
        }
}

void sheet_places(
    const double *places, int64_t width, int64_t height, const uint8_t *corners, int64_t rows, int64_t columns, const double *first,
    double each, const double *reach, float *on_sheet, truth_t *near)
{
    const int64_t area = width * height;
    for (int64_t k = 0; k < area; k++) {
        const double x = places[2 * k], y = places[2 * k + 1];
        near[k] = near[area + k] = 0;
        on_sheet[k] = on_sheet[area + k] = (float)(-2.0 * each);
        if (!isfinite(x))
            continue;
        on_sheet[k] = (float)((x - first[0]) * each - 0.5);
        on_sheet[area + k] = (float)((y - first[1]) * each - 0.5);
        const double column = nearest_line(x, columns), row = nearest_line(y, rows);
        const double off_x = fabs(x - column), off_y = fabs(y - row), off = off_x > off_y ? off_x : off_y;
        const uint8_t *corner = corners + (int64_t)row * columns + (int64_t)column;
        near[k] = corner[0] && off < reach[0];
        near[area + k] = corner[rows * columns] && off < reach[1];
    }
}
