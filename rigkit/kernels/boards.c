/* The rendered image of a whole chessboard, and its derivatives by the places of its pixels. Purpose and constants are in
 * rigkit.detection.subpixel.whole_board, checks against closed forms in tests/kernels/test_boards.py.
 *
 * Places on the board, in squares from its first corner, are a cubic spline of the board's corners. The image is drawn sharp, from
 * the distances to the nearest lines, and blurred afterwards; so are its derivatives. */
#include "kernels.h"
#include "boards.h"

enum { ORDERS = 4 };

/* Largest distance of the edges that are drawn, in standard deviations of the blur. */
#define NEAR_SIGMAS 6.0

/* The image along one axis of the board, with its derivatives by the distance over the blur: the squares, and the shares of the
 * paper before the first and beyond the last line; the densities of the edges at both ends, per square; the unit normal in px. */
typedef struct {
    double squares[ORDERS], before[ORDERS], beyond[ORDERS], ends[2], normal[2];
} along_t;

/* The map at a pixel: px per square, and its second derivatives along the normal and along the line. */
typedef struct {
    double per, bend, turn;
} growth_t;

/* Add `part` times the edge at `line` to `into`; return its density per square. */
INLINE double add_line(double place, double line, const growth_t *grow, double sharp, double part, double into[ORDERS])
{
    const double straight = (place - line) * grow->per;
    if (straight < -NEAR_SIGMAS * sharp)
        return 0.0;
    if (straight > NEAR_SIGMAS * sharp) {
        into[0] += part;
        return 0.0;
    }
    /* The distance to second order; a blurred arc is shifted to its inside. */
    const double away = straight - 0.5 * grow->bend * straight * straight + 0.5 * grow->turn * sharp * sharp;
    float edge[5];
    blurred_edge((float)limited(away / sharp, NEAR_SIGMAS), 0.0f, edge);
    into[0] += part * (0.5 + 0.5 * (double)edge[0]);
    for (int order = 1; order < ORDERS; order++)
        into[order] += part * 0.5 * (double)edge[order];
    return 0.5 * (double)edge[1] * grow->per / sharp;
}

/* Set `out` to the image along one axis at the place `at`; `next` are the offsets of its neighbours before and after, along u and
 * along v. */
INLINE void look_along(const double *at, const int64_t next[2][2], int64_t lines, const double ends[2], double sharp, along_t *out)
{
    for (int order = 0; order < ORDERS; order++)
        out->squares[order] = out->before[order] = out->beyond[order] = 0.0;
    out->ends[0] = out->ends[1] = out->normal[0] = out->normal[1] = 0.0;
    const double place = at[0], before_u = at[next[0][0]], after_u = at[next[0][1]], before_v = at[next[1][0]];
    const double after_v = at[next[1][1]], gu = 0.5 * (after_u - before_u), gv = 0.5 * (after_v - before_v);
    const double last = lines % 2 ? 1.0 : -1.0;
    double slope = sqrt(gu * gu + gv * gv);
    const double far = NEAR_SIGMAS * sharp * slope, nearest = nearest_line(place, lines);
    if (fabs(place - nearest) > far && fabs(place - ends[0]) > far && fabs(place - ends[1]) > far) {
        /* Most places are far from all lines. */
        const double low = place > ends[0] ? 1.0 : 0.0, high = place > ends[1] ? 1.0 : 0.0;
        const int64_t passed = (int64_t)nearest + (place > nearest);
        out->squares[0] = low + last * high - (passed % 2 ? 2.0 : 0.0);
        out->before[0] = 1.0 - low;
        out->beyond[0] = high;
        return;
    }
    const double uu = after_u - 2.0 * place + before_u, vv = after_v - 2.0 * place + before_v;
    const double uv = 0.25
        * (at[next[0][1] + next[1][1]] - at[next[0][0] + next[1][1]] - at[next[0][1] + next[1][0]] + at[next[0][0] + next[1][0]]);
    slope = slope > 1e-6 ? slope : 1e-6;
    const double per = 1.0 / slope, nu = gu * per, nv = gv * per;
    const double bend = limited((uu * nu * nu + 2.0 * uv * nu * nv + vv * nv * nv) * per, 0.5 / sharp);
    const double turn = limited((uu * nv * nv - 2.0 * uv * nu * nv + vv * nu * nu) * per, 0.5 / sharp);
    const growth_t grow = {per, bend, turn};
    out->normal[0] = nu;
    out->normal[1] = nv;
    double high[ORDERS] = {0.0}, low[ORDERS] = {0.0};
    out->ends[0] = add_line(place, ends[0], &grow, sharp, 1.0, low);
    out->ends[1] = add_line(place, ends[1], &grow, sharp, 1.0, high);
    for (int order = 0; order < ORDERS; order++) {
        out->squares[order] = low[order] + last * high[order];
        out->before[order] = (order ? 0.0 : 1.0) - low[order];
        out->beyond[order] = high[order];
    }
    /* Only near lines depend on the place: the previous ones add -2 and 2 in turn, the following ones nothing. */
    const double reach = (NEAR_SIGMAS * sharp + 1.0) * slope;
    const int64_t first = place > reach ? (int64_t)limited(place - reach, (double)lines) : 0;
    out->squares[0] -= first % 2 ? 2.0 : 0.0;
    for (int64_t line = first; line < lines && (double)line < place + reach; line++)
        add_line(place, (double)line, &grow, sharp, line % 2 ? 2.0 : -2.0, out->squares);
}

