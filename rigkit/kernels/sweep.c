/* A sweep over ranges: the matching cost of two images at each (census transform: Zabih and Woodfill, "Non-parametric local
 * transforms for computing visual correspondence", 1994), and its semi-global aggregation along eight paths (Hirschmueller, "Stereo
 * processing by semiglobal matching and mutual information", 2008).
 *
 * The definitions in numpy are in tests/kernels/reference/sweep.py. */
#include "kernels.h"

enum { CENSUS_REACH = 2, BAND = 16, SIDE_BYTES = 8 };

/* Cost of the levels that pad the arrays, above that of any path. */
enum { NO_LEVEL = 128 };

/* Return the number of levels with their padding to vectors of 16. */
int64_t sweep_levels(int64_t levels)
{
    return (levels + 15) / 16 * 16;
}

/* Write the census transform of the inner `rows` x `columns` samples of `from`, (rows + 4) x (columns + 4): a bit for each
 * neighbour, 1 if it is darker. */
INLINE void take_census(const float *from, int64_t rows, int64_t columns, uint32_t *out)
{
    const int64_t wide = columns + 2 * CENSUS_REACH;
    memset(out, 0, (size_t)(rows * columns) * sizeof *out);
    for (int64_t row = 0; row < rows; row++) {
        const float *centre = from + (row + CENSUS_REACH) * wide + CENSUS_REACH;
        uint32_t *bits = out + row * columns;
        for (int64_t j = -CENSUS_REACH; j <= CENSUS_REACH; j++) {
            for (int64_t i = -CENSUS_REACH; i <= CENSUS_REACH; i++) {
                const float *lateral = centre + j * wide + i;
                if (i == 0 && j == 0)
                    continue;
#pragma omp simd
                for (int64_t k = 0; k < columns; k++)
                    bits[k] = (bits[k] << 1) | (uint32_t)(lateral[k] < centre[k]);
            }
        }
    }
}

/* Read image 2 at the pixels of a row of samples at one level; NaN outside the field of view or the image. */
INLINE void read_row(const sweep_t *sweep, const image_t image2, int64_t level, int64_t row, float *out)
{
    const int64_t columns = sweep->columns, spacing = sweep->spacing, wide = sweep->table_columns;
    const int64_t above = row / spacing;
    const float *upper = sweep->table + 2 * (level * sweep->table_rows + above) * wide;
    const float *lower = above + 1 < sweep->table_rows ? upper + 2 * wide : upper;
    const float down = (float)(row - above * spacing) / (float)spacing;
    const float max_u = (float)(image2.width - 1), max_v = (float)(image2.height - 1);
    for (int64_t left = 0; left * spacing < columns; left++) {
        const int64_t right = left + 1 < wide ? left + 1 : left;
        float start[2], end[2];
        for (int64_t k = 0; k < 2; k++) {
            start[k] = upper[2 * left + k] + down * (lower[2 * left + k] - upper[2 * left + k]);
            end[k] = upper[2 * right + k] + down * (lower[2 * right + k] - upper[2 * right + k]);
        }
        const int64_t count = spacing < columns - left * spacing ? spacing : columns - left * spacing;
        for (int64_t k = 0; k < count; k++) {
            const float along = (float)k / (float)spacing;
            const float u = start[0] + along * (end[0] - start[0]), v = start[1] + along * (end[1] - start[1]);
            const int inside = u >= 0.0f && v >= 0.0f && u <= max_u && v <= max_v;
            out[left * spacing + k] = inside ? brightness_at(image2, u, v) : NAN;
        }
    }
}

INLINE void fill(float *at, int64_t count, float value)
{
    for (int64_t k = 0; k < count; k++)
        at[k] = value;
}

int64_t sweep_cost_memory(int64_t columns)
{
    return (BAND + 2 * CENSUS_REACH) * (columns + 2 * CENSUS_REACH) + 2 * BAND * columns;
}

