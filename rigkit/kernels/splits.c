/* Detection of lattices that are two touching boards: two different smooth surfaces. The definitions in numpy are in
 * tests/kernels/reference/discontinuity.py, the numbers and their meaning in rigkit.detection.checks.discontinuity. */
#include "kernels.h"

enum { CUBIC = 10, QUADRATIC = 6, MEETINGS = 5 };

/* Sums over the corners of a column, in cells, for fits of polynomial surfaces. */
typedef struct {
    double normal[CUBIC][CUBIC], right[CUBIC][2], square, variance, corners, columns;
} sums_t;

/* A lattice with a stride of `along` doubles from column to column and `across` from row to row; 2 doubles per corner in
 * `pixels`, 1 in `sigma`. */
typedef struct {
    const double *pixels, *sigma;
    int64_t rows, columns, across, along;
    double middle[2], cell_px;
} sheet_view_t;

INLINE const double *corner_at(const sheet_view_t *view, int64_t row, int64_t column)
{
    return view->pixels + 2 * (row * view->across + column * view->along);
}

/* Return the index of a row or column, of `count`, shifted and scaled to small numbers around 0 for the fits. */
INLINE double scaled(double number, int64_t count, const split_rules_t *rules)
{
    return (number - 0.5 * ((double)count - 1.0)) / (double)rules->window;
}

INLINE void set_terms(double x, double y, double terms[CUBIC])
{
    const double every[CUBIC] = {1.0, x, y, x * x, x * y, y * y, x * x * x, x * x * y, x * y * y, y * y * y};
    memcpy(terms, every, sizeof every);
}

static void set_column(const sheet_view_t *view, int64_t column, const split_rules_t *rules, sums_t *out)
{
    memset(out, 0, sizeof *out);
    for (int64_t row = 0; row < view->rows; row++) {
        const double *pixel = corner_at(view, row, column);
        if (!isfinite(pixel[0]))
            continue;
        const double place[2] = {(pixel[0] - view->middle[0]) / view->cell_px, (pixel[1] - view->middle[1]) / view->cell_px};
        const double sigma = view->sigma[row * view->across + column * view->along] / view->cell_px;
        double terms[CUBIC];
        set_terms(scaled((double)column, view->columns, rules), scaled((double)row, view->rows, rules), terms);
        for (int i = 0; i < CUBIC; i++) {
            for (int j = 0; j < CUBIC; j++)
                out->normal[i][j] += terms[i] * terms[j];
            out->right[i][0] += terms[i] * place[0];
            out->right[i][1] += terms[i] * place[1];
        }
        out->square += place[0] * place[0] + place[1] * place[1];
        out->variance += sigma * sigma;
        out->corners += 1.0;
        out->columns = 1.0;
    }
}

INLINE void add_sums(const sums_t *part, sums_t *sum)
{
    const double *values = (const double *)part;
    double *to = (double *)sum;
    for (size_t k = 0; k < sizeof *sum / sizeof *to; k++)
        to[k] += values[k];
}

/* Fit `surface` with the first `terms`, and return the sum of squared residuals (Gauss elimination with partial
 * pivoting). */
static double fitted(const sums_t *sums, int terms, double ridge, double surface[CUBIC][2])
{
    double matrix[CUBIC][CUBIC + 2];
    for (int i = 0; i < terms; i++) {
        for (int j = 0; j < terms; j++)
            matrix[i][j] = sums->normal[i][j];
        matrix[i][i] += ridge;
        matrix[i][terms] = sums->right[i][0];
        matrix[i][terms + 1] = sums->right[i][1];
    }
    for (int k = 0; k < terms; k++) {
        int best = k;
        for (int i = k + 1; i < terms; i++)
            best = fabs(matrix[i][k]) > fabs(matrix[best][k]) ? i : best;
        for (int j = k; j < terms + 2; j++) {
            const double swap = matrix[k][j];
            matrix[k][j] = matrix[best][j];
            matrix[best][j] = swap;
        }
        for (int i = k + 1; i < terms; i++) {
            const double times = matrix[i][k] / matrix[k][k];
            for (int j = k + 1; j < terms + 2; j++)
                matrix[i][j] -= times * matrix[k][j];
        }
    }
    double left = sums->square;
    for (int k = terms - 1; k >= 0; k--)
        for (int axis = 0; axis < 2; axis++) {
            double value = matrix[k][terms + axis];
            for (int j = k + 1; j < terms; j++)
                value -= matrix[k][j] * surface[j][axis];
            surface[k][axis] = value / matrix[k][k];
            left -= sums->right[k][axis] * surface[k][axis];
        }
    return left > 0.0 ? 0.5 * left : 0.0;
}

