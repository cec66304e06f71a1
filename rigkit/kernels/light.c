/* Steps of the light, such as edges of shadows, in the windows of corners. The definition in numpy is in
 * tests/kernels/reference/light.py, the numbers are in rigkit.detection.subpixel.shadows.
 *
 * The board's brightness is a + b S1 S2, as in edges.c, times the light, which changes from 1 to the value LEFT across a straight
 * edge with a direction, a position and a width. */
#include "kernels.h"

enum { X, Y, T1, T2, S, A, B, TOWARDS, PLACE, WIDTH, LEFT, UNKNOWNS };
_Static_assert((int)UNKNOWNS == (int)LIGHT_UNKNOWNS, "api_fits.h has the same number of unknowns");

/* Tested positions of an edge, and the strips between them. */
enum { PLACES = 2 * LIGHT_LATERAL + 1, STRIPS = PLACES + 1 };
/* Sums over pixels, of products of 1, the pattern E and the brightness I. */
enum { ONE, E, EE, I, EI, II, SUMS };
/* Pixels that are processed at a time; their rows are the derivatives and the residuals. */
enum { BLOCK = LIGHT_BLOCK, ROWS = UNKNOWNS + 1 };
/* Distance from an edge, in its widths, beyond which the brightness is constant. */
static const float FAR = 12.0f;
/* Initial damping of Levenberg-Marquardt, its factors after better and after worse steps, and the ridge of the normal equations. */
static const double DAMPING = 1e-3, LESS = 0.3, MORE = 5.0, RIDGE = 1e-6;
/* Pixels beyond an edge by less than this, px, are on it. */
static const double ON_EDGE = 1e-9;
/* Variance of rounding to integer grey levels. */
static const double ROUNDED = 1.0 / 12.0;

/* The pixels of a window: positions relative to its centre, brightness and pattern. */
typedef struct {
    double *u, *v, *value, *pattern, centre[2];
    int64_t count;
} lit_t;

typedef struct {
    double level, contrast, squares;
} plain_t;

/* The normal equations (lower triangle), their right side, and the sum of squares. */
typedef struct {
    double N[UNKNOWNS * UNKNOWNS], right[UNKNOWNS], squares;
} equations_t;

INLINE double edge_at(double z)
{
    float edge[5];
    blurred_edge((float)limited(z, (double)FAR), 0.0f, edge);
    return (double)edge[0];
}

/* Gather the pixels in the cell of a corner at `start` that are near its lines. */
INLINE void gather(
    const void *grey, int64_t bytes, int64_t width, int64_t height, const double start[2], const double sides[4], double lateral,
    double blur, const light_rules_t *rules, lit_t *out)
{
    const double det = sides[0] * sides[3] - sides[1] * sides[2], square = rules->radius_px * rules->radius_px;
    const double length[2] = {hypot(sides[0], sides[1]), hypot(sides[2], sides[3])};
    const int64_t radius = (int64_t)ceil(rules->radius_px);
    out->count = 0;
    if (!(fabs(start[0]) + fabs(start[1]) < 1e9) || !(fabs(det) > 0.0))
        return;
    out->centre[0] = rint(start[0]);
    out->centre[1] = rint(start[1]);
    for (int64_t dv = -radius; dv <= radius; dv++)
        for (int64_t du = -radius; du <= radius; du++) {
            const int64_t u = (int64_t)out->centre[0] + du, v = (int64_t)out->centre[1] + dv;
            if (u < 0 || v < 0 || u >= width || v >= height || !((double)(du * du + dv * dv) < square))
                continue;
            const double x = (double)u - start[0], y = (double)v - start[1];
            const double first = (sides[3] * x - sides[2] * y) / det, second = (sides[0] * y - sides[1] * x) / det;
            const double one = (y * sides[0] - x * sides[1]) / length[0], two = (y * sides[2] - x * sides[3]) / length[1];
            if (!(fabs(first) < rules->reach_cells && fabs(second) < rules->reach_cells)
                || !(fabs(one) < lateral || fabs(two) < lateral))
                continue;
            const int64_t at = v * width + u, n = out->count++;
            out->u[n] = (double)du;
            out->v[n] = (double)dv;
            out->value[n] = level_at(grey, bytes, at);
            out->pattern[n] = edge_at(one / blur) * edge_at(two / blur);
        }
    for (int64_t n = out->count; n < out->count + BLOCK; n++)
        out->u[n] = out->v[n] = out->value[n] = out->pattern[n] = 0.0;
}

