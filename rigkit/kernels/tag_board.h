/* What the files of the fit of boards of tags share: the room that it is done in, and what is done in tag_board.c. */
#ifndef RIGKIT_TAG_BOARD_H
#define RIGKIT_TAG_BOARD_H

#include "edges.h"

/* The corners that something is done with, marked MARK_CELLS, `count` of them, one after the other: their numbers on the board and
 * places there, how the board lies at these, where their fit starts, what it is told, and its outcomes. */
typedef struct {
    int64_t count;
    double *cell, *places, *start, *surface, *single, *contrast, *blur, *out;
    /* The map: what its polynomial is, and scratch. */
    double *triangle, *basis_values, *misses, *unit, *homography, *off, *gain, *basis, *left, *rest;
    /* Scratch, `count` twice of the board's corners. */
    double *ranked;
} tag_room_t;

tag_room_t room_of(const tag_fit_t *fit);

void map_tag_board(const tag_fit_t *fit);

/* Mark the known corners; return their number. */
int64_t take_known(const tag_fit_t *fit, tag_room_t *room);

/* Keep of the marked corners those that `keep` says, with their places, surface and start. */
void keep_marked(const tag_fit_t *fit, tag_room_t *room, const uint8_t *keep);

/* Set the surface of the marked corners by the map; by the `most_certain` degree, with gains, for those beyond the known ones. */
void see_marked(const tag_fit_t *fit, tag_room_t *room, int64_t most_certain);

/* Fit the marked corners from `start` and `blur`. */
void fit_marked(const tag_fit_t *fit, tag_room_t *room, const edge_rules_t *rules);

/* Put the corner that came out as `outcome` in its place, and the corner `n` out of it. */
void put_corner(double *corner, const double *outcome);
void forget_corner(double *corner);

int64_t known_corners(const tag_fit_t *fit);

/* Return the median of a column of the corners that are known. */
double usual_of(const tag_fit_t *fit, tag_room_t *room, int64_t column);

/* Return the median of those of `count` values that are numbers; NaN where none is. */
double median_of_numbers(const double *values, int64_t count, int64_t step, double *scratch);

INLINE int is_known(const tag_fit_t *fit, int64_t n)
{
    return isfinite(fit->corners[CORNER_COLUMNS * n]);
}

INLINE uint8_t *marks_of(const tag_fit_t *fit, int64_t mark)
{
    return fit->marks + mark * fit->board->count;
}

#endif
