/* Connected regions that are brighter or darker than their surroundings, and their moments. The definition in numpy is in
 * tests/kernels/reference/blobs.py, the numbers in rigkit.detection.circles.blobs. */
#include "kernels.h"

/* A region of which some rows were visited: its sign, the rows and columns it extends over, the sums of its coordinates and of
 * their products, and the region that it is a part of (itself, if of none). */
typedef struct {
    int64_t sign, area, left, right, top, bottom, u, v, uu, uv, vv, part_of;
} region_t;

/* A run of pixels of one sign in a row: its first and last column, the region of it alone, and the whole region so far. */
typedef struct {
    int32_t first, last, own, region;
} run_t;

/* The regions of the current and the previous row; `unused` lists places for further ones. */
typedef struct {
    region_t *regions;
    int32_t *unused;
    int64_t unused_count;
} pool_t;

int64_t blobs_memory(int64_t width)
{
    return 2 * (width + 1) * (int64_t)(sizeof(region_t) + sizeof(int32_t) + sizeof(run_t));
}

/* Set `signs` to BRIGHTER where `off` is above, to DARKER where it is below the limit of its surroundings. */
enum { BRIGHTER = 1, DARKER = 2 };
INLINE void sign_row(const float *off, const float *variance, float deviations, int64_t width, uint8_t *signs)
{
#pragma omp simd
    for (int64_t u = 0; u < width; u++) {
        /* Sums of floats may be slightly negative. */
        const float limit = deviations * sqrtf(variance[u] > 0.0f ? variance[u] : 0.0f);
        signs[u] = (uint8_t)((off[u] > limit) | (off[u] < -limit) << 1);
    }
}

INLINE int32_t root_of(region_t *regions, int32_t at)
{
    while (regions[at].part_of != at)
        at = (int32_t)(regions[at].part_of = regions[regions[at].part_of].part_of);
    return at;
}

/* Add region `other` to `into`. */
INLINE void merge(region_t *into, region_t *other, int32_t name)
{
    into->area += other->area;
    into->u += other->u;
    into->v += other->v;
    into->uu += other->uu;
    into->uv += other->uv;
    into->vv += other->vv;
    into->left = into->left < other->left ? into->left : other->left;
    into->right = into->right > other->right ? into->right : other->right;
    into->top = into->top < other->top ? into->top : other->top;
    into->bottom = into->bottom > other->bottom ? into->bottom : other->bottom;
    other->part_of = name;
}

/* Return the region of a run of row v alone. */
INLINE region_t of_run(int64_t first, int64_t last, int64_t v, int64_t sign, int64_t name)
{
    const int64_t n = last - first + 1, u = n * (first + last) / 2;
    /* The sum of the squares of 0 to k is k (k + 1) (2 k + 1) / 6. */
    const int64_t before = first - 1, uu = (last * (last + 1) * (2 * last + 1) - before * (before + 1) * (2 * before + 1)) / 6;
    return (region_t){sign, n, first, last, v, v, u, n * v, uu, u * v, n * v * v, name};
}

/* Write a region that is complete if it is an ellipse off the image's border; return whether it is one. */
INLINE int written(const region_t *at, int64_t width, int64_t height, const blob_rules_t *rules, double *out)
{
    if (at->left == 0 || at->top == 0 || at->right == width - 1 || at->bottom == height - 1 || at->area < rules->min_area
        || at->area > rules->max_area)
        return 0;
    const double area = (double)at->area, u = (double)at->u / area, v = (double)at->v / area;
    /* The variance of a square pixel is 1/12. */
    const double uu = (double)at->uu / area - u * u + 1.0 / 12.0, vv = (double)at->vv / area - v * v + 1.0 / 12.0;
    const double uv = (double)at->uv / area - u * v, squared = uu * vv - uv * uv;
    const double root = sqrt(squared > 1e-12 ? squared : 1e-12), filling = area / (4.0 * PI * root);
    /* Axes with ratio r have half the trace over the root of the determinant = (r + 1 / r) / 2. */
    if (!(filling > rules->min_filling && filling < rules->max_filling
          && (uu + vv) / root < rules->max_aspect + 1.0 / rules->max_aspect))
        return 0;
    const double blob[BLOB_COLUMNS] = {u, v, uu, uv, vv, at->sign == BRIGHTER ? 1.0 : -1.0};
    memcpy(out, blob, sizeof blob);
    return 1;
}

/* Divide a row into the runs of `signs`, each of its own region or, where runs of the same sign touch it in the row before
 * (`above`), of theirs; return their number. */
INLINE int64_t
runs_of(const uint8_t *signs, int64_t width, int64_t v, const run_t *above, int64_t above_count, pool_t *pool, run_t *runs)
{
    int64_t count = 0, next = 0;
    for (int64_t u = 0; u < width;) {
        const uint8_t sign = signs[u];
        int64_t end = u + 1;
        while (end < width && signs[end] == sign)
            end++;
        if (sign != 0) {
            const int32_t name = pool->unused[--pool->unused_count];
            pool->regions[name] = of_run(u, end - 1, v, sign, name);
            while (next < above_count && above[next].last < u)
                next++;
            for (int64_t k = next; k < above_count && above[k].first < end; k++) {
                const int32_t root = root_of(pool->regions, above[k].region), own = root_of(pool->regions, name);
                if (pool->regions[root].sign == sign && root != own)
                    merge(pool->regions + root, pool->regions + own, root);
            }
            runs[count++] = (run_t){(int32_t)u, (int32_t)(end - 1), name, name};
        }
        u = end;
    }
    return count;
}

/* Release the region `name`, unless it goes on in row v or was released before; return it if it is complete, else NULL. */
INLINE const region_t *released(pool_t *pool, int32_t name, int64_t v)
{
    region_t *at = pool->regions + name;
    const int whole = at->part_of == name;
    if (at->part_of < 0 || (whole && at->bottom == v))
        return NULL;
    at->part_of = -1;
    pool->unused[pool->unused_count++] = name;
    return whole ? at : NULL;
}

/* Find the blobs of an image minus its local mean, `off`, whose `variance` is that of its surroundings (reference.blobs); return
 * their number. */
FOR_EACH_PROCESSOR
int64_t find_blobs(
    const float *off, const float *variance, int64_t height, int64_t width, const blob_rules_t *rules, uint8_t *signs,
    uint8_t *memory, double *out)
{
    const int64_t room = 2 * (width + 1);
    pool_t pool = {.regions = (region_t *)memory, .unused_count = room};
    run_t *runs = (run_t *)(pool.regions + room), *above = runs + width + 1;
    pool.unused = (int32_t *)(runs + room);
    for (int64_t k = 0; k < room; k++)
        pool.unused[k] = (int32_t)(room - 1 - k);
    int64_t found = 0, count = 0, above_count = 0;
    for (int64_t v = 0; v <= height; v++) {
        run_t *swap = above;
        above = runs;
        runs = swap;
        above_count = count;
        count = 0;
        if (v < height) {
            sign_row(off + v * width, variance + v * width, (float)rules->deviations, width, signs);
            count = runs_of(signs, width, v, above, above_count, &pool, runs);
        }
        for (int64_t k = 0; k < count; k++)
            runs[k].region = root_of(pool.regions, runs[k].region);
        for (int64_t k = 0; k < above_count; k++) {
            const region_t *complete = released(&pool, above[k].region, v);
            if (complete)
                found += written(complete, width, height, rules, out + BLOB_COLUMNS * found);
        }
        for (int64_t k = 0; k < count; k++)
            released(&pool, runs[k].own, v);
    }
    return found;
}