/* Return level and contrast of the least-squares fit values = level + contrast * pattern, and its sum of squared residuals, from
 * sums over pixels. */
INLINE plain_t plain_of(const double sums[SUMS])
{
    const double det = sums[ONE] * sums[EE] - sums[E] * sums[E];
    if (!(det > 1e-6))
        return (plain_t){0.0, 0.0, INFINITY};
    const double level = (sums[EE] * sums[I] - sums[E] * sums[EI]) / det;
    const double contrast = (sums[ONE] * sums[EI] - sums[E] * sums[I]) / det;
    return (plain_t){level, contrast, sums[II] - level * sums[I] - contrast * sums[EI]};
}

/* Set `sums` to those over the pixels before each position of an edge, whose dark side is in the direction (c, s). */
INLINE void strip_sums(const lit_t *lit, double c, double s, double sums[STRIPS][SUMS])
{
    memset(sums, 0, STRIPS * SUMS * sizeof(double));
    for (int64_t n = 0; n < lit->count; n++) {
        const double place = ceil(lit->u[n] * c + lit->v[n] * s + LIGHT_LATERAL - ON_EDGE);
        const int64_t strip = place < 0.0 ? 0 : place > STRIPS - 1 ? STRIPS - 1 : (int64_t)place;
        const double e = lit->pattern[n], i = lit->value[n], terms[SUMS] = {1.0, e, e * e, i, e * i, i * i};
        for (int k = 0; k < SUMS; k++)
            sums[strip][k] += terms[k];
    }
    for (int strip = 1; strip < STRIPS; strip++)
        for (int k = 0; k < SUMS; k++)
            sums[strip][k] += sums[strip - 1][k];
}

/* Set direction, position, brightness and light of `x` to those of the sharp step with the smallest sum of squared residuals, by
 * exhaustive search with separate fits of both sides; return whether there is one. */
INLINE int seek_step(const lit_t *lit, const light_rules_t *rules, double x[UNKNOWNS])
{
    double best = INFINITY, sums[STRIPS][SUMS], dark[SUMS];
    for (int64_t k = 0; k < rules->angles; k++) {
        const double angle = 2.0 * PI * (double)k / (double)rules->angles;
        strip_sums(lit, cos(angle), sin(angle), sums);
        for (int place = 0; place < PLACES; place++) {
            for (int j = 0; j < SUMS; j++)
                dark[j] = sums[STRIPS - 1][j] - sums[place][j];
            if (!(sums[place][ONE] > rules->min_pixels && dark[ONE] > rules->min_pixels))
                continue;
            const plain_t here = plain_of(sums[place]), beyond = plain_of(dark);
            const double square = here.level * here.level + here.contrast * here.contrast;
            const double left = (here.level * beyond.level + here.contrast * beyond.contrast) / (square > 1e-9 ? square : 1e-9);
            if (!(left > rules->min_left && left < rules->max_left) || !(here.squares + beyond.squares < best))
                continue;
            best = here.squares + beyond.squares;
            x[TOWARDS] = angle;
            x[PLACE] = (double)(place - LIGHT_LATERAL);
            x[A] = here.level;
            x[B] = here.contrast;
            x[LEFT] = left;
        }
    }
    return best < INFINITY;
}

/* An edge at the pixels of a block: their distances beyond it in its widths, the step from -1 to 1 and its slope there, and the
 * derivatives of the distances by the four parameters of the edge. */
typedef struct {
    double z[BLOCK], side[BLOCK], slope[BLOCK], by[4][BLOCK];
} edge_block_t;

/* Set step and slope of an edge. The clipping has a loop of its own: otherwise it becomes branches, which prevent vectorisation. */
INLINE void set_sides(edge_block_t *edge)
{
    float z[BLOCK];
    for (int k = 0; k < BLOCK; k++) {
        const float at = (float)edge->z[k], most = at < FAR ? at : FAR;
        z[k] = most > -FAR ? most : -FAR;
    }
    for (int k = 0; k < BLOCK; k++) {
        float out[5];
        blurred_edge(z[k], 0.0f, out);
        edge->side[k] = (double)out[0];
        edge->slope[k] = (double)out[1];
    }
}

