/* The edge model along one line of a corner, and what lies beyond its ends, over a block of pixels: for edges_model.c. */
#ifndef RIGKIT_EDGES_LINES_H
#define RIGKIT_EDGES_LINES_H

#include "edges.h"

/* A line through the corner as float32 arithmetic wants it. A sharp edge is two of less `width`, `apart` to either side;
 * `stretch` is s / width (reference.edges._edge). */
typedef struct {
    float cosine, sine, curvature, before, after, tilt_before, tilt_after;
    float blur, width, stretch, apart, kurtosis;
    float paper_before, paper_after;
    int tight, sharp, ends_before, ends_after;
} line_t;

/* The model along one line over a block of pixels: the step, its derivatives, -s dS/ds, and the pixel's place. */
typedef struct {
    float value[BLOCK], slope[BLOCK], bow[BLOCK], curl[BLOCK], grown[BLOCK], along[BLOCK], lateral[BLOCK];
} edge_t;

/* What lies beyond the outer squares of one line over a block of pixels: how much of it a pixel sees, and that times how
 * bright it is; the derivatives of both, and -s d/ds. */
typedef struct {
    float seen[BLOCK], seen_slope[BLOCK], seen_grown[BLOCK], paper[BLOCK], slope[BLOCK], grown[BLOCK];
} beyond_t;

/* Beyond so many s an edge is flat to float32; the exponential below needs a limit. */
#define FLAT_SIGMAS 12.0f

/* Beyond so many s the step lacks a part in 10^8, which float32 does not hold, and its slopes are less than that: blocks of such
 * pixels, as rows above and below a line have, are not evaluated. */
#define FLAT_BLOCK 6.0f

INLINE int all_beyond(const int size, const float *x)
{
    int32_t near = 0;
    for (int i = 0; i < size; i++)
        near |= !(x[i] > FLAT_BLOCK || x[i] < -FLAT_BLOCK);
    return !near;
}

INLINE line_t line_of(
    double angle, double curvature, const double gaps[2], const double tilts[2], const double paper[2], double blur,
    const edge_rules_t *rules)
{
    const double cosine = cos(angle), sine = sin(angle), c2 = cosine * cosine, s2 = sine * sine, b2 = blur * blur;
    const double flat = rules->pixel_kurtosis * (c2 * c2 + s2 * s2);
    const int sharp = blur < rules->sharp_blur;
    const double apart = sharp ? sqrt(sqrt(-0.5 * flat)) : 0.0, width = sqrt(b2 - apart * apart);
    const double nearest = gaps[0] < gaps[1] ? gaps[0] : gaps[1];
    const int before = isfinite(paper[0]), after = isfinite(paper[1]);
    return (line_t){
        .cosine = (float)cosine,
        .sine = (float)sine,
        .curvature = (float)curvature,
        .before = (float)gaps[0],
        .after = (float)gaps[1],
        .tilt_before = (float)tilts[0],
        .tilt_after = (float)tilts[1],
        .blur = (float)blur,
        .width = (float)width,
        .stretch = (float)(blur / width),
        .apart = (float)apart,
        .kurtosis = sharp ? 0.0f : (float)(flat / (b2 * b2)),
        .paper_before = before ? (float)paper[0] : 0.0f,
        .paper_after = after ? (float)paper[1] : 0.0f,
        .tight = before || after || nearest * (1.0 - rules->reach) < rules->tail_sigmas * blur,
        .sharp = sharp,
        .ends_before = before,
        .ends_after = after};
}

INLINE float cut(float at)
{
    const float most = at < FLAT_SIGMAS ? at : FLAT_SIGMAS;
    return most > -FLAT_SIGMAS ? most : -FLAT_SIGMAS;
}

/* Add an edge of which all `size` pixels are far on one or the other side. */
INLINE void add_flat(const int size, const float *x, float part, const int first, edge_t *out)
{
    for (int i = 0; i < size; i++)
        out->value[i] = (first ? 0.0f : out->value[i]) + (x[i] > 0.0f ? part : -part);
    for (int i = 0; first && i < size; i++)
        out->slope[i] = out->bow[i] = out->curl[i] = out->grown[i] = 0.0f;
}

/* reference.edges._edge, `shift` back from the line and turned by `tilt`, with weight `part`: set `out` to it if it is the
 * `first`, else add it. Distances have a loop of their own: mixed with what follows, their limits become branches that keep the
 * compiler from vectorising. */
