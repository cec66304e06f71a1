/* Functions of peaks.c that smoothing.c calls. */
#ifndef RIGKIT_FRONT_H
#define RIGKIT_FRONT_H

#include "kernels.h"

void typical_values(
    const float *smooth, int64_t height, int64_t width, int64_t step, int64_t few, float *response, float *brightness, float *room,
    float *out);
void fill_thresholds(
    const float *smooth, int64_t height, int64_t width, float floor, float least, float darkest, float brightest, float *out);

#endif
