/* What the kernels of patches share: a patch of image 1, a pair of patches, and what is done with them in which file.
 * The functions in numpy that say what is computed are in tests/kernels/reference/patches.py. */
#ifndef RIGKIT_PATCHES_H
#define RIGKIT_PATCHES_H

#include "kernels.h"

/* Samples of a patch are filled up to whole vectors by ones without weight. */
enum { MAX_SIDE = 2 * MAX_HALF + 1, MAX_SAMPLES = (MAX_SIDE * MAX_SIDE + 15) / 16 * 16, UNKNOWNS = 6 };

/* The window, and a patch of image 1 with what the alignment takes from it: `steep` are the derivatives by the six unknowns
 * (the rows of dA, then dq, in the frame of image 1), free of brightness's gain and offset, times the window. */
typedef struct {
    int64_t half, count;
    float window[MAX_SAMPLES], u[MAX_SAMPLES], v[MAX_SAMPLES];
    float values[MAX_SAMPLES], weighted[MAX_SAMPLES], there[MAX_SAMPLES];
    float steep[UNKNOWNS][MAX_SAMPLES];
    float mean;
    double total, effective, energy, normal[UNKNOWNS][UNKNOWNS];
} patch_t;

/* A pair of patches: where, and what the alignment says of it. */
typedef struct {
    double u1, v1, u2, v2, A[4];
} place_t;

typedef struct {
    double correlation, noise, normal[UNKNOWNS][UNKNOWNS];
} agreement_t;

/* What is known of a pair beside the images: rows on the six unknowns with what they should be, each over its sigma. */
typedef struct {
    double rows[3][UNKNOWNS], values[3];
} knowledge_t;

/* The epipolar geometry at a node of image 1: the ray f1 of the node turned into line E f1, and E B1. */
typedef struct {
    const epipolar_t *geometry;
    double line[3], by_pixel[3][2];
} line_t;

/* epipolar_lines.c */

int miss(const line_t *line, const place_t *at, double n2[2], double *distance, double off[2]);
int line_knowledge(const line_t *line, const place_t *at, double scale, knowledge_t *known);

/* patches.c */

void make_window(const patch_rules_t *rules, patch_t *patch);
int align_pair(
    const pyramid_t *first, const pyramid_t *second, const patch_rules_t *rules, const line_t *line, patch_t *patch, place_t *place,
    double *out);

#endif
