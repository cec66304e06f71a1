/* The picture of a whole chessboard, and how it changes as its places move. What it is for and the numbers are in
 * rigkit.detection.subpixel.whole_board, checks against closed forms in tests/kernels/test_boards.py.
 *
 * Places on the board, in squares from its first corner, are a cubic spline of the board's corners. The picture is drawn
 * sharp, by the distances to the lines that are near, and blurred as a picture; so are its changes. */
#include "kernels.h"

enum { TAPS = 4, ORDERS = 4, NEWTON_STEPS = 8 };

/* Edges of a sharp picture are looked at so far away, standard deviations of its blur. */
#define NEAR_SIGMAS 6.0

/* So near, in px, is a place to the pixel that it is sought for. */
#define PLACED_PX 1e-6

/* One beyond another by less than this, in squares, lies in the same square. */
#define SQUARE_SLACK 1e-9

INLINE void spline(double t, double value[TAPS], double slope[TAPS])
{
    const double rest = 1.0 - t;
    value[0] = rest * rest * rest / 6.0;
    value[1] = (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0;
    value[2] = (-3.0 * t * t * t + 3.0 * t * t + 3.0 * t + 1.0) / 6.0;
    value[3] = t * t * t / 6.0;
    slope[0] = -0.5 * rest * rest;
    slope[1] = 1.5 * t * t - 2.0 * t;
    slope[2] = -1.5 * t * t + t + 0.5;
    slope[3] = 0.5 * t * t;
}

/* Set `at` to where (x, y) of the square whose coefficients begin at `first` is seen, and `grow` to how that grows. */
INLINE void seen_at(const double *first, int64_t stride, double x, double y, double at[2], double grow[2][2])
{
    double wx[TAPS], dx[TAPS], wy[TAPS], dy[TAPS];
    spline(x, wx, dx);
    spline(y, wy, dy);
    for (int axis = 0; axis < 2; axis++)
        at[axis] = grow[axis][0] = grow[axis][1] = 0.0;
    for (int j = 0; j < TAPS; j++)
        for (int axis = 0; axis < 2; axis++) {
            double value = 0.0, slope = 0.0;
            for (int i = 0; i < TAPS; i++) {
                const double part = first[2 * (j * stride + i) + axis];
                value += wx[i] * part;
                slope += dx[i] * part;
            }
            at[axis] += wy[j] * value;
            grow[axis][0] += wy[j] * slope;
            grow[axis][1] += dy[j] * value;
        }
}

/* Set (x, y) to the place in the square that is seen at (u, v); return whether it is in the square. */
INLINE int place_in_square(const double *first, int64_t stride, double u, double v, double *x, double *y)
{
    double at[2], grow[2][2];
    *x = *y = 0.5;
    for (int turn = 0; turn < NEWTON_STEPS; turn++) {
        seen_at(first, stride, *x, *y, at, grow);
        const double off_u = u - at[0], off_v = v - at[1];
        if (fabs(off_u) + fabs(off_v) < PLACED_PX)
            return *x >= -SQUARE_SLACK && *y >= -SQUARE_SLACK && *x <= 1.0 + SQUARE_SLACK && *y <= 1.0 + SQUARE_SLACK;
        const double area = grow[0][0] * grow[1][1] - grow[0][1] * grow[1][0];
        if (fabs(area) < 1e-9)
            return 0;
        *x += limited((off_u * grow[1][1] - off_v * grow[0][1]) / area, 1.0);
        *y += limited((off_v * grow[0][0] - off_u * grow[1][0]) / area, 1.0);
        /* Beyond its square a cubic is another one's. */
        if (fabs(*x - 0.5) > 1.5 || fabs(*y - 0.5) > 1.5)
            return 0;
    }
    return 0;
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
            const double *first = coefficients + 2 * (j * stride + i);
            double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
            for (int corner = 0; corner < 4; corner++) {
                double at[2], grow[2][2];
                seen_at(first, stride, (double)(corner % 2), (double)(corner / 2), at, grow);
                for (int axis = 0; axis < 2; axis++) {
                    low[axis] = at[axis] < low[axis] ? at[axis] : low[axis];
                    high[axis] = at[axis] > high[axis] ? at[axis] : high[axis];
                }
            }
            /* Its sides may be bent. */
            const double more_u = around * (high[0] - low[0]), more_v = around * (high[1] - low[1]);
            double from_u = ceil(low[0] - more_u) - (double)left, to_u = floor(high[0] + more_u) - (double)left;
            double from_v = ceil(low[1] - more_v) - (double)top, to_v = floor(high[1] + more_v) - (double)top;
            if (!(from_u <= (double)width && to_u >= 0.0 && from_v <= (double)height && to_v >= 0.0))
                continue;
            from_u = from_u > 0.0 ? from_u : 0.0;
            from_v = from_v > 0.0 ? from_v : 0.0;
            to_u = to_u < (double)(width - 1) ? to_u : (double)(width - 1);
            to_v = to_v < (double)(height - 1) ? to_v : (double)(height - 1);
            for (int64_t v = (int64_t)from_v; v <= (int64_t)to_v; v++)
                for (int64_t u = (int64_t)from_u; u <= (int64_t)to_u; u++) {
                    double *place = places + 2 * (v * width + u), x, y;
                    if (isfinite(place[0])
                        || !place_in_square(first, stride, (double)(u + left), (double)(v + top), &x, &y))
                        continue;
                    place[0] = (double)i + x;
                    place[1] = (double)j + y;
                }
        }
}