/* Write the Hamming distance of the census transforms of `samples1` and of image 2 at each level, half of the bits outside image 2.
 * The rows are processed in bands, whose costs stay in the cache from level to level. */
FOR_EACH_PROCESSOR void sweep_costs(
    const sweep_t *sweep, const image_t *image2, const float *samples1, float *memory, uint8_t *costs)
{
    const int64_t columns = sweep->columns, rows = sweep->rows, wide = columns + 2 * CENSUS_REACH;
    const int64_t padded = sweep_levels(sweep->levels);
    float *around = memory;
    uint32_t *first = (uint32_t *)(memory + (BAND + 2 * CENSUS_REACH) * wide), *second = first + BAND * columns;
    for (int64_t top = 0; top < rows; top += BAND) {
        const int64_t count = BAND < rows - top ? BAND : rows - top;
        for (int64_t level = -1; level < sweep->levels; level++) {
            /* Neighbours beyond the border count as not darker. */
            fill(around, (count + 2 * CENSUS_REACH) * wide, INFINITY);
            for (int64_t j = -CENSUS_REACH; j < count + CENSUS_REACH; j++) {
                const int64_t row = top + j;
                float *line = around + (j + CENSUS_REACH) * wide + CENSUS_REACH;
                if (row < 0 || row >= rows)
                    continue;
                if (level < 0)
                    memcpy(line, samples1 + row * columns, (size_t)columns * sizeof *line);
                else
                    read_row(sweep, *image2, level, row, line);
            }
            take_census(around, count, columns, level < 0 ? first : second);
            for (int64_t j = 0; j < count && level >= 0; j++) {
                const float *line = around + (j + CENSUS_REACH) * wide + CENSUS_REACH;
                uint8_t *out = costs + (top + j) * columns * padded + level;
                for (int64_t k = 0; k < columns; k++) {
                    const uint32_t differing = first[j * columns + k] ^ second[j * columns + k];
                    out[k * padded] = line[k] == line[k] ? (uint8_t)__builtin_popcount(differing) : CENSUS_BITS / 2;
                }
            }
        }
        for (int64_t k = top * columns; k < (top + count) * columns; k++)
            for (int64_t level = sweep->levels; level < padded; level++)
                costs[k * padded + level] = NO_LEVEL;
    }
}

/* Take one step of a path: set `now` to the cost of each level plus the smallest cost of a transition from the previous sample
 * (`came`, with minimum `least`), minus that minimum, and add it to `total`; return the minimum of `now`. */
INLINE uint8_t follow(
    const uint8_t *restrict came, uint8_t least, uint8_t jump, uint8_t bend, const uint8_t *restrict cost, uint8_t *restrict now,
    uint16_t *restrict total, int64_t levels)
{
    const uint8_t far = (uint8_t)(least + jump);
    uint8_t low = 255;
    for (int64_t k = 0; k < levels; k += 16) {
#pragma omp simd
        for (int64_t n = 0; n < 16; n++) {
            const uint8_t before = came[k + n - 1], after = came[k + n + 1], same = came[k + n];
            const uint8_t side = (uint8_t)((before < after ? before : after) + bend);
            const uint8_t near = same < side ? same : side;
            now[k + n] = (uint8_t)((uint8_t)((near < far ? near : far) - least) + cost[k + n]);
        }
#pragma omp simd
        for (int64_t n = 0; n < 16; n++)
            total[k + n] = (uint16_t)(total[k + n] + now[k + n]);
    }
#pragma omp simd reduction(min : low)
    for (int64_t k = 0; k < levels; k++)
        low = now[k] < low ? now[k] : low;
    return low;
}

/* Start a path at the border: as `follow` without a previous sample. */
INLINE uint8_t begin(const uint8_t *restrict cost, uint8_t *restrict now, uint16_t *restrict total, int64_t levels)
{
    uint8_t low = 255;
    for (int64_t k = 0; k < levels; k++) {
        now[k] = cost[k];
        total[k] = (uint16_t)(total[k] + cost[k]);
        low = cost[k] < low ? cost[k] : low;
    }
    return low;
}