INLINE void add_edge(const int size, const line_t line, float shift, float tilt, float part, const int first, edge_t *out)
{
    float x[BLOCK], y[BLOCK];
    const float per_width = 1.0f / line.width, apart = line.apart;
    for (int i = 0; i < size; i++) {
        const float along = out->along[i];
        const float bend = 0.5f * line.curvature * (along * along + line.blur * line.blur);
        const float at = out->lateral[i] - bend - tilt * along + shift;
        x[i] = cut((at - apart) * per_width);
        y[i] = cut((at + apart) * per_width);
    }
    if (all_beyond(size, x) && all_beyond(size, y)) {
        add_flat(size, y, part, first, out);
        return;
    }
    const float share = line.sharp ? 0.5f * part : part;
    const float once = share * line.stretch, twice = once * line.stretch, thrice = twice * line.stretch;
    if (line.sharp)
        for (int i = 0; i < size; i++) {
            float one[5], two[5];
            any_edge(x[i], 1, 0.0f, one);
            any_edge(y[i], 1, 0.0f, two);
            out->value[i] = (first ? 0.0f : out->value[i]) + share * (one[0] + two[0]);
            out->slope[i] = (first ? 0.0f : out->slope[i]) + once * (one[1] + two[1]);
            out->bow[i] = (first ? 0.0f : out->bow[i]) + twice * (one[2] + two[2]);
            out->curl[i] = (first ? 0.0f : out->curl[i]) + thrice * (one[3] + two[3]);
            out->grown[i] = (first ? 0.0f : out->grown[i]) + twice * (one[4] + two[4]);
        }
    else
        for (int i = 0; i < size; i++) {
            float edge[5];
            any_edge(x[i], 0, line.kurtosis, edge);
            out->value[i] = (first ? 0.0f : out->value[i]) + share * edge[0];
            out->slope[i] = (first ? 0.0f : out->slope[i]) + once * edge[1];
            out->bow[i] = (first ? 0.0f : out->bow[i]) + twice * edge[2];
            out->curl[i] = (first ? 0.0f : out->curl[i]) + thrice * edge[3];
            out->grown[i] = (first ? 0.0f : out->grown[i]) + twice * edge[4];
        }
}

/* Evaluate one line over a block of pixels at (u, v) from the window's centre (reference.edges._step). */
INLINE void along_line(const int size, const line_t line, const float *u, const float *v, float x, float y, edge_t *out)
{
    for (int i = 0; i < size; i++) {
        out->along[i] = line.cosine * (u[i] - x) + line.sine * (v[i] - y);
        out->lateral[i] = line.cosine * (v[i] - y) - line.sine * (u[i] - x);
    }
    add_edge(size, line, 0.0f, 0.0f, 1.0f, 1, out);
    if (line.tight) {
        /* Squares go on beyond the next line the other way round; of paper the pattern is nothing. */
        const float before = line.ends_before ? 0.5f : 1.0f, after = line.ends_after ? 0.5f : 1.0f;
        add_edge(size, line, line.before, line.tilt_before, -before, 0, out);
        add_edge(size, line, -line.after, line.tilt_after, -after, 0, out);
        for (int i = 0; i < size; i++)
            out->value[i] += before - after;
    }
    for (int i = 0; i < size; i++)
        out->grown[i] += line.curvature * line.blur * out->slope[i];
}

/* Add what lies beyond the line `shift` back from `line`, turned by `tilt`, on the side where `way` times the distance grows. */
INLINE void add_paper(
    const int size, const line_t line, float shift, float tilt, float way, float paper, const edge_t *at, beyond_t *out)
{
    edge_t edge;
    for (int i = 0; i < size; i++) {
        edge.along[i] = at->along[i];
        edge.lateral[i] = at->lateral[i];
    }
    add_edge(size, line, shift, tilt, 1.0f, 1, &edge);
    const float half = 0.5f * way;
    for (int i = 0; i < size; i++) {
        const float seen = 0.5f + half * edge.value[i], slope = half * edge.slope[i];
        const float grown = half * (edge.grown[i] + line.curvature * line.blur * edge.slope[i]);
        out->seen[i] += seen;
        out->seen_slope[i] += slope;
        out->seen_grown[i] += grown;
        out->paper[i] += paper * seen;
        out->slope[i] += paper * slope;
        out->grown[i] += paper * grown;
    }
}

/* Evaluate what lies beyond the ends of one line whose `at` is known (reference.edges._beyond). */
INLINE void beyond_line(const int size, const line_t line, const edge_t *at, beyond_t *out)
{
    memset(out, 0, sizeof *out);
    if (line.ends_before)
        add_paper(size, line, line.before, line.tilt_before, -1.0f, line.paper_before, at, out);
    if (line.ends_after)
        add_paper(size, line, -line.after, line.tilt_after, 1.0f, line.paper_after, at, out);
}

#endif
