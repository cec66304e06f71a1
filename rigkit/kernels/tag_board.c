/* The corners of a board of tags: their map to the image, and the fit of all known corners. The definitions in numpy are in
 * tests/kernels/reference/tag_board.py, the numbers in rigkit.detection.tags.corners. */
#include "tag_board.h"

static double *taken(double **room, int64_t count)
{
    double *out = *room;
    *room += count;
    return out;
}

tag_room_t room_of(const tag_fit_t *fit)
{
    const int64_t count = fit->board->count;
    double *room = fit->room, *map = fit->map;
    tag_room_t out = {0};
    out.basis = taken(&room, SURFACE_TERMS * count);
    out.surface = taken(&room, SURFACE_COLUMNS * count);
    out.out = taken(&room, OUTCOMES * count);
    out.cell = taken(&room, count);
    out.places = taken(&room, 2 * count);
    out.start = taken(&room, 2 * count);
    out.single = taken(&room, 2 * count);
    out.contrast = taken(&room, count);
    out.blur = taken(&room, count);
    out.rest = taken(&room, 2 * count);
    out.left = taken(&room, FIT_SCRATCH * count);
    out.ranked = taken(&room, 2 * count);
    out.off = fit->off;
    out.gain = fit->off + count;
    out.triangle = taken(&map, SURFACE_TERMS * SURFACE_TERMS);
    out.basis_values = taken(&map, 2 * SURFACE_TERMS);
    out.misses = taken(&map, SURFACE_DEGREE + 1);
    out.unit = taken(&map, 3);
    out.homography = taken(&map, 9);
    return out;
}

double median_of_numbers(const double *values, int64_t count, int64_t step, double *scratch)
{
    int64_t numbers = 0;
    for (int64_t i = 0; i < count; i++)
        if (!isnan(values[step * i]))
            scratch[numbers++] = values[step * i];
    return numbers > 0 ? quick_median(scratch, numbers) : NAN;
}

double typical_of(const tag_fit_t *fit, tag_room_t *room, int64_t column)
{
    return median_of_numbers(fit->corners + column, fit->board->count, CORNER_COLUMNS, room->ranked);
}

int64_t known_corners(const tag_fit_t *fit)
{
    int64_t count = 0;
    for (int64_t n = 0; n < fit->board->count; n++)
        count += is_known(fit, n);
    return count;
}

void put_corner(double *corner, const double *outcome)
{
    corner[0] = outcome[0];
    corner[1] = outcome[1];
    corner[CORNER_CONTRAST] = outcome[CONTRAST];
    corner[CORNER_RESIDUAL] = outcome[RESIDUAL];
    corner[CORNER_NOISE] = outcome[NOISE];
    corner[CORNER_SIGMA] = outcome[SIGMA];
    corner[CORNER_BLUR] = outcome[BLUR];
}

void forget_corner(double *corner)
{
    for (int64_t k = 0; k < CORNER_COLUMNS; k++)
        corner[k] = NAN;
}

int64_t select_known(const tag_fit_t *fit, tag_room_t *room)
{
    uint8_t *cells = marks_of(fit, MARK_CELLS);
    for (int64_t n = 0; n < fit->board->count; n++)
        cells[n] = (uint8_t)is_known(fit, n);
    keep_marked(fit, room, NULL);
    for (int64_t k = 0; k < room->count; k++)
        memcpy(room->start + 2 * k, fit->corners + CORNER_COLUMNS * (int64_t)room->cell[k], 2 * sizeof(double));
    return room->count;
}

