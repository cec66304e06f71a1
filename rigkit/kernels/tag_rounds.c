/* Rounds that add corners to a board of tags and remove outliers. The definitions in numpy are in
 * tests/kernels/reference/tag_board.py, the numbers in rigkit.detection.tags.corners. */
#include "tag_board.h"

/* A corner not found at its predicted position is searched again after another one is found within NEAR_NEW rows and columns: of
 * its own or of a neighbouring tag. */
enum { NEAR_NEW = 2 };

/* Mark the missing corners that can be searched now, with the positions predicted by the map; return their number. */
static int64_t mark_missing(const tag_fit_t *fit, tag_room_t *room)
{
    const tag_corner_rules_t *rules = fit->rules;
    const uint8_t *vain = marks_of(fit, MARK_VAIN), *waiting = marks_of(fit, MARK_WAITING);
    uint8_t *cells = marks_of(fit, MARK_CELLS), *usable = (uint8_t *)room->ranked;
    for (int64_t n = 0; n < fit->board->count; n++)
        cells[n] = !(is_known(fit, n) || vain[n] || waiting[n]);
    keep_marked(fit, room, NULL);
    map_marked(fit, room, 1);
    const double max_u = (double)fit->width - 1.0 - rules->margin_px, max_v = (double)fit->height - 1.0 - rules->margin_px;
    for (int64_t k = 0; k < room->count; k++) {
        const double *seen = room->surface + SURFACE_COLUMNS * k;
        memcpy(room->start + 2 * k, seen, 2 * sizeof(double));
        usable[k] = seen[GAIN] < rules->max_gain && seen[0] > rules->margin_px && seen[0] < max_u && seen[1] > rules->margin_px
            && seen[1] < max_v;
    }
    keep_marked(fit, room, usable);
    return room->count;
}

INLINE double lesser_height(const double *seen)
{
    return seen[HEIGHTS] < seen[HEIGHTS + 1] ? seen[HEIGHTS] : seen[HEIGHTS + 1];
}

/* Fit the marked missing corners, starting from a rough fit where the map's prediction is uncertain. */
static void fit_missing(const tag_fit_t *fit, tag_room_t *room, double blur)
{
    const double scatter = fit->numbers[MAP_SCATTER];
    int unsure = 0;
    for (int64_t k = 0; k < room->count; k++)
        unsure |= scatter * room->surface[SURFACE_COLUMNS * k + GAIN] > blur;
    if (unsure) {
        for (int64_t k = 0; k < room->count; k++) {
            const double wide = fit->rules->wide_blur * fit->board->spacing * lesser_height(room->surface + SURFACE_COLUMNS * k);
            room->blur[k] = wide > blur ? wide : blur;
        }
        fit_marked(fit, room, fit->rules->rough);
        for (int64_t k = 0; k < room->count; k++)
            if (room->out[OUTCOMES * k + VALID] > 0.5)
                memcpy(room->start + 2 * k, room->out + OUTCOMES * k, 2 * sizeof(double));
    }
    for (int64_t k = 0; k < room->count; k++)
        room->blur[k] = blur;
    fit_marked(fit, room, fit->rules->last);
}

/* Mark in `own` (count) the corners of tags whose code, read with all corners at `at`, is the board's code at that place. */
static void read_own(const tag_fit_t *fit, tag_room_t *room, const double *at, uint8_t *own)
{
    const tag_board_t *board = fit->board;
    const int64_t columns = board->columns, wide = columns / 2, tags = board->count / 4;
    /* In order of growing angle from u to v. */
    const int64_t corner[4] = {0, 1, columns + 1, columns};
    double *quads = room->rest, *likeness = room->left, *which = likeness + tags;
    int64_t *best = (int64_t *)(which + tags), whole = 0;
    memset(own, 0, (size_t)board->count);
    for (int64_t tag = 0; tag < tags; tag++) {
        const int64_t first = 2 * columns * (tag / wide) + 2 * (tag % wide);
        double sum = 0.0;
        for (int64_t c = 0; c < 4; c++)
            for (int64_t axis = 0; axis < 2; axis++)
                sum += quads[8 * whole + 2 * c + axis] = at[2 * (first + corner[c]) + axis];
        which[whole] = (double)tag;
        whole += isfinite(sum) != 0;
    }
    read_codes(
        fit->grey, fit->bytes, fit->width, fit->height, quads, whole, board->modules, board->patterns, board->codes,
        fit->rules->code_contrast, fit->modules, best, likeness);
    for (int64_t n = 0; n < whole; n++) {
        const int64_t tag = (int64_t)which[n], first = 2 * columns * (tag / wide) + 2 * (tag % wide);
        const int read = board->code_numbers[best[n]] == board->numbers[tag] && board->code_turns[best[n]] == 0
            && likeness[n] >= fit->rules->likeness;
        for (int64_t c = 0; c < 4; c++)
            own[first + corner[c]] = (uint8_t)read;
    }
}

