/* Shared by the kernels of patches: a patch of image 1, a pair of patches, and the functions of each file. The definitions in
 * numpy are in tests/kernels/reference/patches.py. */
#ifndef RIGKIT_PATCHES_H
#define RIGKIT_PATCHES_H

#include "kernels.h"

/* Samples of a patch are padded to a multiple of 16 by samples of weight 0. */
enum { MAX_SIDE = 2 * MAX_HALF + 1, MAX_SAMPLES = (MAX_SIDE * MAX_SIDE + 15) / 16 * 16, UNKNOWNS = 6 };

/* The window, and a patch of image 1 with the terms of its alignment. `steep` are the steepest-descent images: the derivatives by
 * the six unknowns (the rows of dA, then dq, in the frame of image 1), made orthogonal to gain and offset of the brightness, times
 * the window. `total` is the sum of the window's weights, `effective` the number of samples of equal weight with the same
 * variance of a mean. */
typedef struct {
    int64_t half, count;
    float window[MAX_SAMPLES], u[MAX_SAMPLES], v[MAX_SAMPLES];
    float values[MAX_SAMPLES], weighted[MAX_SAMPLES], there[MAX_SAMPLES];
    float steep[UNKNOWNS][MAX_SAMPLES];
    float mean;
    double total, effective, energy, normal[UNKNOWNS][UNKNOWNS];
} patch_t;

/* A pair of patches: positions and affinity, and the results of its alignment. */
typedef struct {
    double u1, v1, u2, v2, A[4];
} place_t;

typedef struct {
    double correlation, noise, normal[UNKNOWNS][UNKNOWNS];
} agreement_t;

/* Equations on the six unknowns from the epipolar geometry: rows and right-hand sides, each over its standard deviation. */
typedef struct {
    double rows[3][UNKNOWNS], values[3];
} knowledge_t;

/* The epipolar geometry at a node of image 1: the line E f1 of its ray f1, and its derivatives E B1 by the pixel. */
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