void keep_marked(const tag_fit_t *fit, tag_room_t *room, const uint8_t *keep)
{
    uint8_t *cells = marks_of(fit, MARK_CELLS);
    int64_t kept = 0;
    if (keep == NULL) {
        for (int64_t n = 0; n < fit->board->count; n++)
            if (cells[n]) {
                room->cell[kept] = (double)n;
                memcpy(room->places + 2 * kept++, fit->board->places + 2 * n, 2 * sizeof(double));
            }
        room->count = kept;
        return;
    }
    for (int64_t k = 0; k < room->count; k++) {
        cells[(int64_t)room->cell[k]] = keep[k];
        if (!keep[k])
            continue;
        room->cell[kept] = room->cell[k];
        memmove(room->places + 2 * kept, room->places + 2 * k, 2 * sizeof(double));
        memmove(room->start + 2 * kept, room->start + 2 * k, 2 * sizeof(double));
        memmove(room->surface + SURFACE_COLUMNS * kept, room->surface + SURFACE_COLUMNS * k, SURFACE_COLUMNS * sizeof(double));
        kept++;
    }
    room->count = kept;
}

/* Return the number of polynomial terms of the highest degree that has at most `most`. */
static int64_t terms_within(int64_t most)
{
    int64_t terms = 1;
    for (int64_t degree = 1; degree <= SURFACE_DEGREE && (degree + 1) * (degree + 2) / 2 <= most; degree++)
        terms = (degree + 1) * (degree + 2) / 2;
    return terms;
}

/* Map the board by its known corners, unless that is done (detection.tags.surface.SmoothMap). */
void map_tag_board(const tag_fit_t *fit)
{
    double *numbers = fit->numbers;
    if (numbers[MAP_KNOWN] != 0.0)
        return;
    const tag_corner_rules_t *rules = fit->rules;
    tag_room_t room = room_of(fit);
    const int64_t count = select_known(fit, &room), wanted = (int64_t)((double)count / rules->points_a_term);
    const double *values = room.start;
    int64_t terms = terms_within(wanted), best = -1;
    if (numbers[MAP_BY_CAMERA] != 0.0) {
        for (int64_t k = 0; k < count; k++) {
            const double *seen = fit->base + SURFACE_COLUMNS * (int64_t)room.cell[k];
            for (int64_t axis = 0; axis < 2; axis++)
                room.rest[2 * k + axis] = isfinite(seen[0]) ? room.start[2 * k + axis] - seen[axis] : 0.0;
        }
        values = room.rest;
    } else
        best = fit_map(
            room.places, room.start, count, terms, rules->max_leverage, rules->nearest_depth, room.rest, room.basis, room.left,
            room.homography, room.unit, room.triangle, room.basis_values, room.misses, room.off, room.gain, numbers + MAP_SCATTER);
    numbers[MAP_BY_PERSPECTIVE] = (double)(best >= 0);
    if (best < 0) {
        const int64_t fewest = values == room.rest ? 1 : count < 3 ? count : 3;
        terms = terms_within(wanted > fewest ? wanted : fewest);
        best = fit_polynomials(
            room.places, values, count, terms, rules->max_leverage, room.basis, room.left, room.unit, room.triangle,
            room.basis_values, room.misses, room.off, room.gain, numbers + MAP_SCATTER);
    }
    /* Further terms only fit noise. */
    int64_t plain = 0;
    while (plain < best && !(room.misses[plain] <= rules->hardly_more * room.misses[best]))
        plain++;
    /* Per axis. */
    numbers[MAP_SCATTER] /= rules->median_of_rayleigh;
    numbers[MAP_TERMS] = (double)terms;
    numbers[MAP_PLAIN_DEGREE] = (double)plain;
    numbers[MAP_KNOWN] = 1.0;
}