/* Bytes of a path's costs at a sample: their minimum, and from byte SIDE_BYTES on the levels, with NO_LEVEL on both sides. */
#define PATH_BYTES(padded) ((padded) + 2 * SIDE_BYTES)

int64_t sweep_path_memory(int64_t columns, int64_t levels)
{
    return 8 * columns * PATH_BYTES(sweep_levels(levels));
}

INLINE uint8_t jump_cost(const surface_rules_t *rules, float here, float there)
{
    const float change = fabsf(here - there);
    const float part = change == change ? 1.0f / (1.0f + change / (float)rules->even) : 1.0f;
    return (uint8_t)((float)rules->bend + (float)(rules->jump - rules->bend) * part);
}

/* Set `total` (rows, columns, padded levels) to the aggregated costs of eight paths: four in a pass downwards, then the opposite
 * four in a pass upwards. */
FOR_EACH_PROCESSOR void sweep_surfaces(
    const surface_rules_t *rules, const uint8_t *costs, const float *samples1, uint8_t *memory, uint16_t *total)
{
    const int64_t rows = rules->rows, columns = rules->columns, levels = sweep_levels(rules->levels);
    const int64_t bytes = PATH_BYTES(levels), size = columns * bytes;
    memset(total, 0, (size_t)(rows * columns * levels) * sizeof *total);
    memset(memory, NO_LEVEL, (size_t)(8 * size));
    for (int64_t way = 1; way >= -1; way -= 2) {
        for (int64_t k = 0; k < rows; k++) {
            const int64_t row = way > 0 ? k : rows - 1 - k;
            uint8_t *now = memory + (k % 2) * 4 * size, *before = memory + (1 - k % 2) * 4 * size;
            for (int64_t n = 0; n < columns; n++) {
                const int64_t column = way > 0 ? n : columns - 1 - n, at = row * columns + column;
                const uint8_t *cost = costs + at * levels;
                for (int64_t path = 0; path < 4; path++) {
                    /* Three paths come from the previous row, one from the previous column. */
                    const int64_t dr = path < 3 ? -way : 0, dc = path < 3 ? path - 1 : -way;
                    uint8_t *here = now + path * size + column * bytes;
                    const int inside = row + dr >= 0 && row + dr < rows && column + dc >= 0 && column + dc < columns;
                    if (inside) {
                        const uint8_t *there = (path < 3 ? before : now) + path * size + (column + dc) * bytes;
                        const uint8_t jump = jump_cost(rules, samples1[at], samples1[at + dr * columns + dc]);
                        here[0] = follow(
                            there + SIDE_BYTES, there[0], jump, (uint8_t)rules->bend, cost, here + SIDE_BYTES, total + at * levels,
                            levels);
                    } else {
                        here[0] = begin(cost, here + SIDE_BYTES, total + at * levels, levels);
                    }
                }
            }
        }
    }
}

/* Write the level of the smallest cost of each sample, that cost, and those of this level and its two neighbours; of the nearest
 * inner level if it is the first or the last. */
FOR_EACH_PROCESSOR void sweep_winners(const surface_rules_t *rules, const uint16_t *total, int32_t *best, int32_t *around)
{
    const int64_t count = rules->rows * rules->columns, levels = rules->levels, padded = sweep_levels(levels);
    for (int64_t k = 0; k < count; k++) {
        const uint16_t *at = total + k * padded;
        uint16_t least = 65535;
#pragma omp simd reduction(min : least)
        for (int64_t n = 0; n < levels; n++)
            least = at[n] < least ? at[n] : least;
        int64_t found = 0;
        while (at[found] != least)
            found++;
        best[k] = (int32_t)found;
        const int64_t inner = found < 1 ? 1 : found > levels - 2 ? levels - 2 : found;
        around[4 * k] = least;
        for (int64_t n = 0; n < 3; n++)
            around[4 * k + 1 + n] = at[inner - 1 + n];
    }
}