enum { NOT_SEEN, SEEN_ODD, SEEN_CODED, SEEN_CLEAN };

/* Classify a corner fitted at the prediction `seen` by its contrast and residual relative to the typical `contrast` and `residual`.
 * With narrow borders the window contains a part of the code, which is then evidence for the tag itself. */
static uint8_t looks_of(
    const tag_fit_t *fit, const double *seen, const double *outcome, double contrast, double residual, double blur)
{
    const tag_corner_rules_t *rules = fit->rules;
    const double gap = fit->board->spacing * lesser_height(seen), gain = seen[GAIN] > 1.0 ? seen[GAIN] : 1.0;
    const double moved = hypot(outcome[0] - seen[0], outcome[1] - seen[1]), brighter = outcome[CONTRAST] / contrast;
    if (!(outcome[VALID] > 0.5 && moved < rules->moved_cells * gain * gap && outcome[CONTRAST] > rules->added_contrast * contrast))
        return NOT_SEEN;
    const double max_left = rules->added_residual * residual * (brighter > 1.0 ? brighter : 1.0);
    if (outcome[RESIDUAL] < max_left && outcome[SIGMA] < rules->max_sigma_cells * gap)
        return SEEN_CLEAN;
    return fit->board->border * lesser_height(seen) < rules->narrow_blurs * blur ? SEEN_CODED : SEEN_ODD;
}

/* Set `there` to which of the fitted corners agree with the map's prediction; return their number. */
static int64_t corners_there(const tag_fit_t *fit, tag_room_t *room, double blur, uint8_t *there)
{
    const double contrast = typical_of(fit, room, CORNER_CONTRAST), residual = typical_of(fit, room, CORNER_RESIDUAL);
    const int64_t count = fit->board->count;
    int64_t good = 0, coded = 0;
    uint8_t *own = there + count;
    for (int64_t k = 0; k < room->count; k++) {
        there[k] = looks_of(fit, room->surface + SURFACE_COLUMNS * k, room->out + OUTCOMES * k, contrast, residual, blur);
        coded += there[k] == SEEN_CODED;
    }
    if (coded > 0) {
        double *at = room->single;
        for (int64_t n = 0; n < count; n++)
            memcpy(at + 2 * n, fit->corners + CORNER_COLUMNS * n, 2 * sizeof(double));
        for (int64_t k = 0; k < room->count; k++)
            memcpy(
                at + 2 * (int64_t)room->cell[k],
                there[k] != NOT_SEEN ? room->out + OUTCOMES * k : room->surface + SURFACE_COLUMNS * k, 2 * sizeof(double));
        read_own(fit, room, at, own);
    }
    for (int64_t k = 0; k < room->count; k++) {
        there[k] = there[k] == SEEN_CLEAN || (there[k] == SEEN_CODED && own[(int64_t)room->cell[k]]);
        good += there[k];
    }
    return good;
}

/* Allow the corners around `cell` to be searched again. */
static void wake_around(const tag_fit_t *fit, int64_t cell)
{
    const int64_t rows = fit->board->rows, columns = fit->board->columns, row = cell / columns, column = cell % columns;
    uint8_t *waiting = marks_of(fit, MARK_WAITING);
    for (int64_t down = -NEAR_NEW; down <= NEAR_NEW; down++)
        for (int64_t right = -NEAR_NEW; right <= NEAR_NEW; right++)
            if (row + down >= 0 && row + down < rows && column + right >= 0 && column + right < columns)
                waiting[cell + down * columns + right] = 0;
}