void map_marked(const tag_fit_t *fit, tag_room_t *room, int64_t most_certain)
{
    const double *numbers = fit->numbers;
    if (numbers[MAP_BY_CAMERA] != 0.0)
        for (int64_t k = 0; k < room->count; k++)
            memcpy(
                room->surface + SURFACE_COLUMNS * k, fit->base + SURFACE_COLUMNS * (int64_t)room->cell[k],
                SURFACE_COLUMNS * sizeof(double));
    else if (numbers[MAP_BY_PERSPECTIVE] != 0.0)
        project_places(room->places, room->count, room->homography, room->surface);
    else
        memset(room->surface, 0, (size_t)(SURFACE_COLUMNS * room->count) * sizeof(double));
    add_polynomial(
        room->places, room->count, room->unit, (int64_t)numbers[MAP_TERMS], (int64_t)numbers[MAP_PLAIN_DEGREE], room->triangle,
        room->basis_values, room->misses, most_certain, room->surface);
}

/* Set, for a corner of a single tag, on which side of its lines the tag is, and its contrast. */
static void set_single(const tag_fit_t *fit, tag_room_t *room, int64_t k)
{
    const tag_board_t *board = fit->board;
    const int64_t cell = (int64_t)room->cell[k];
    const double row = cell / board->columns % 2 ? -1.0 : 1.0, column = cell % board->columns % 2 ? -1.0 : 1.0;
    const double *sides = room->surface + SURFACE_COLUMNS * k + SIDES, *start = room->start + 2 * k;
    double level[2];
    for (int64_t paper = 0; paper < 2; paper++) {
        const double far = paper ? -0.25 * board->spacing : 0.5 * board->border;
        level[paper] = grey_level_at(
            fit->grey, fit->bytes, fit->width, fit->height, start[0] + far * (column * sides[0] + row * sides[2]),
            start[1] + far * (column * sides[1] + row * sides[3]));
    }
    const double step = level[1] - level[0];
    /* Line 1 runs along the row; +90 degrees from it are down, and from line 2 to the left. */
    room->single[2 * k] = row;
    room->single[2 * k + 1] = -column;
    room->contrast[k] = 0.5 * (step > fit->rules->min_contrast ? step : fit->rules->min_contrast);
}

/* Set the inputs of the fits of the selected corners other than their start positions. */
static void set_inputs(const tag_fit_t *fit, tag_room_t *room)
{
    for (int64_t k = 0; k < room->count; k++) {
        memcpy(fit->curvature + 2 * (int64_t)room->cell[k], room->surface + SURFACE_COLUMNS * k + CURVATURE, 2 * sizeof(double));
        room->single[2 * k] = room->single[2 * k + 1] = 0.0;
        room->contrast[k] = NAN;
        if (!fit->board->joined)
            set_single(fit, room, k);
    }
}

void fit_marked(const tag_fit_t *fit, tag_room_t *room, const edge_rules_t *rules)
{
    set_inputs(fit, room);
    fit_tag_edges(
        fit->grey, fit->bytes, fit->width, fit->height, fit->board->count, marks_of(fit, MARK_CELLS), fit->board->steps,
        fit->board->signs, room->count, room->start, room->surface, room->single, room->contrast, room->blur, fit->rules->window,
        rules, fit->windows, room->out);
}

/* Return the blur s of the selected corners, from a quick fit of a few of them. */
static double quick_blur(const tag_fit_t *fit, tag_room_t *room)
{
    const int64_t some = (int64_t)((double)room->count / fit->rules->few_corners);
    set_inputs(fit, room);
    const double blur = blur_of_tags(
        fit->grey, fit->bytes, fit->width, fit->height, fit->board->count, marks_of(fit, MARK_CELLS), fit->board->steps,
        fit->board->signs, room->count, room->start, room->surface, room->single, room->contrast, some > 1 ? some : 1,
        fit->rules->first_blur, fit->rules->window, fit->rules->first, fit->windows, room->ranked);
    return isfinite(blur) ? blur : fit->rules->first_blur;
}

static void set_blur(tag_room_t *room, double blur)
{
    for (int64_t k = 0; k < room->count; k++)
        room->blur[k] = blur;
}

INLINE int is_fitted(const double *outcome)
{
    return outcome[VALID] > 0.5 && outcome[CONTRAST] > 0.0;
}