/* Return the number of terms of a quadratic surface that a number of columns determines. */
INLINE double determined(double columns)
{
    return columns < 1.0 ? 0.0 : columns < 2.0 ? 3.0 : columns < 3.0 ? 5.0 : 6.0;
}

/* Return whether a row has a corner in the columns `first` to `end` (exclusive). */
INLINE int any_in_row(const sheet_view_t *view, int64_t row, int64_t first, int64_t end)
{
    for (int64_t column = first; column < end; column++)
        if (isfinite(corner_at(view, row, column)[0]))
            return 1;
    return 0;
}

/* A possible split: ratio by which the two sides fit better separately, its columns, and the residuals of both sides. */
typedef struct {
    double ratio, start, end, alone;
} split_t;

/* Return whether the surfaces of the two sides, columns `first` to `start` and `end` to `last`, which differ by `apart`, are
 * discontinuous like two boards: in all rows that both sides have, they differ by at least a jump everywhere between them. */
static int jumps(
    const sheet_view_t *view, int64_t first, int64_t start, int64_t end, int64_t last, double apart[QUADRATIC][2],
    const split_rules_t *rules)
{
    double nearest = INFINITY;
    int64_t common = 0;
    for (int meeting = 0; meeting < MEETINGS; meeting++) {
        const double column = (double)start - 1.0 + (double)meeting / (MEETINGS - 1.0) * (double)(end - start + 1);
        double off = 0.0;
        common = 0;
        for (int64_t row = 0; row < view->rows; row++) {
            if (!any_in_row(view, row, first, start) || !any_in_row(view, row, end, last))
                continue;
            double terms[CUBIC], u = 0.0, v = 0.0;
            set_terms(scaled(column, view->columns, rules), scaled((double)row, view->rows, rules), terms);
            for (int k = 0; k < QUADRATIC; k++) {
                u += terms[k] * apart[k][0];
                v += terms[k] * apart[k][1];
            }
            off += u * u + v * v;
            common++;
        }
        nearest = off < nearest ? off : nearest;
    }
    return common == 0 || nearest / (double)common > rules->jump * rules->jump;
}

/* Return whether the lattice may be split between the columns `start` and `end` (exclusive), and how well
 * (reference.discontinuity.clearest_split). */
static int split_at(
    const sheet_view_t *view, const sums_t *columns, int64_t start, int64_t end, int64_t several, const split_rules_t *rules,
    split_t *out)
{
    const int64_t first = start > rules->window ? start - rules->window : 0;
    const int64_t last = end + rules->window < view->columns ? end + rules->window : view->columns;
    sums_t left, right, both;
    memset(&left, 0, sizeof left);
    memset(&right, 0, sizeof right);
    for (int64_t column = first; column < start; column++)
        add_sums(columns + column, &left);
    for (int64_t column = end; column < last; column++)
        add_sums(columns + column, &right);
    both = left;
    add_sums(&right, &both);
    const double free = both.corners - determined(left.columns) - determined(right.columns);
    if (left.corners < (double)rules->min_beside || right.corners < (double)rules->min_beside || free < (double)rules->min_free)
        return 0;
    double surface[CUBIC][2], one[CUBIC][2], two[CUBIC][2], apart[QUADRATIC][2];
    const double least = rules->two_surfaces * rules->two_surfaces, more = both.corners - CUBIC;
    const double together = fitted(&both, CUBIC, rules->ridge, surface) / (more > 1.0 ? more : 1.0);
    const double floor = both.variance / both.corners + rules->floor_cells * rules->floor_cells;
    /* Lower limit of the residuals of two surfaces. */
    if (!several && !(together > least * floor))
        return 0;
    const double sides = fitted(&left, QUADRATIC, rules->ridge, one) + fitted(&right, QUADRATIC, rules->ridge, two);
    const double alone = sides / (free > 1.0 ? free : 1.0) + floor;
    for (int k = 0; k < QUADRATIC; k++)
        for (int axis = 0; axis < 2; axis++)
            apart[k][axis] = one[k][axis] - two[k][axis];
    *out = (split_t){sqrt(together / alone), (double)start, (double)end, sqrt(alone)};
    if (!isfinite(out->ratio))
        return 0;
    return several || (out->ratio > rules->two_surfaces && jumps(view, first, start, end, last, apart, rules));
}