/* Add the missing corners that are found at the positions predicted by the map; return their number. */
static int64_t add_round(const tag_fit_t *fit, int64_t by_this_map)
{
    tag_room_t room = room_of(fit);
    const int64_t count = fit->board->count, known = known_corners(fit);
    if (known == count || known < fit->rules->min_predicting)
        return 0;
    if (!by_this_map)
        map_tag_board(fit);
    if (mark_missing(fit, &room) == 0)
        return 0;
    const double blur = typical_of(fit, &room, CORNER_BLUR);
    fit_missing(fit, &room, blur);
    uint8_t *there = (uint8_t *)(room.ranked + count), *vain = marks_of(fit, MARK_VAIN), *waiting = marks_of(fit, MARK_WAITING);
    const int64_t good = corners_there(fit, &room, blur, there);
    for (int64_t k = 0; k < room.count; k++) {
        const int64_t cell = (int64_t)room.cell[k];
        /* A corner predicted as precisely as corners are measured does not exist; the new corners may predict others. */
        vain[cell] = room.surface[SURFACE_COLUMNS * k + GAIN] <= 1.0;
        waiting[cell] = 1;
        if (there[k])
            put_corner(fit->corners + CORNER_COLUMNS * cell, room.out + OUTCOMES * k);
    }
    for (int64_t k = 0; k < room.count; k++)
        if (there[k])
            wake_around(fit, (int64_t)room.cell[k]);
    fit->numbers[MAP_KNOWN] = good > 0 ? 0.0 : fit->numbers[MAP_KNOWN];
    return good;
}

/* Add missing corners in at most `rounds` rounds, predicted by the corners known before each round, or by the current map; return
 * the number added. */
int64_t add_tag_corners(const tag_fit_t *fit, int64_t rounds, int64_t by_this_map)
{
    int64_t added = 0;
    for (int64_t round = 0, good = 1; round < rounds && good > 0; round++) {
        good = add_round(fit, by_this_map);
        added += good;
    }
    return added;
}

/* A distance, px, larger than any in an image. */
#define FAR 1e300

/* Remove the corners with the largest leave-one-out errors; return their number. */
static int64_t drop_round(const tag_fit_t *fit)
{
    const tag_corner_rules_t *rules = fit->rules;
    tag_room_t room = room_of(fit);
    if (known_corners(fit) < rules->min_guiding)
        return 0;
    map_tag_board(fit);
    select_known(fit, &room);
    double *off = room.blur, *allowed = room.contrast;
    for (int64_t k = 0; k < room.count; k++)
        off[k] = (isnan(room.off[k]) ? 0.0 : room.off[k] < FAR ? room.off[k] : FAR) / room.gain[k];
    const double own = median_of_numbers(off, room.count, 1, room.ranked),
                 typical = own > rules->scatter_floor ? own : rules->scatter_floor;
    const double typical_sigma = typical_of(fit, &room, CORNER_SIGMA);
    int seen = 0;
    for (int64_t k = 0; k < room.count; k++) {
        const double sigma = fit->corners[CORNER_COLUMNS * (int64_t)room.cell[k] + CORNER_SIGMA];
        allowed[k] = rules->outlier * hypot(typical, sigma < 3.0 * typical_sigma ? sigma : 3.0 * typical_sigma);
        seen |= room.gain[k] < rules->judging_gain && off[k] > allowed[k];
    }
    if (!seen)
        return 0;
    map_marked(fit, &room, 0);
    double most = 0.0;
    for (int64_t k = 0; k < room.count; k++) {
        const double least = rules->displaced_cells * fit->board->spacing * lesser_height(room.surface + SURFACE_COLUMNS * k);
        off[k] = room.gain[k] < rules->judging_gain ? off[k] / (allowed[k] > least ? allowed[k] : least) : 0.0;
        most = off[k] > most ? off[k] : most;
    }
    /* The largest errors are removed first: they may cause those of their neighbours. */
    const double worst = 0.5 * most > 1.0 ? 0.5 * most : 1.0;
    int64_t dropped = 0;
    for (int64_t k = 0; k < room.count; k++)
        if (off[k] > worst) {
            forget_corner(fit->corners + CORNER_COLUMNS * (int64_t)room.cell[k]);
            dropped++;
        }
    fit->numbers[MAP_KNOWN] = dropped > 0 ? 0.0 : 1.0;
    return dropped;
}

/* Remove the corners that are inconsistent with their neighbours, in at most `rounds` rounds; return their number. */
int64_t drop_tag_corners(const tag_fit_t *fit, int64_t rounds)
{
    int64_t dropped = 0;
    for (int64_t round = 0, more = 1; round < rounds && more > 0; round++) {
        more = drop_round(fit);
        dropped += more;
    }
    return dropped;
}
