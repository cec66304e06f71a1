/* Pairs of points that are close to each other. */
#include "kernels.h"

static int are_close(const double *one, const double *other, int64_t axes, double reach)
{
    for (int64_t k = 0; k < axes; k++)
        if (!(fabs(one[k] - other[k]) <= reach))
            return 0;
    return 1;
}

/* List in `pairs` the pairs (i, j) of points that differ by at most `reach` along every axis, with j in one of the two ranges of
 * `ends` of i; return their number, which may exceed `capacity`: then only so many are listed. */
EXPORT int64_t
close_pairs(const double *points, int64_t count, int64_t axes, double reach, const int64_t *ends, int64_t *pairs, int64_t capacity)
{
    int64_t found = 0;
    for (int64_t i = 0; i < count; i++)
        for (int64_t run = 0; run < 2; run++)
            for (int64_t j = ends[4 * i + 2 * run]; j < ends[4 * i + 2 * run + 1]; j++) {
                if (!are_close(points + axes * i, points + axes * j, axes, reach))
                    continue;
                if (found < capacity) {
                    pairs[2 * found] = i;
                    pairs[2 * found + 1] = j;
                }
                found++;
            }
    return found;
}