/* Add `part` times the product of both axes and its derivatives along them; the blurs along the two normals are correlated
 * (Mehler's series, see edges_model.c). */
INLINE void multiply(const double a[ORDERS], const double b[ORDERS], double rho, double part, double out[3])
{
    out[0] += part * (a[0] * b[0] + rho * (a[1] * b[1] + rho * (0.5 * a[2] * b[2] + rho / 6.0 * a[3] * b[3])));
    out[1] += part * (a[1] * b[0] + rho * (a[2] * b[1] + 0.5 * rho * a[3] * b[2]));
    out[2] += part * (a[0] * b[1] + rho * (a[1] * b[2] + 0.5 * rho * a[2] * b[3]));
}

/* As `board_picture`, with a constant number of planes. */
INLINE void draw(
    const double *places, int64_t width, int64_t height, int64_t rows, int64_t columns, const double *ends, const double *paper,
    double sharp, const int64_t planes, float *out)
{
    const int64_t area = width * height;
    const double mean = 0.25 * (paper[0] + paper[1] + paper[2] + paper[3]);
    for (int64_t v = 0; v < height; v++)
        for (int64_t u = 0; u < width; u++) {
            float *to = out + v * width + u;
            const double *at = places + 2 * (v * width + u);
            /* Both coordinates of a place are known, or none. */
            const int64_t next[2][2] = {{u ? -2 : 0, u + 1 < width ? 2 : 0}, {v ? -2 * width : 0, v + 1 < height ? 2 * width : 0}};
            double known = at[next[0][0]] + at[0] + at[next[0][1]];
            for (int side = 0; side < 2; side++)
                known += at[next[0][0] + next[1][side]] + at[next[1][side]] + at[next[0][1] + next[1][side]];
            for (int64_t plane = 0; plane < planes; plane++)
                to[plane * area] = 0.0f;
            if (!isfinite(known)) {
                to[0] = (float)mean;
                continue;
            }
            along_t one, two;
            look_along(at, next, columns, ends, sharp, &one);
            look_along(at + 1, next, rows, ends + 2, sharp, &two);
            const double rho = one.normal[0] * two.normal[0] + one.normal[1] * two.normal[1];
            /* Beyond a corner of the board both sides have half of the paper. */
            double rest1[ORDERS], rest2[ORDERS];
            for (int order = 0; order < ORDERS; order++) {
                rest1[order] = (order ? 0.0 : 1.0) - 0.5 * (one.before[order] + one.beyond[order]);
                rest2[order] = (order ? 0.0 : 1.0) - 0.5 * (two.before[order] + two.beyond[order]);
            }
            const double *parts[4][2] = {{one.before, rest2}, {one.beyond, rest2}, {rest1, two.before}, {rest1, two.beyond}};
            double all[3] = {0.0};
            multiply(one.squares, two.squares, rho, 1.0, all);
            for (int side = 0; side < 4; side++) {
                double beyond[3] = {0.0};
                if (planes == 1 && paper[side] == 0.0)
                    continue;
                multiply(parts[side][0], parts[side][1], rho, 1.0, beyond);
                if (planes > 1)
                    to[(3 + side) * area] = (float)beyond[0];
                for (int k = 0; k < 3; k++)
                    all[k] += paper[side] * beyond[k];
            }
            to[0] = (float)all[0];
            if (planes == 1)
                continue;
            to[area] = (float)((all[1] * one.normal[0] + all[2] * two.normal[0]) / sharp);
            to[2 * area] = (float)((all[1] * one.normal[1] + all[2] * two.normal[1]) / sharp);
            /* Moving an end outwards replaces paper by squares. */
            const double last1 = columns % 2 ? -1.0 : 1.0, last2 = rows % 2 ? -1.0 : 1.0;
            const double aside1 = 0.5 * (paper[2] * two.before[0] + paper[3] * two.beyond[0]);
            const double aside2 = 0.5 * (paper[0] * one.before[0] + paper[1] * one.beyond[0]);
            to[7 * area] = (float)(one.ends[0] * (two.squares[0] - paper[0] * rest2[0] + aside1));
            to[8 * area] = (float)(one.ends[1] * (last1 * two.squares[0] - paper[1] * rest2[0] + aside1));
            to[9 * area] = (float)(two.ends[0] * (one.squares[0] - paper[2] * rest1[0] + aside2));
            to[10 * area] = (float)(two.ends[1] * (last2 * one.squares[0] - paper[3] * rest1[0] + aside2));
        }
}

FOR_EACH_PROCESSOR
void board_picture(
    const double *places, int64_t width, int64_t height, int64_t rows, int64_t columns, const double *ends, const double *paper,
    double sharp, int64_t planes, float *out)
{
    if (planes == 1)
        draw(places, width, height, rows, columns, ends, paper, sharp, 1, out);
    else
        draw(places, width, height, rows, columns, ends, paper, sharp, BOARD_PLANES, out);
}