/* Set `out` to a curved line of the board through (x, y) at an angle, with derivatives by x, y, the angle, and the log of its
 * blur. */
INLINE void line_block(
    const double *restrict us, const double *restrict vs, double x, double y, double angle, double bend, double per_blur,
    edge_block_t *restrict out)
{
    const double c = cos(angle), s = sin(angle);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double along = c * (us[k] - x) + s * (vs[k] - y), lateral = c * (vs[k] - y) - s * (us[k] - x);
        out->z[k] = (lateral - 0.5 * bend * along * along) * per_blur;
        out->by[0][k] = per_blur * (s + bend * along * c);
        out->by[1][k] = per_blur * (bend * along * s - c);
        out->by[2][k] = -per_blur * along * (1.0 + bend * lateral);
        out->by[3][k] = -out->z[k];
    }
    set_sides(out);
}

/* The same for the edge of the light, with derivatives by minus its direction, minus its position, minus the log of its width. */
INLINE void shadow_block(const double *restrict us, const double *restrict vs, const double x[UNKNOWNS], edge_block_t *restrict out)
{
    const double c = cos(x[TOWARDS]), s = sin(x[TOWARDS]), place = x[PLACE], per_width = exp(-x[WIDTH]);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        out->z[k] = (c * us[k] + s * vs[k] - place) * per_width;
        out->by[0][k] = -per_width * (c * vs[k] - s * us[k]);
        out->by[1][k] = per_width;
        out->by[2][k] = out->z[k];
    }
    set_sides(out);
}

/* Set the rows of the block of pixels that begins at `start`, 0 beyond the last pixel. */
INLINE void block_rows(const lit_t *lit, int64_t start, const double x[UNKNOWNS], const double bend[2], double rows[ROWS][BLOCK])
{
    const double per_blur = exp(-x[S]), lost = 1.0 - x[LEFT], level = x[A], contrast = x[B];
    const double *restrict us = lit->u + start, *restrict vs = lit->v + start, *restrict values = lit->value + start;
    const int here = lit->count - start < BLOCK ? (int)(lit->count - start) : BLOCK;
    edge_block_t one, two, shadow;
    line_block(us, vs, x[X], x[Y], x[T1], bend[0], per_blur, &one);
    line_block(us, vs, x[X], x[Y], x[T2], bend[1], per_blur, &two);
    shadow_block(us, vs, x, &shadow);
#pragma omp simd
    for (int k = 0; k < BLOCK; k++) {
        const double counts = k < here ? 1.0 : 0.0, dark = 0.5 + 0.5 * shadow.side[k], light = counts * (1.0 - lost * dark);
        const double pattern = one.side[k] * two.side[k], surface = level + contrast * pattern;
        const double first = contrast * light * two.side[k] * one.slope[k];
        const double second = contrast * light * one.side[k] * two.slope[k];
        const double fall = 0.5 * counts * surface * lost * shadow.slope[k];
        rows[X][k] = first * one.by[0][k] + second * two.by[0][k];
        rows[Y][k] = first * one.by[1][k] + second * two.by[1][k];
        rows[T1][k] = first * one.by[2][k];
        rows[T2][k] = second * two.by[2][k];
        rows[S][k] = first * one.by[3][k] + second * two.by[3][k];
        rows[A][k] = light;
        rows[B][k] = pattern * light;
        rows[TOWARDS][k] = fall * shadow.by[0][k];
        rows[PLACE][k] = fall * shadow.by[1][k];
        rows[WIDTH][k] = fall * shadow.by[2][k];
        rows[LEFT][k] = counts * surface * dark;
        rows[UNKNOWNS][k] = counts * values[k] - surface * light;
    }
}

