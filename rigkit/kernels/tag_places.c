/* Positions on a board of the tags between the corners of a lattice. The definitions in numpy are in
 * tests/kernels/reference/tag_board.py. */
#include "kernels.h"

/* Set `quads` to the corners of those squares of a lattice (rows, columns) whose row and column together are `odd`, or not, in
 * order of growing angle from u to v, and `cells` to the (column, row) of their first corner; return their number. */
int64_t squares_of_lattice(const double *pixels, int64_t rows, int64_t columns, int64_t odd, double *quads, int64_t *cells)
{
    int64_t count = 0;
    for (int64_t row = 0; row + 1 < rows; row++)
        for (int64_t column = (row + odd) % 2; column + 1 < columns; column += 2) {
            const double *upper = pixels + 2 * (row * columns + column), *lower = upper + 2 * columns;
            double *quad = quads + 8 * count;
            memcpy(quad, upper, 4 * sizeof(double));
            memcpy(quad + 4, lower + 2, 2 * sizeof(double));
            memcpy(quad + 6, lower, 2 * sizeof(double));
            cells[2 * count] = column;
            cells[2 * count + 1] = row;
            count += isfinite(quad[0]) && isfinite(quad[2]) && isfinite(quad[4]) && isfinite(quad[6]);
        }
    return count;
}

/* Whether the first (turns, columns, rows) comes before the other. */
INLINE int is_before(const int64_t *one, const int64_t *other)
{
    for (int k = 0; k < 2; k++)
        if (one[k] != other[k])
            return one[k] < other[k];
    return one[2] < other[2];
}

/* Set `place` to the quarter turns and the shift that map most of the tags at `cells` of a lattice of `columns` x `rows` corners,
 * rotated by `turns` relative to it, to their `places` on the board, the lowest of several; return the number that agrees. */
int64_t vote_place(
    const int64_t *cells, const int64_t *turns, const int64_t *places, int64_t count, int64_t columns, int64_t rows,
    int64_t *scratch, int64_t *place)
{
    int64_t most = 0;
    for (int64_t n = 0; n < count; n++) {
        /* A tag that is upright in the lattice rotated back is upright on the board. There is one square less than corners. */
        const int64_t back = (4 - turns[n] % 4) % 4;
        int64_t column = cells[2 * n], row = cells[2 * n + 1], wide = columns - 1, high = rows - 1;
        for (int64_t turn = 0; turn < back; turn++) {
            const int64_t before = column, across = wide;
            column = high - 1 - row;
            row = before;
            wide = high;
            high = across;
        }
        int64_t *own = scratch + 3 * n, votes = 0;
        own[0] = back;
        own[1] = places[2 * n] - column;
        own[2] = places[2 * n + 1] - row;
        for (int64_t k = 0; k <= n; k++)
            votes += own[0] == scratch[3 * k] && own[1] == scratch[3 * k + 1] && own[2] == scratch[3 * k + 2];
        /* The last entry of a place has its number of votes. */
        if (votes > most || (votes == most && is_before(own, place))) {
            most = votes;
            memcpy(place, own, 3 * sizeof(int64_t));
        }
    }
    return most;
}