/* Return the clearest split between columns, of ratio 0 if there is none (reference.discontinuity.clearest_split). `scratch`
 * holds the sums of all columns and 3 * columns splits. */
static split_t clearest_split(const sheet_view_t *view, int64_t several, const split_rules_t *rules, double *scratch)
{
    sums_t *columns = (sums_t *)scratch;
    split_t *found = (split_t *)(columns + view->columns), clearest = {0.0, 0.0, 0.0, 0.0}, best;
    for (int64_t column = 0; column < view->columns; column++)
        set_column(view, column, rules, columns + column);
    int64_t count = 0;
    /* Columns on the discontinuity, of neither side: the first pass detects it, the others locate it. */
    const int64_t widths[] = {1, 0, 2};
    for (int k = 0; k < 3 && (k == 0 || count > 0); k++)
        for (int64_t start = 1; start < view->columns - widths[k]; start++)
            count += split_at(view, columns, start, start + widths[k], several, rules, found + count);
    for (int64_t k = 0; k < count; k++)
        clearest = found[k].ratio > clearest.ratio ? found[k] : clearest;
    best = clearest;
    /* Corners that fit one of the sides are not on the discontinuity. */
    for (int64_t k = 0; k < count; k++) {
        const double narrower = (best.end - best.start) - (found[k].end - found[k].start);
        if (found[k].alone <= rules->as_smooth * clearest.alone
            && (narrower > 0.0 || (narrower == 0.0 && found[k].ratio > best.ratio)))
            best = found[k];
    }
    return best;
}

/* Set the centre and scale of `view`: the mean of the known corners, and the median of the steps between them. */
static void set_scale(sheet_view_t *view, double *steps)
{
    int64_t count = 0, known = 0;
    double u = 0.0, v = 0.0;
    for (int64_t row = 0; row < view->rows; row++)
        for (int64_t column = 0; column < view->columns; column++) {
            const double *here = corner_at(view, row, column);
            if (!isfinite(here[0]))
                continue;
            u += here[0];
            v += here[1];
            known++;
            const double *beside[] = {
                column + 1 < view->columns ? corner_at(view, row, column + 1) : NULL,
                row + 1 < view->rows ? corner_at(view, row + 1, column) : NULL};
            for (int k = 0; k < 2; k++)
                if (beside[k] && isfinite(beside[k][0]))
                    steps[count++] = hypot(beside[k][0] - here[0], beside[k][1] - here[1]);
        }
    view->middle[0] = u / (double)known;
    view->middle[1] = v / (double)known;
    view->cell_px = count ? quick_median(steps, count) : NAN;
}

/* Return the number of doubles of scratch that `clearest_splits` needs. */
int64_t splits_scratch(int64_t rows, int64_t columns)
{
    const int64_t longer = rows > columns ? rows : columns, steps = 2 * rows * columns;
    const int64_t sums = longer * (int64_t)((sizeof(sums_t) + 3 * sizeof(split_t)) / sizeof(double));
    return sums > steps ? sums : steps;
}

/* Set `out` to the clearest splits of a lattice between its columns and between its rows: ratio, start, end. */
void clearest_splits(
    const double *pixels, const double *sigma, int64_t rows, int64_t columns, int64_t several, const split_rules_t *rules,
    double *scratch, double *out)
{
    sheet_view_t view = {pixels, sigma, rows, columns, columns, 1, {0.0, 0.0}, 0.0};
    set_scale(&view, scratch);
    for (int k = 0; k < 2; k++) {
        const split_t best = clearest_split(&view, several, rules, scratch);
        out[3 * k] = best.ratio;
        out[3 * k + 1] = best.start;
        out[3 * k + 2] = best.end;
        view = (sheet_view_t){pixels, sigma, columns, rows, 1, columns, {view.middle[0], view.middle[1]}, view.cell_px};
    }
}