static void forget_marks(const tag_fit_t *fit)
{
    memset(marks_of(fit, MARK_VAIN), 0, (size_t)fit->board->count);
    memset(marks_of(fit, MARK_WAITING), 0, (size_t)fit->board->count);
}

/* Fit all known corners, with the curvatures of lines that they themselves determine, and remove those that fail. If `blur` is
 * NaN, a quick fit estimates it. The previous map is kept for its predictions. */
void fit_tag_board(const tag_fit_t *fit, double blur)
{
    tag_room_t room = room_of(fit);
    map_tag_board(fit);
    select_known(fit, &room);
    map_marked(fit, &room, 0);
    uint8_t *seen = (uint8_t *)room.ranked;
    for (int64_t k = 0; k < room.count; k++) {
        double sum = 0.0;
        for (int64_t i = 0; i < SECOND; i++)
            sum += room.surface[SURFACE_COLUMNS * k + i];
        seen[k] = isfinite(sum) != 0;
    }
    keep_marked(fit, &room, seen);
    set_blur(&room, isnan(blur) ? quick_blur(fit, &room) : blur);
    fit_marked(fit, &room, fit->rules->last);
    for (int64_t n = 0; n < fit->board->count; n++)
        forget_corner(fit->corners + CORNER_COLUMNS * n);
    for (int64_t k = 0; k < room.count; k++) {
        const double *outcome = room.out + OUTCOMES * k;
        memcpy(fit->sides + 4 * k, room.surface + SURFACE_COLUMNS * k + SIDES, 4 * sizeof(double));
        if (is_fitted(outcome))
            put_corner(fit->corners + CORNER_COLUMNS * (int64_t)room.cell[k], outcome);
    }
    memcpy(fit->fitted, room.out, (size_t)(OUTCOMES * room.count) * sizeof(double));
    fit->numbers[FITTED_COUNT] = (double)room.count;
    fit->numbers[FITTED_SCATTER] = fit->numbers[MAP_SCATTER];
    fit->numbers[MAP_KNOWN] = 0.0;
    forget_marks(fit);
}

/* Fit those corners again whose curvatures have changed since their fit, if these are known better now. */
void refit_tag_corners(const tag_fit_t *fit)
{
    const tag_corner_rules_t *rules = fit->rules;
    map_tag_board(fit);
    const double scatter = fit->numbers[MAP_SCATTER], before = fit->numbers[FITTED_SCATTER];
    if (scatter > rules->better_known * before)
        return;
    tag_room_t room = room_of(fit);
    forget_marks(fit);
    select_known(fit, &room);
    map_marked(fit, &room, 0);
    uint8_t *bent = (uint8_t *)(room.ranked + fit->board->count);
    int64_t count = 0;
    for (int64_t k = 0; k < room.count; k++) {
        const int64_t cell = (int64_t)room.cell[k];
        const double *seen = room.surface + SURFACE_COLUMNS * k, sigma = fit->corners[CORNER_COLUMNS * cell + CORNER_SIGMA];
        double most = 0.0, half = 0.0;
        for (int64_t axis = 0; axis < 2; axis++) {
            const double *step = fit->board->steps + 4 * cell + 2 * axis;
            const double longer = 0.5 * (step[0] > step[1] ? step[0] : step[1]),
                         reach = longer < rules->last->reach ? longer : rules->last->reach;
            const double length = hypot(seen[SIDES + 2 * axis], seen[SIDES + 2 * axis + 1]);
            const double wide = reach * length < rules->last->radius_px ? reach * length : rules->last->radius_px;
            const double bend = fabs(seen[CURVATURE + axis] - fit->curvature[2 * cell + axis]);
            /* Unknown values count as the largest. */
            most = bend <= most ? most : bend;
            half = wide <= half ? half : wide;
        }
        /* A line of curvature k is off its tangent by k w^2 / 6 in the mean over w to either side. */
        const double off = most * half * half / 6.0;
        bent[k] = before > rules->rough_px || !(off < rules->bent_sigmas * (sigma > scatter ? sigma : scatter));
        count += bent[k];
    }
    if (count == 0)
        return;
    const double blur = typical_of(fit, &room, CORNER_BLUR);
    if (2 * count > room.count) {
        fit_tag_board(fit, blur);
        return;
    }
    keep_marked(fit, &room, bent);
    set_blur(&room, blur);
    fit_marked(fit, &room, rules->last);
    for (int64_t k = 0; k < room.count; k++) {
        double *corner = fit->corners + CORNER_COLUMNS * (int64_t)room.cell[k];
        forget_corner(corner);
        if (is_fitted(room.out + OUTCOMES * k))
            put_corner(corner, room.out + OUTCOMES * k);
    }
    fit->numbers[MAP_KNOWN] = 0.0;
}