/* Largest offset of the samples that are summed up, the largest weight, and the size and resolution of the table of weights. */
enum { RIVAL_REACH = 5, FULL_WEIGHT = 16, WEIGHT_STEPS = 64, STEPS_OF_ONE = 16 };

/* Add `weight` times the costs of a sample whose surface is `shift` levels higher there. */
INLINE void add_shifted(const uint8_t *cost, int64_t shift, uint16_t weight, int64_t levels, uint16_t *sum)
{
    const int64_t from = shift < 0 ? -shift : 0, to = shift > 0 ? levels - shift : levels;
    const uint16_t below = (uint16_t)(weight * cost[0]), above = (uint16_t)(weight * cost[levels - 1]);
    for (int64_t k = 0; k < from; k++)
        sum[k] = (uint16_t)(sum[k] + below);
#pragma omp simd
    for (int64_t k = from; k < to; k++)
        sum[k] = (uint16_t)(sum[k] + weight * cost[k + shift]);
    for (int64_t k = to; k < levels; k++)
        sum[k] = (uint16_t)(sum[k] + above);
}

/* Write for each claim the mean cost of its surface, within one level, and of the cheapest other surface of the same slant, over
 * the surrounding samples of similar brightness; NaN if the sweep has no such levels. */
FOR_EACH_PROCESSOR void sweep_rivals(
    const claims_t *claims, const uint8_t *costs, const float *samples1, uint16_t *memory, float *found)
{
    const int64_t levels = claims->levels, padded = sweep_levels(levels);
    float faint[WEIGHT_STEPS];
    for (int64_t k = 0; k < WEIGHT_STEPS; k++)
        faint[k] = expf(-(float)k / (float)STEPS_OF_ONE);
    const float steps = (float)STEPS_OF_ONE / (float)claims->alike;
    const float fall = (float)(0.5 * STEPS_OF_ONE / (claims->radius * claims->radius));
    for (int64_t n = 0; n < claims->count; n++) {
        const int64_t row = claims->samples[2 * n], column = claims->samples[2 * n + 1];
        const float *surface = claims->surfaces + 4 * n, here = samples1[row * claims->columns + column];
        memset(memory, 0, (size_t)levels * sizeof *memory);
        float weights = 0.0f;
        for (int64_t j = -RIVAL_REACH; j <= RIVAL_REACH; j++)
            for (int64_t i = -RIVAL_REACH; i <= RIVAL_REACH; i++) {
                if (row + j < 0 || row + j >= claims->rows || column + i < 0 || column + i >= claims->columns)
                    continue;
                const int64_t at = (row + j) * claims->columns + column + i;
                const float unlike = steps * fabsf(samples1[at] - here) + fall * (float)(i * i + j * j);
                const float shift = surface[1] * (float)j + surface[2] * (float)i;
                if (!(unlike < (float)WEIGHT_STEPS && fabsf(shift) < (float)levels - 1.0f))
                    continue;
                const uint16_t weight = (uint16_t)((float)FULL_WEIGHT * faint[(int64_t)unlike] + 0.5f);
                add_shifted(costs + at * padded, (int64_t)floorf(shift + 0.5f), weight, levels, memory);
                weights += (float)weight;
            }
        float own = INFINITY, other = INFINITY;
        for (int64_t k = 0; k < levels; k++) {
            const float away = fabsf((float)k - surface[0]);
            if (away <= 1.0f && (float)memory[k] < own)
                own = (float)memory[k];
            if (away > surface[3] && (float)memory[k] < other)
                other = (float)memory[k];
        }
        const int known = own < INFINITY && other < INFINITY && weights > 0.0f;
        found[2 * n] = known ? own / weights : NAN;
        found[2 * n + 1] = known ? other / weights : NAN;
    }
}
