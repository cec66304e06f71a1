/* Factors of the corners' sigmas for correlated noise of neighbouring pixels. The definitions in
 * numpy are in tests/kernels/reference/correlation.py, the constants in rigkit.detection.subpixel.correlation. */
#include "kernels.h"

/* Sums over the corners of a board, then their means. */
typedef struct {
    double products[LAGS], pairs[LAGS], sides[4], blur, used, blend[3];
} known_t;

/* Displacement, in rows and columns, of the two pixels of each of the LAGS. */
INLINE void set_lags(double rows[LAGS], double columns[LAGS])
{
    for (int up = 0, k = 0; up <= LAG; up++)
        for (int right = up ? -LAG : 0; right <= LAG; right++, k++) {
            rows[k] = -(double)up;
            columns[k] = (double)right;
        }
}

/* Return the index of the LAG with this displacement, -1 if there is none. */
INLINE int lag_at(int row, int column)
{
    if (row > 0 || (row == 0 && column < 0)) {
        row = -row;
        column = -column;
    }
    if (row < -LAG || column < -LAG || column > LAG)
        return -1;
    return row == 0 ? column : LAG + 1 + (-row - 1) * ACROSS_LAGS + column + LAG;
}

/* Set `matrix` to the linear map from the autocovariance of the noise at LAGS to that of the mirrored differences. A mirrored pixel
 * is interpolated from four pixels: two of them share noise if they use the same or neighbouring ones. With f the fraction between
 * pixels, `blend` is f (1 - f) of u, of v, and the product of both. */
static void set_blended(const double blend[3], double matrix[LAGS][LAGS])
{
    const double both = blend[2], right = blend[0] - 2.0 * both, below = blend[1] - 2.0 * both;
    const double same = 1.0 - 2.0 * (blend[0] + blend[1]) + 4.0 * both;
    memset(matrix, 0, sizeof(double[LAGS][LAGS]));
    for (int row = 0, k = 0; row <= LAG; row++)
        for (int column = row ? -LAG : 0; column <= LAG; column++, k++) {
            matrix[k][k] += 1.0;
            for (int down = -1; down <= 1; down++)
                for (int over = -1; over <= 1; over++) {
                    const int beside = lag_at(-row + down, column + over);
                    if (beside >= 0)
                        matrix[k][beside] += down ? (over ? both : below) : (over ? right : same);
                }
        }
}

/* Solve transpose(matrix) x = `x` (Gauss, rows exchanged for the largest pivot). */
static void solve_transposed(double matrix[LAGS][LAGS], double x[LAGS])
{
    /* Columns of `matrix` are the rows here. */
    for (int k = 0; k < LAGS; k++) {
        int best = k;
        for (int i = k + 1; i < LAGS; i++)
            best = fabs(matrix[k][i]) > fabs(matrix[k][best]) ? i : best;
        for (int j = 0; j < LAGS; j++) {
            const double swap = matrix[j][k];
            matrix[j][k] = matrix[j][best];
            matrix[j][best] = swap;
        }
        const double own = x[k];
        x[k] = x[best];
        x[best] = own;
        for (int i = k + 1; i < LAGS; i++) {
            const double times = matrix[k][i] / matrix[k][k];
            for (int j = k + 1; j < LAGS; j++)
                matrix[j][i] -= times * matrix[j][k];
            x[i] -= times * x[k];
        }
    }
    for (int k = LAGS - 1; k >= 0; k--) {
        for (int j = k + 1; j < LAGS; j++)
            x[k] -= matrix[j][k] * x[j];
        x[k] /= matrix[k][k];
    }
}

/* Set `influence` to w at LAGS, the mean of both lines, and return the amount of noise that the fit absorbs
 * (reference.correlation.influence). */
static double set_influence(
    const double sides[4], double blur, const double rows[LAGS], const double columns[LAGS], const factor_rules_t *rules,
    double influence[LAGS])
{
    double reach[2], lost = 0.0;
    memset(influence, 0, LAGS * sizeof(double));
    for (int line = 0; line < 2; line++) {
        const double length = hypot(sides[2 * line], sides[2 * line + 1]), across = length > 1.0 ? length : 1.0;
        const double cosine = sides[2 * line] / across, sine = sides[2 * line + 1] / across;
        reach[line] = across < 2.0 * rules->radius_px ? across : 2.0 * rules->radius_px;
        for (int k = 0; k < LAGS; k++) {
            const double along = cosine * columns[k] + sine * rows[k], lateral = cosine * rows[k] - sine * columns[k];
            /* The overlap of the line with itself shifted along it, minus the parts with opposite sign. */
            const double left = 1.0 - 3.0 * fabs(along) / reach[line];
            influence[k] += exp(lateral * lateral / (-4.0 * blur * blur)) * (left > 0.0 ? left : 0.0);
        }
    }
    for (int k = 0; k < LAGS; k++) {
        const double length = hypot(rows[k], columns[k]), times = length > 0.0 ? 2.0 : 1.0;
        const double light = 1.0 - length / reach[0];
        influence[k] = (0.5 * influence[k] - rules->light_share) / (1.0 - rules->light_share);
        lost += times * influence[k] * (influence[k] + (light > 0.0 ? light : 0.0));
    }
    return 4.0 * lost;
}