/* Return the factor for the sigmas of the corners fitted together last (rigkit.kernels.edges.sigma_factors). */
double tag_sigma_factor(const tag_fit_t *fit, const factor_rules_t *rules)
{
    tag_room_t room = room_of(fit);
    const int64_t count = (int64_t)fit->numbers[FITTED_COUNT];
    double *products = room.basis, *pairs = products + LAGS * count, *noise = room.contrast, *used = room.left;
    int64_t *owner = (int64_t *)room.cell;
    uint8_t *good = (uint8_t *)room.ranked;
    for (int64_t k = 0; k < count; k++) {
        const double *outcome = fit->fitted + OUTCOMES * k;
        memcpy(room.start + 2 * k, outcome, 2 * sizeof(double));
        memcpy(products + LAGS * k, outcome + OUTCOMES - 2 * LAGS, LAGS * sizeof(double));
        memcpy(pairs + LAGS * k, outcome + OUTCOMES - LAGS, LAGS * sizeof(double));
        noise[k] = outcome[NOISE];
        room.blur[k] = outcome[BLUR];
        used[k] = outcome[PIXELS];
        good[k] = (uint8_t)is_fitted(outcome);
        owner[k] = 0;
    }
    double factor = 1.0;
    sigma_factors(products, pairs, noise, room.start, fit->sides, room.blur, used, good, owner, count, 1, rules, &factor);
    return factor;
}

/* Return the typical leave-one-out error of the corners in their sigmas times `factor`. */
double tag_scatter(const tag_fit_t *fit, double factor)
{
    tag_room_t room = room_of(fit);
    map_tag_board(fit);
    select_known(fit, &room);
    for (int64_t k = 0; k < room.count; k++) {
        const double sigma = fit->corners[CORNER_COLUMNS * (int64_t)room.cell[k] + CORNER_SIGMA];
        room.blur[k] = room.off[k] / (factor * sigma * hypot(1.0, room.gain[k]));
    }
    return median_of_numbers(room.blur, room.count, 1, room.ranked);
}

/* Set `longer` to the longer of two sides of each tag, and `height` to how far the other one's end lies from it; NaN where the
 * tag's corners are not known. */
void tag_heights(const double *pixels, int64_t rows, int64_t columns, double *longer, double *height)
{
    for (int64_t row = 0; row + 1 < rows; row += 2)
        for (int64_t column = 0; column + 1 < columns; column += 2, longer++, height++) {
            const double *first = pixels + 2 * (row * columns + column), *below = first + 2 * columns;
            const double along[2] = {first[2] - first[0], first[3] - first[1]},
                         down[2] = {below[0] - first[0], below[1] - first[1]};
            const double across = hypot(along[0], along[1]), high = hypot(down[0], down[1]);
            *longer = isfinite(first[0] + first[2] + below[0] + below[2]) ? (across > high ? across : high) : NAN;
            *height = fabs(along[0] * down[1] - along[1] * down[0]) / *longer;
        }
}
