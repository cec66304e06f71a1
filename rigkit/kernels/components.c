/* Connected components of linked corners as lattices, with a column and a row for each corner. The definitions in numpy are in
 * tests/kernels/reference/growth.py and links.py. */
#include "kernels.h"

/* Links are states: state 4 * corner + arm leads to state 4 * neighbour + the neighbour's arm that points back, or to -1. */
static int compare(const void *one, const void *two)
{
    const int64_t a = *(const int64_t *)one, b = *(const int64_t *)two;
    return (a > b) - (a < b);
}

/* Keep the links that are a side of a closed square (reference.links.quads). */
static void keep_quads(int64_t count, int64_t *to, uint8_t *bound)
{
    memset(bound, 0, (size_t)(4 * count));
    for (int64_t start = 0; start < 4 * count; start++) {
        int64_t state = start;
        for (int step = 0; step < 4 && state >= 0; step++)
            state = to[state] < 0 ? -1 : to[state] / 4 * 4 + (to[state] + 3) % 4;
        if (state == start)
            bound[start] = bound[to[start]] = 1;
    }
    for (int64_t state = 0; state < 4 * count; state++)
        if (!bound[state])
            to[state] = -1;
}

enum { UNSEEN = -2, ALONE = -1 };

/* The lattices found so far: for every corner the index of its lattice, its column and row, and its arm that points to +column;
 * `members` lists the corners lattice by lattice. */
typedef struct {
    const int64_t *to;
    int64_t *label, *grid, *turn, *members, listed;
} lattices_t;

/* List all corners that are connected with `start`; return the one with the most links, of several the first. */
static int64_t list_linked(lattices_t *at, int64_t start, int64_t lattice)
{
    const int64_t first = at->listed;
    int64_t root = start, most = 0;
    at->members[at->listed++] = start;
    at->label[start] = lattice;
    for (int64_t k = first; k < at->listed; k++) {
        const int64_t member = at->members[k];
        int64_t degree = 0;
        for (int arm = 0; arm < 4; arm++) {
            if (at->to[4 * member + arm] < 0)
                continue;
            degree++;
            const int64_t end = at->to[4 * member + arm] / 4;
            if (at->label[end] == UNSEEN) {
                at->label[end] = lattice;
                at->members[at->listed++] = end;
            }
        }
        if (degree > most || (degree == most && member < root)) {
            most = degree;
            root = member;
        }
    }
    return root;
}

/* Set column and row of the corners connected with `root` by breadth-first search; corners that have them are labelled
 * `lattice`. */
static void place_linked(lattices_t *at, int64_t root, int64_t lattice, int64_t *frontier, int64_t *next)
{
    static const int64_t step_c[4] = {1, 0, -1, 0}, step_r[4] = {0, 1, 0, -1};
    frontier[0] = root;
    at->label[root] = lattice;
    for (int64_t size = 1, added = 0; size; size = added) {
        added = 0;
        for (int64_t k = 0; k < size; k++)
            for (int64_t arm = 0; arm < 4; arm++) {
                const int64_t start = frontier[k], state = at->to[4 * start + arm];
                if (state < 0 || at->label[state / 4] != UNSEEN)
                    continue;
                const int64_t end = state / 4, direction = (arm - at->turn[start] + 4) % 4;
                at->label[end] = lattice;
                at->grid[2 * end] = at->grid[2 * start] + step_c[direction];
                at->grid[2 * end + 1] = at->grid[2 * start + 1] + step_r[direction];
                at->turn[end] = (state % 4 - direction + 6) % 4;
                next[added++] = end;
            }
        qsort(next, (size_t)added, sizeof(int64_t), compare);
        int64_t *swap = frontier;
        frontier = next;
        next = swap;
    }
}

/* Set column and row of every linked corner, and its arm that points to +column (reference.growth._walk); return the number of
 * lattices. `label` is -1 for corners without links; `members` lists the corners lattice by lattice. `queue` (2 * count) is
 * scratch. */
static int64_t walk(
    int64_t count, const int64_t *to, int64_t *label, int64_t *grid, int64_t *turn, int64_t *members, int64_t *queue)
{
    lattices_t at = {to, label, grid, turn, members, 0};
    int64_t lattices = 0;
    for (int64_t i = 0; i < count; i++) {
        label[i] = to[4 * i] >= 0 || to[4 * i + 1] >= 0 || to[4 * i + 2] >= 0 || to[4 * i + 3] >= 0 ? UNSEEN : ALONE;
        grid[2 * i] = grid[2 * i + 1] = turn[i] = 0;
    }
    for (int64_t i = 0; i < count; i++) {
        if (label[i] != UNSEEN)
            continue;
        const int64_t first = at.listed, root = list_linked(&at, i, lattices);
        for (int64_t k = first; k < at.listed; k++)
            label[members[k]] = UNSEEN;
        place_linked(&at, root, lattices, queue, queue + count);
        for (int64_t k = first; k < at.listed; k++)
            if (label[members[k]] == UNSEEN)
                label[members[k]] = ALONE; /* Cannot happen, as links are mutual; then the corner would be listed twice. */
        lattices++;
    }
    return lattices;
}

/* Find the lattices of the links `to` (count, 4), of which those of no square are removed (reference.growth.components_of); return
 * their number. label, grid (count, 2), turn and members as in `walk`; `queue` (2 * count) and `bound` (4 * count) are scratch. */
int64_t find_components(
    int64_t count, int64_t *to, int64_t *label, int64_t *grid, int64_t *turn, int64_t *members, int64_t *queue, uint8_t *bound)
{
    keep_quads(count, to, bound);
    return walk(count, to, label, grid, turn, members, queue);
}