/* Return the factor estimated from the means over `count` corners (reference.correlation.factors). */
static double factor_of(const known_t *mean, double count, const factor_rules_t *rules)
{
    double rows[LAGS], columns[LAGS], influence[LAGS], weight[LAGS], matrix[LAGS][LAGS], pairs[LAGS], change[LAGS];
    set_lags(rows, columns);
    const double blur = mean->blur > rules->min_blur ? mean->blur : rules->min_blur;
    const double lost = set_influence(mean->sides, blur, rows, columns, rules, influence);
    for (int k = 0; k < LAGS; k++) {
        pairs[k] = mean->pairs[k] > 1.0 ? mean->pairs[k] : 1.0;
        change[k] = mean->products[k] / pairs[k];
        weight[k] = (k > 0 ? 2.0 : 1.0) * influence[k];
    }
    set_blended(mean->blend, matrix);
    solve_transposed(matrix, weight);
    const double share = lost / (mean->used > 1.0 ? mean->used : 1.0);
    const double left = 1.0 - share > rules->min_left ? 1.0 - share : rules->min_left;
    double excess = 0.0, chance = 0.0;
    for (int k = 0; k < LAGS; k++)
        excess += weight[k] * change[k];
    excess = excess / left - 1.0;
    /* Products of independent noise have this variance at all lags but none. */
    for (int k = 1; k < LAGS; k++)
        chance += weight[k] * weight[k] / (count * pairs[k]);
    chance *= change[0] / left * (change[0] / left);
    /* The uncertainty of `left` is in the quotient: small windows, where the fit absorbs most noise, have no information. */
    const double unsure = (1.0 + excess) * rules->lost_error * share / left, squared = excess * excess;
    const double sure = 1.0 - (chance + unsure * unsure) / (squared > 1e-12 ? squared : 1e-12);
    const double times = 1.0 + (sure > 0.0 ? sure : 0.0) * excess, least = rules->min_factor * rules->min_factor;
    return sqrt(times > least ? times : least);
}

/* Add a corner, weighted by its number of pixels. */
INLINE void add_known(
    const double *products, const double *pairs, double noise, const double *pixel, const double *sides, double blur, double used,
    known_t *sum)
{
    double blend[2];
    for (int axis = 0; axis < 2; axis++) {
        const double part = 2.0 * pixel[axis] - floor(2.0 * pixel[axis]);
        blend[axis] = part * (1.0 - part);
        sum->blend[axis] += blend[axis];
    }
    sum->blend[2] += blend[0] * blend[1];
    for (int k = 0; k < LAGS; k++) {
        sum->products[k] += products[k] / (noise * noise);
        sum->pairs[k] += pairs[k];
    }
    for (int k = 0; k < 4; k++)
        sum->sides[k] += sides[k];
    sum->blur += blur;
    sum->used += used;
}

/* Set `out` (boards) to the factors of the sigmas of each board (reference.correlation.sigma_factors); 1 where none of its
 * corners is `good` with a known noise. */
void sigma_factors(
    const double *products, const double *pairs, const double *noise, const double *pixels, const double *sides, const double *blur,
    const double *used, const uint8_t *good, const int64_t *owner, int64_t count, int64_t boards, const factor_rules_t *rules,
    double *out)
{
    for (int64_t board = 0; board < boards; board++) {
        double typical = 0.0;
        int64_t seen = 0, clear = 0;
        for (int64_t i = 0; i < count; i++)
            if (owner[i] == board && good[i] && pairs[LAGS * i] > 0.0) {
                typical += log(noise[i]);
                seen++;
            }
        typical = exp(typical / (double)(seen > 0 ? seen : 1));
        known_t known;
        memset(&known, 0, sizeof known);
        for (int64_t i = 0; i < count; i++)
            if (owner[i] == board && good[i] && pairs[LAGS * i] > 0.0 && noise[i] <= rules->covered_times * typical) {
                add_known(products + LAGS * i, pairs + LAGS * i, noise[i], pixels + 2 * i, sides + 4 * i, blur[i], used[i], &known);
                clear++;
            }
        double *values = (double *)&known;
        for (size_t k = 0; clear > 0 && k < sizeof known / sizeof(double); k++)
            values[k] /= (double)clear;
        out[board] = clear > 0 ? factor_of(&known, (double)clear, rules) : 1.0;
    }
}

/* Set `out` to the factors of the sigmas of corners relative to those of their boards, `typical` (boards): 1 except for corners
 * with other residuals than noise in their windows (reference.correlation.uneven_factors). */
void uneven_factors(
    const double *products, const double *pairs, const double *noise, const double *pixels, const double *sides, const double *blur,
    const double *used, const uint8_t *good, const int64_t *owner, int64_t count, int64_t boards, const double *typical,
    const factor_rules_t *rules, double *out)
{
    (void)boards;
    for (int64_t i = 0; i < count; i++) {
        const double *own_products = products + LAGS * i, *own_pairs = pairs + LAGS * i, board = typical[owner[i]];
        out[i] = 1.0;
        if (!good[i] || !(own_pairs[0] > 0.0))
            continue;
        double alike = 0.0;
        for (int k = 1; k < LAGS; k++)
            alike += own_products[k] / (own_pairs[k] > 1.0 ? own_pairs[k] : 1.0);
        if (!(alike / (double)(LAGS - 1) > rules->min_alike * board * board * noise[i] * noise[i]))
            continue;
        known_t known;
        memset(&known, 0, sizeof known);
        add_known(own_products, own_pairs, noise[i], pixels + 2 * i, sides + 4 * i, blur[i], used[i], &known);
        const double times = factor_of(&known, 1.0, rules) / board;
        out[i] = times > rules->uneven_times ? times : 1.0;
    }
}