/* How the picture changes along one side of the board: the squares, what lies before the first line and beyond the last,
 * and derivatives along the distance over the blur; the lines where the board ends, per square; the normal, per px. */
typedef struct {
    double squares[ORDERS], before[ORDERS], beyond[ORDERS], ends[2], normal[2];
} along_t;

/* Add `part` times the edge at `line` to `into`, and return its density per square. */
INLINE double add_line(double place, double line, double slope, double bend, double turn, double sharp, double part, double into[ORDERS])
{
    const double straight = (place - line) / slope;
    if (straight < -NEAR_SIGMAS * sharp)
        return 0.0;
    if (straight > NEAR_SIGMAS * sharp) {
        into[0] += part;
        return 0.0;
    }
    /* The distance from what bends, and is bent; a blurred arc lies inside the arc. */
    const double away = straight - 0.5 * bend * straight * straight + 0.5 * turn * sharp * sharp;
    float edge[5];
    blurred_edge((float)limited(away / sharp, NEAR_SIGMAS), 0.0f, edge);
    into[0] += part * (0.5 + 0.5 * (double)edge[0]);
    for (int order = 1; order < ORDERS; order++)
        into[order] += part * 0.5 * (double)edge[order];
    return 0.5 * (double)edge[1] / (slope * sharp);
}

/* Set `out` to the picture along one axis at a place whose neighbours are `near` (3 x 3). */
INLINE void look_along(const double near[3][3], int64_t lines, const double ends[2], double sharp, along_t *out)
{
    const double place = near[1][1], gu = 0.5 * (near[1][2] - near[1][0]), gv = 0.5 * (near[2][1] - near[0][1]);
    const double uu = near[1][2] - 2.0 * place + near[1][0], vv = near[2][1] - 2.0 * place + near[0][1];
    const double uv = 0.25 * (near[2][2] - near[2][0] - near[0][2] + near[0][0]);
    double slope = hypot(gu, gv);
    slope = slope > 1e-6 ? slope : 1e-6;
    const double nu = gu / slope, nv = gv / slope;
    const double bend = limited((uu * nu * nu + 2.0 * uv * nu * nv + vv * nv * nv) / slope, 0.5 / sharp);
    const double turn = limited((uu * nv * nv - 2.0 * uv * nu * nv + vv * nu * nu) / slope, 0.5 / sharp);
    memset(out, 0, sizeof *out);
    out->normal[0] = nu;
    out->normal[1] = nv;
    double high[ORDERS] = {0.0}, low[ORDERS] = {0.0};
    out->ends[0] = add_line(place, ends[0], slope, bend, turn, sharp, 1.0, low);
    out->ends[1] = add_line(place, ends[1], slope, bend, turn, sharp, 1.0, high);
    const double last = lines % 2 ? 1.0 : -1.0;
    for (int order = 0; order < ORDERS; order++) {
        out->squares[order] = low[order] + last * high[order];
        out->before[order] = (order ? 0.0 : 1.0) - low[order];
        out->beyond[order] = high[order];
    }
    /* Of the lines only those near change with the place: all before add -2 and 2 in turn, those beyond nothing. */
    const double reach = (NEAR_SIGMAS * sharp + 1.0) * slope;
    const int64_t first = place > reach ? (int64_t)limited(place - reach, (double)lines) : 0;
    out->squares[0] -= first % 2 ? 2.0 : 0.0;
    for (int64_t line = first; line < lines && (double)line < place + reach; line++)
        add_line(place, (double)line, slope, bend, turn, sharp, line % 2 ? 2.0 : -2.0, out->squares);
}