INLINE void linearise(const lit_t *lit, const double x[UNKNOWNS], const double bend[2], equations_t *out)
{
    double rows[ROWS][BLOCK], sums[ROWS * ROWS] = {0.0};
    for (int64_t start = 0; start < lit->count; start += BLOCK) {
        block_rows(lit, start, x, bend, rows);
        for (int i = 0; i < ROWS; i++)
            for (int j = 0; j <= i; j++) {
                double sum = 0.0;
#pragma omp simd reduction(+ : sum)
                for (int k = 0; k < BLOCK; k++)
                    sum += rows[i][k] * rows[j][k];
                sums[i * ROWS + j] += sum;
            }
    }
    for (int i = 0; i < UNKNOWNS; i++) {
        memcpy(out->N + i * UNKNOWNS, sums + i * ROWS, (size_t)(i + 1) * sizeof(double));
        out->right[i] = sums[UNKNOWNS * ROWS + i];
    }
    out->squares = sums[UNKNOWNS * ROWS + UNKNOWNS];
}

/* Add the prior around `start` to the equations at `x`; return the variance of a pixel. */
INLINE double add_prior(
    const lit_t *lit, const double x[UNKNOWNS], const double start[UNKNOWNS], const light_rules_t *rules, equations_t *all)
{
    const double lines = 1.0 / (rules->line_sigma * rules->line_sigma);
    const double known[UNKNOWNS] = {
        [T1] = lines,
        [T2] = lines,
        [S] = 1.0 / (rules->log_edge_sigma * rules->log_edge_sigma),
        [WIDTH] = 1.0 / (rules->log_width_sigma * rules->log_width_sigma)};
    const double most = (double)(lit->count > 2 * UNKNOWNS ? lit->count : 2 * UNKNOWNS) - UNKNOWNS;
    const double variance = all->squares / most > ROUNDED ? all->squares / most : ROUNDED;
    for (int i = 0; i < UNKNOWNS; i++) {
        all->N[i * UNKNOWNS + i] += variance * known[i] + RIDGE;
        all->right[i] -= variance * known[i] * (x[i] - start[i]);
    }
    return variance;
}

/* Fit corner and step jointly from `x`, and set `N` to the factor of the normal equations; return the variance of a pixel, or -1 if
 * they are singular. */
INLINE double fit_together(
    const lit_t *lit, const double bend[2], const light_rules_t *rules, const double *max_step, double x[UNKNOWNS],
    double N[UNKNOWNS * UNKNOWNS])
{
    double start[UNKNOWNS], damping = DAMPING;
    equations_t now, fresh, all;
    memcpy(start, x, sizeof start);
    linearise(lit, x, bend, &now);
    for (int64_t k = 0; k < rules->iterations; k++) {
        double tried[UNKNOWNS];
        all = now;
        add_prior(lit, x, start, rules, &all);
        for (int i = 0; i < UNKNOWNS; i++)
            all.N[i * UNKNOWNS + i] *= 1.0 + damping;
        damping *= MORE;
        if (!cholesky(all.N, UNKNOWNS))
            continue;
        cholesky_solve(all.N, UNKNOWNS, all.right);
        for (int i = 0; i < UNKNOWNS; i++)
            tried[i] = x[i] + limited(all.right[i], max_step[i]);
        const double least = log(rules->min_width), most = log(rules->max_width);
        tried[WIDTH] = tried[WIDTH] < least ? least : tried[WIDTH] > most ? most : tried[WIDTH];
        tried[LEFT] = tried[LEFT] < 0.5 * rules->min_left ? 0.5 * rules->min_left : tried[LEFT];
        tried[LEFT] = tried[LEFT] > rules->max_light ? rules->max_light : tried[LEFT];
        linearise(lit, tried, bend, &fresh);
        if (!(fresh.squares < now.squares))
            continue;
        damping *= LESS / MORE;
        now = fresh;
        memcpy(x, tried, sizeof tried);
    }
    const double variance = add_prior(lit, x, start, rules, &now);
    memcpy(N, now.N, sizeof now.N);
    return cholesky(N, UNKNOWNS) ? variance : -1.0;
}

/* Return whether opposite squares at a corner differ by more than `uneven` times its contrast, at any of `parts` distances along
 * the lines, `off` from these, in sides of the cell. */
