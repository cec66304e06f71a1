/* The ring of samples around a point: whether the point is a chessboard corner, its angles and its contrast. */

#ifndef RIGKIT_RINGS_H
#define RIGKIT_RINGS_H

#include "kernels.h"

/* Return the two angles of a corner from the `even` part of its ring (reference.front._angles). */
INLINE void ring_angles(
    const image_t image, const ring_rules_t *rules, float u, float v, float radius, const float *even, double angles[2])
{
    const float *circle = rules->circle;
    float second_u = 0.0f, second_v = 0.0f, fourth_u = 0.0f, fourth_v = 0.0f, inner_u = 0.0f, inner_v = 0.0f;
    for (int64_t k = 0; k < HALF; k++) {
        const float *two = circle + 2 * (2 * k % TURN), *four = circle + 2 * (4 * k % TURN);
        second_u += even[k] * two[0];
        second_v -= even[k] * two[1];
        fourth_u += even[k] * four[0];
        fourth_v -= even[k] * four[1];
    }
    for (int64_t k = 0; k < TURN; k += 2) {
        const float *two = circle + 2 * (2 * k % TURN);
        const float part_u = 0.5f * radius * circle[2 * k], part_v = 0.5f * radius * circle[2 * k + 1];
        const float here = brightness_at(image, u + part_u, v + part_v);
        inner_u += here * two[0];
        inner_v -= here * two[1];
    }
    double size = sqrt((double)second_u * second_u + (double)second_v * second_v);
    size = size > 1e-20 ? size : 1e-20;
    const double phase_u = second_u / size, phase_v = second_v / size;
    /* Both sums have HALF samples: half a turn of the ring, and every second sample of the whole inner ring. */
    const double ratio = (inner_u * phase_u + inner_v * phase_v) / size;
    double place = (ratio - 0.25) / 0.75 * (double)(rules->gain_count - 1);
    place = place > 0.0 ? place : 0.0;
    place = place < (double)(rules->gain_count - 1) ? place : (double)(rules->gain_count - 1);
    int64_t at = (int64_t)place;
    at = at < rules->gain_count - 2 ? at : rules->gain_count - 2;
    const double gain = rules->gains[at] + (place - (double)at) * (rules->gains[at + 1] - rules->gains[at]);
    const double twice_u = phase_u * phase_u - phase_v * phase_v, twice_v = 2.0 * phase_u * phase_v;
    double cosine = gain * (fourth_u * twice_u + fourth_v * twice_v) / size;
    cosine = cosine < rules->max_cosine ? cosine : rules->max_cosine;
    cosine = cosine > -rules->max_cosine ? cosine : -rules->max_cosine;
    const double quadrant = acos(cosine), first = -0.5 * (atan2(phase_v, phase_u) + quadrant);
    angles[0] = first < 0.0 ? first + PI : first;
    angles[1] = angles[0] + quadrant;
}

/* Set `samples` to every `stride`-th sample of a ring. As brightness_at, but in two loops: positions, which are vectorised, then
 * reads. */
INLINE void sample_ring(const image_t image, const float *circle, int64_t stride, float u, float v, float radius, float *samples)
{
    float right[TURN], below[TURN];
    int32_t at[TURN];
    const int32_t width = (int32_t)image.width, right_most = width - 2, low_most = (int32_t)image.height - 2;
    const float max_u = (float)(width - 1), max_v = (float)(image.height - 1);
    /* A pixel more than the ring needs, for the rounding of float32. */
    const float margin = radius + 1.0f;
    const int inside = u > margin && v > margin && u < max_u - margin && v < max_v - margin;
    for (int64_t k = 0; inside && k < TURN / stride; k++) {
        const float sample_u = u + radius * circle[2 * stride * k], sample_v = v + radius * circle[2 * stride * k + 1];
        const int32_t left = (int32_t)sample_u, top = (int32_t)sample_v;
        right[k] = sample_u - (float)left;
        below[k] = sample_v - (float)top;
        at[k] = top * width + left;
    }
    for (int64_t k = 0; !inside && k < TURN / stride; k++) {
        float sample_u = u + radius * circle[2 * stride * k], sample_v = v + radius * circle[2 * stride * k + 1];
        sample_u = sample_u > 0.0f ? sample_u : 0.0f;
        sample_v = sample_v > 0.0f ? sample_v : 0.0f;
        sample_u = sample_u < max_u ? sample_u : max_u;
        sample_v = sample_v < max_v ? sample_v : max_v;
        int32_t left = (int32_t)sample_u, top = (int32_t)sample_v;
        left = left < right_most ? left : right_most;
        top = top < low_most ? top : low_most;
        right[k] = sample_u - (float)left;
        below[k] = sample_v - (float)top;
        at[k] = top * width + left;
    }
    for (int64_t k = 0; k < TURN / stride; k++) {
        const float *upper = image.brightness + at[k], *lower = upper + width;
        const float above = upper[0] + right[k] * (upper[1] - upper[0]);
        samples[k] = above + below[k] * (lower[0] + right[k] * (lower[1] - lower[0]) - above);
    }
}

/* Return 1 if the ring around (u, v) is that of a chessboard corner of contrast `least` or more, 2 if it is that of one with motion
 * blur, by the brightness at its centre, else 0; set its two angles and its contrast (reference.front.read_rings). */
INLINE int read_ring(
    const image_t image, const ring_rules_t rules, float u, float v, float radius, double least, double angles[2], double *contrast)
{
    float ring[TURN], even[HALF];
    sample_ring(image, rules.circle, 1, u, v, radius, ring);
    float low = 1e30f, high = -1e30f, mean = 0.0f, odd_energy = 0.0f, energy = 0.0f;
    for (int64_t k = 0; k < HALF; k++)
        even[k] = 0.5f * (ring[k] + ring[HALF + k]);
    for (int64_t k = 0; k < HALF; k++) {
        low = even[k] < low ? even[k] : low;
        high = even[k] > high ? even[k] : high;
        mean += even[k];
    }
    mean /= (float)HALF;
    for (int64_t k = 0; k < HALF; k++) {
        const float odd = 0.5f * (ring[k] - ring[HALF + k]);
        odd_energy += odd * odd;
        energy += (even[k] - mean) * (even[k] - mean);
    }
    if (!(odd_energy < (float)rules.max_odd * energy) || !(high > low) || !((double)high - (double)low >= least))
        return 0;
    const float off = fabsf(brightness_at(image, u, v) - mean) / (high - low);
    const int smeared = !(off < (float)rules.max_centre);
    if (smeared && !(off < (float)rules.even_centre && odd_energy < (float)rules.even_odd * energy))
        return 0;
    const float middle = 0.5f * (low + high);
    int64_t rises = 0;
    for (int64_t k = 0; k < HALF; k++)
        rises += even[k + 1 < HALF ? k + 1 : 0] > middle && !(even[k] > middle);
    if (rises != 1)
        return 0;
    ring_angles(image, &rules, u, v, radius, even, angles);
    *contrast = (double)high - (double)low;
    return 1 + smeared;
}

#endif