/* The product of both directions, and its derivatives along them: blur along two normals is correlated (edges_model.c). */
INLINE void multiply(const double a[ORDERS], const double b[ORDERS], double rho, double part, double out[3])
{
    out[0] += part * (a[0] * b[0] + rho * (a[1] * b[1] + rho * (0.5 * a[2] * b[2] + rho / 6.0 * a[3] * b[3])));
    out[1] += part * (a[1] * b[0] + rho * (a[2] * b[1] + 0.5 * rho * a[3] * b[2]));
    out[2] += part * (a[0] * b[1] + rho * (a[1] * b[2] + 0.5 * rho * a[2] * b[3]));
}

void board_picture(
    const double *places, int64_t width, int64_t height, int64_t rows, int64_t columns, const double *ends,
    const double *paper, double sharp, float *out)
{
    const int64_t area = width * height;
    const double mean = 0.25 * (paper[0] + paper[1] + paper[2] + paper[3]);
    for (int64_t v = 0; v < height; v++)
        for (int64_t u = 0; u < width; u++) {
            float *to = out + v * width + u;
            double near[2][3][3], known = 0.0;
            for (int64_t down = -1; down <= 1; down++)
                for (int64_t over = -1; over <= 1; over++)
                    for (int axis = 0; axis < 2; axis++) {
                        const int64_t row = v + down < 0 ? 0 : v + down < height ? v + down : height - 1;
                        const int64_t column = u + over < 0 ? 0 : u + over < width ? u + over : width - 1;
                        known += near[axis][down + 1][over + 1] = places[2 * (row * width + column) + axis];
                    }
            for (int plane = 0; plane < BOARD_PLANES; plane++)
                to[plane * area] = 0.0f;
            if (!isfinite(known)) {
                to[0] = (float)mean;
                continue;
            }
            along_t one, two;
            look_along(near[0], columns, ends, sharp, &one);
            look_along(near[1], rows, ends + 2, sharp, &two);
            const double rho = one.normal[0] * two.normal[0] + one.normal[1] * two.normal[1];
            /* Where two sides meet, half of what lies beyond is of each. */
            double rest1[ORDERS], rest2[ORDERS];
            for (int order = 0; order < ORDERS; order++) {
                rest1[order] = (order ? 0.0 : 1.0) - 0.5 * (one.before[order] + one.beyond[order]);
                rest2[order] = (order ? 0.0 : 1.0) - 0.5 * (two.before[order] + two.beyond[order]);
            }
            const double *parts[4][2] = {
                {one.before, rest2}, {one.beyond, rest2}, {rest1, two.before}, {rest1, two.beyond}};
            double all[3] = {0.0};
            multiply(one.squares, two.squares, rho, 1.0, all);
            for (int side = 0; side < 4; side++) {
                double beyond[3] = {0.0};
                multiply(parts[side][0], parts[side][1], rho, 1.0, beyond);
                to[(3 + side) * area] = (float)beyond[0];
                for (int k = 0; k < 3; k++)
                    all[k] += paper[side] * beyond[k];
            }
            to[0] = (float)all[0];
            to[area] = (float)((all[1] * one.normal[0] + all[2] * two.normal[0]) / sharp);
            to[2 * area] = (float)((all[1] * one.normal[1] + all[2] * two.normal[1]) / sharp);
            /* An end further out: squares in place of paper. */
            const double last1 = columns % 2 ? -1.0 : 1.0, last2 = rows % 2 ? -1.0 : 1.0;
            const double aside1 = 0.5 * (paper[2] * two.before[0] + paper[3] * two.beyond[0]);
            const double aside2 = 0.5 * (paper[0] * one.before[0] + paper[1] * one.beyond[0]);
            to[7 * area] = (float)(one.ends[0] * (two.squares[0] - paper[0] * rest2[0] + aside1));
            to[8 * area] = (float)(one.ends[1] * (last1 * two.squares[0] - paper[1] * rest2[0] + aside1));
            to[9 * area] = (float)(two.ends[0] * (one.squares[0] - paper[2] * rest1[0] + aside2));
            to[10 * area] = (float)(two.ends[1] * (last2 * one.squares[0] - paper[3] * rest1[0] + aside2));
        }
}
