/* Shared by the files of the fit of boards of tags: its working memory, and the functions of tag_board.c. */
#ifndef RIGKIT_TAG_BOARD_H
#define RIGKIT_TAG_BOARD_H

#include "edges.h"

/* The `count` selected corners, those marked MARK_CELLS, in order: their indices and places on the board, the board's map there
 * (`surface`), start positions and other inputs of their fit, and its results (`out`). */
typedef struct {
    int64_t count;
    double *cell, *places, *start, *surface, *single, *contrast, *blur, *out;
    /* The polynomial of the map, and scratch of its fit. */
    double *triangle, *basis_values, *misses, *unit, *homography, *off, *gain, *basis, *left, *rest;
    /* Scratch: twice the number of the board's corners. */
    double *ranked;
} tag_room_t;

tag_room_t room_of(const tag_fit_t *fit);

void map_tag_board(const tag_fit_t *fit);

/* Mark the known corners; return their number. */
int64_t select_known(const tag_fit_t *fit, tag_room_t *room);

/* Keep those of the selected corners that `keep` is 1 for, with their places, surface and start; without `keep` select the corners
 * marked MARK_CELLS. */
void keep_marked(const tag_fit_t *fit, tag_room_t *room, const uint8_t *keep);

/* Set the surface of the selected corners from the map; if `most_certain`, with the polynomial's degree of the least uncertainty at
 * each corner, and with gains, as corners beyond the known ones need. */
void map_marked(const tag_fit_t *fit, tag_room_t *room, int64_t most_certain);

/* Fit the selected corners from `start` and `blur`. */
void fit_marked(const tag_fit_t *fit, tag_room_t *room, const edge_rules_t *rules);

/* Set a corner from the results of its fit, and to NaN. */
void put_corner(double *corner, const double *outcome);
void forget_corner(double *corner);

int64_t known_corners(const tag_fit_t *fit);

/* Return the median of a column over the known corners. */
double typical_of(const tag_fit_t *fit, tag_room_t *room, int64_t column);

/* Return the median of `count` values without NaN; NaN if all are. */
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
