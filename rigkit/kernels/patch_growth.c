/* Pairs of patches grown over a surface from neighbour to neighbour, the best first (Otto and Chau, "Region-growing algorithm for
 * matching of terrain images", 1989). */
#include "patches.h"

/* A binary heap of the nodes whose neighbours are to be tried, the best correlation on top. */
typedef struct {
    const double *out;
    int32_t *nodes;
    int64_t count;
} heap_t;

INLINE double rank_of(const heap_t *heap, int64_t place)
{
    return heap->out[(int64_t)PATCH_COLUMNS * heap->nodes[place] + 6];
}

INLINE void swap_nodes(heap_t *heap, int64_t a, int64_t b)
{
    const int32_t node = heap->nodes[a];
    heap->nodes[a] = heap->nodes[b];
    heap->nodes[b] = node;
}

static void push_node(heap_t *heap, int32_t node)
{
    int64_t at = heap->count++;
    heap->nodes[at] = node;
    for (; at > 0 && rank_of(heap, at) > rank_of(heap, (at - 1) / 2); at = (at - 1) / 2)
        swap_nodes(heap, at, (at - 1) / 2);
}

static int32_t pop_node(heap_t *heap)
{
    const int32_t best = heap->nodes[0];
    heap->nodes[0] = heap->nodes[--heap->count];
    for (int64_t at = 0;;) {
        int64_t next = 2 * at + 1;
        if (next + 1 < heap->count && rank_of(heap, next + 1) > rank_of(heap, next))
            next++;
        if (next >= heap->count || rank_of(heap, next) <= rank_of(heap, at))
            return best;
        swap_nodes(heap, at, next);
        at = next;
    }
}

/* Align the pair `place` at its node; return 1 and write it if it is good. */
INLINE int try_node(
    const pyramid_t *first, const pyramid_t *second, const epipolar_t *epipolar, const patch_rules_t *rules,
    const patch_grid_t *grid, int64_t node, patch_t *patch, place_t *place)
{
    line_t line = {.geometry = epipolar};
    const double *ray = grid->rays1 + 3 * node, *by = grid->jacobians1 + 6 * node;
    if (!isfinite(ray[0]))
        return 0;
    for (int64_t n = 0; n < 3; n++) {
        const double *E = epipolar->E21 + 3 * n;
        line.line[n] = E[0] * ray[0] + E[1] * ray[1] + E[2] * ray[2];
        for (int64_t k = 0; k < 2; k++)
            line.by_pixel[n][k] = E[0] * by[k] + E[1] * by[2 + k] + E[2] * by[4 + k];
    }
    const int knows = isfinite(epipolar->sigma), gated = isfinite(epipolar->max_distance);
    double found[PATCH_COLUMNS], n2[2], distance, off[2];
    grid->tries[node]++;
    if (gated && !(miss(&line, place, n2, &distance, off) && fabs(distance) < epipolar->max_distance + rules->max_move))
        return 0;
    if (!align_pair(first, second, rules, knows ? &line : NULL, patch, place, found))
        return 0;
    if (gated && !(miss(&line, place, n2, &distance, off) && fabs(distance) < epipolar->max_distance))
        return 0;
    memcpy(grid->out + PATCH_COLUMNS * node, found, sizeof found);
    return 1;
}

/* Grow pairs over the nodes of image 1 from `seeds` (as the starts of `align_patches`), the best first; `out` is NaN at nodes
 * without a pair. Return the number of pairs. */
FOR_EACH_PROCESSOR int64_t grow_patches(
    const pyramid_t *first, const pyramid_t *second, const epipolar_t *epipolar, const patch_rules_t *rules,
    const patch_grid_t *grid, const double *seeds, int64_t count)
{
    patch_t patch;
    make_window(rules, &patch);
    const int64_t nodes = grid->rows * grid->columns;
    const double step = (double)grid->step;
    heap_t heap = {grid->out, grid->heap, 0};
    memset(grid->tries, 0, (size_t)nodes);
    for (int64_t k = 0; k < nodes * PATCH_COLUMNS; k++)
        grid->out[k] = NAN;
    int64_t grown = 0;
    for (int64_t k = 0; k < count; k++) {
        const double *at = seeds + 8 * k;
        const int64_t column = (int64_t)floor(at[0] / step + 0.5), row = (int64_t)floor(at[1] / step + 0.5);
        if (column < 0 || row < 0 || column >= grid->columns || row >= grid->rows)
            continue;
        const int64_t node = row * grid->columns + column;
        if (isfinite(grid->out[PATCH_COLUMNS * node]))
            continue;
        const double u = step * (double)column - at[0], v = step * (double)row - at[1];
        place_t place = {
            step * (double)column,
            step * (double)row,
            at[2] + at[4] * u + at[5] * v,
            at[3] + at[6] * u + at[7] * v,
            {at[4], at[5], at[6], at[7]}};
        if (try_node(first, second, epipolar, rules, grid, node, &patch, &place)) {
            push_node(&heap, (int32_t)node);
            grown++;
        }
        /* A failed seed does not count as a try of its node. */
        grid->tries[node] = 0;
    }
    while (heap.count > 0) {
        const int64_t node = pop_node(&heap), row = node / grid->columns, column = node % grid->columns;
        const double *at = grid->out + PATCH_COLUMNS * node;
        for (int64_t way = 0; way < 4; way++) {
            const int64_t du = way == 0 ? 1 : way == 1 ? -1 : 0, dv = way == 2 ? 1 : way == 3 ? -1 : 0;
            const int64_t next = (row + dv) * grid->columns + column + du;
            if (row + dv < 0 || row + dv >= grid->rows || column + du < 0 || column + du >= grid->columns)
                continue;
            if (grid->tries[next] >= grid->max_tries || isfinite(grid->out[PATCH_COLUMNS * next]))
                continue;
            const double u = step * (double)du, v = step * (double)dv;
            place_t place = {
                step * (double)(column + du),
                step * (double)(row + dv),
                at[0] + at[2] * u + at[3] * v,
                at[1] + at[4] * u + at[5] * v,
                {at[2], at[3], at[4], at[5]}};
            if (try_node(first, second, epipolar, rules, grid, next, &patch, &place)) {
                push_node(&heap, (int32_t)next);
                grown++;
            }
        }
    }
    return grown;
}
