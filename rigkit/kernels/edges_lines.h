/* The edge model of one line of a corner, and of the paper beyond the ends of the board, over a block of pixels; for
 * edges_model.c. */
#ifndef RIGKIT_EDGES_LINES_H
#define RIGKIT_EDGES_LINES_H

#include "edges.h"

/* A line through the corner in float32. A sharp edge is modelled by two edges of the smaller blur `width`, `apart` to either side
 * of it; `stretch` is s / width (reference.edge_model._edge). */
typedef struct {
    float cosine, sine, curvature, before, after, tilt_before, tilt_after;
    float blur, width, stretch, apart, kurtosis;
    float paper_before, paper_after;
    int tight, sharp, ends_before, ends_after;
} line_t;

/* The model of one line over a block of pixels: the step, its first to third derivatives by the distance over s (`slope`, `bow`,
 * `curl`), -s dS/ds (`grown`), and the pixel's coordinates along the line and across it. */
typedef struct {
    float value[BLOCK], slope[BLOCK], bow[BLOCK], curl[BLOCK], grown[BLOCK], along[BLOCK], lateral[BLOCK];
} edge_t;

/* The paper beyond the outer squares of one line over a block of pixels: its share of a pixel (`seen`), that share times its
 * brightness (`paper`), the derivatives of both by the distance over s, and -s d/ds of both. */
typedef struct {
    float seen[BLOCK], seen_slope[BLOCK], seen_grown[BLOCK], paper[BLOCK], slope[BLOCK], grown[BLOCK];
} beyond_t;

/* Distances in s are clipped to this, beyond which an edge is constant in float32: `decay` has a limited range. */
#define FLAT_SIGMAS 12.0f

/* Beyond this distance in s the step is constant to 1e-8, below the precision of float32, and its derivatives are smaller: blocks
 * whose pixels are all further from a line are not evaluated. */
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

/* Add an edge that is further than FLAT_BLOCK from all `size` pixels. */
INLINE void add_flat(const int size, const float *x, float part, const int first, edge_t *out)
{
    for (int i = 0; i < size; i++)
        out->value[i] = (first ? 0.0f : out->value[i]) + (x[i] > 0.0f ? part : -part);
    for (int i = 0; first && i < size; i++)
        out->slope[i] = out->bow[i] = out->curl[i] = out->grown[i] = 0.0f;
}

/* Set `out` to an edge (reference.edge_model._edge) with weight `part`, `shift` px before the line and turned by `tilt`, if it is
 * the `first`, else add it. The distances are computed in a loop of their own: otherwise their clipping becomes branches, which
 * prevent vectorisation. */
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

/* Evaluate one line over a block of pixels at (u, v) from the window's centre (reference.edge_model._step). */
INLINE void along_line(const int size, const line_t line, const float *u, const float *v, float x, float y, edge_t *out)
{
    for (int i = 0; i < size; i++) {
        out->along[i] = line.cosine * (u[i] - x) + line.sine * (v[i] - y);
        out->lateral[i] = line.cosine * (v[i] - y) - line.sine * (u[i] - x);
    }
    add_edge(size, line, 0.0f, 0.0f, 1.0f, 1, out);
    if (line.tight) {
        /* Beyond the neighbouring lines the squares change their colour; the pattern of paper is 0. */
        const float before = line.ends_before ? 0.5f : 1.0f, after = line.ends_after ? 0.5f : 1.0f;
        add_edge(size, line, line.before, line.tilt_before, -before, 0, out);
        add_edge(size, line, -line.after, line.tilt_after, -after, 0, out);
        for (int i = 0; i < size; i++)
            out->value[i] += before - after;
    }
    for (int i = 0; i < size; i++)
        out->grown[i] += line.curvature * line.blur * out->slope[i];
}

/* Add the paper beyond the line that is `shift` px before `line` and turned by `tilt`; `way` is +1 or -1, the sign of the distance
 * of the paper's side. */
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

/* Evaluate the paper beyond the ends of the board at the coordinates `at` (reference.edge_model._beyond). */
INLINE void beyond_line(const int size, const line_t line, const edge_t *at, beyond_t *out)
{
    memset(out, 0, sizeof *out);
    if (line.ends_before)
        add_paper(size, line, line.before, line.tilt_before, -1.0f, line.paper_before, at, out);
    if (line.ends_after)
        add_paper(size, line, -line.after, line.tilt_after, 1.0f, line.paper_after, at, out);
}

#endif