static int uneven_at(
    const void *grey, int64_t bytes, int64_t width, int64_t height, const double pixel[2], const double side[4],
    const double *along, int64_t parts, const double off[2], double uneven)
{
    int seen = 0;
    for (int64_t k = 0; k < parts; k++) {
        double contrast = 0.0, apart = 0.0;
        for (int line = 0; line < 2; line++) {
            double values[2][2];
            for (int n = 0; n < 4; n++) {
                /* A point reflected at the corner has the same colour. */
                const double mirror = n % 2 ? -1.0 : 1.0, beside = (n < 2 ? -mirror : mirror) * off[1 - line];
                const double x = mirror * along[k], *one = side + 2 * line, *other = side + 2 * (1 - line);
                const double u = pixel[0] + x * one[0] + beside * other[0], v = pixel[1] + x * one[1] + beside * other[1];
                if (!(u >= 0.0 && v >= 0.0 && u <= (double)(width - 1) && v <= (double)(height - 1)))
                    return 0;
                values[n / 2][n % 2] = grey_level_at(grey, bytes, width, height, u, v);
            }
            for (int n = 0; n < 2; n++) {
                contrast = fmax(contrast, fabs(values[1][n] - values[0][n]));
                apart = fmax(apart, fabs(values[n][1] - values[n][0]));
            }
        }
        seen |= apart > uneven * contrast;
    }
    return seen;
}

/* Set `out` for the corners whose opposite squares differ. */
void lit_unevenly(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *pixels, const double *sides,
    const double *lateral, const uint8_t *ends, const double *along, int64_t parts, double max_lateral, double min_px,
    double uneven, uint8_t *out)
{
    for (int64_t n = 0; n < count; n++) {
        const double *side = sides + 4 * n, length[2] = {hypot(side[0], side[1]), hypot(side[2], side[3])};
        double off[2], nearest = INFINITY;
        for (int line = 0; line < 2; line++) {
            off[line] = fmin(max_lateral, lateral[n] / fmax(length[line], 1e-9));
            nearest = fmin(nearest, off[line] * length[line]);
        }
        /* At corners where the board may end only the nearest distance is used. */
        out[n] = nearest > min_px
            && uneven_at(grey, bytes, width, height, pixels + 2 * n, side, along, ends[n] ? 1 : parts, off, uneven);
    }
}

FOR_EACH_PROCESSOR
void fit_light_steps(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *start, const double *sides,
    const double *curvature, const double *lateral, double blur, const double *max_step, const light_rules_t *rules, int64_t most,
    double *scratch, double *out)
{
    lit_t lit = {.u = scratch, .v = scratch + most, .value = scratch + 2 * most, .pattern = scratch + 3 * most};
    for (int64_t n = 0; n < count; n++) {
        double *result = out + n * LIGHT_OUTCOMES, x[UNKNOWNS] = {0.0}, N[UNKNOWNS * UNKNOWNS];
        const double *from = start + 2 * n, *side = sides + 4 * n;
        memset(result, 0, LIGHT_OUTCOMES * sizeof(double));
        result[5] = rules->first_width;
        result[6] = 1.0;
        gather(grey, bytes, width, height, from, side, lateral[n], blur, rules, &lit);
        if (!lit.count || !seek_step(&lit, rules, x))
            continue;
        x[X] = from[0] - lit.centre[0];
        x[Y] = from[1] - lit.centre[1];
        x[T1] = atan2(side[1], side[0]);
        x[T2] = atan2(side[3], side[2]);
        x[S] = log(blur);
        x[WIDTH] = log(rules->first_width);
        const double variance = fit_together(&lit, curvature + 2 * n, rules, max_step, x, N);
        if (!(variance > 0.0))
            continue;
        double spread = 0.0;
        for (int i = 0; i < 2; i++) {
            double column[UNKNOWNS] = {[X] = i == 0, [Y] = i == 1};
            cholesky_solve(N, UNKNOWNS, column);
            spread += 0.5 * column[i];
        }
        const double all[LIGHT_OUTCOMES] = {
            lit.centre[0] + x[X], lit.centre[1] + x[Y], sqrt(variance * spread), x[TOWARDS], x[PLACE], exp(x[WIDTH]), x[LEFT], 1.0};
        memcpy(result, all, sizeof all);
    }
}
