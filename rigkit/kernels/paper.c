/* The paper beyond the outermost squares of boards. The definition in numpy is in tests/kernels/reference/paper.py, the
 * purpose and the constants are in rigkit.detection.subpixel.outer_squares. */
#include "kernels.h"

/* The corners of the boards and the results of their fits: the arguments of `find_paper`. */
typedef struct {
    const double *pixels, *sides, *gaps, *contrast, *blur, *sign;
    const uint8_t *ends;
    const int64_t *owner;
} outer_t;

/* The ends of lines beyond the outermost corners (which line of which corner), and their measured values. */
typedef struct {
    double end, bright, cell;
    int64_t who, which;
    int32_t single, found;
} outer_end_t;

static float grey_at(const picture_t *image, int64_t u, int64_t v)
{
    u = u < 0 ? 0 : u >= image->width ? image->width - 1 : u;
    v = v < 0 ? 0 : v >= image->height ? image->height - 1 : v;
    return (float)level_at(image->brightness, image->bytes, v * image->width + u);
}

/* Return the brightness at (u, v) as detection.saddles.response.sample does. */
static float sampled(const picture_t *image, double u, double v)
{
    const float x = (float)u, y = (float)v, left = floorf(x), top = floorf(y);
    const int64_t column = (int64_t)left, row = (int64_t)top;
    const float first = grey_at(image, column, row), second = grey_at(image, column + 1, row);
    const float third = grey_at(image, column, row + 1), fourth = grey_at(image, column + 1, row + 1);
    const float upper = first + (x - left) * (second - first), lower = third + (x - left) * (fourth - third);
    return upper + (y - top) * (lower - upper);
}

static double mean_gap(const outer_t *all, int64_t who, int64_t line)
{
    return (all->gaps[4 * who + 2 * line] + all->gaps[4 * who + 2 * line + 1]) / 2.0;
}

/* Return the median of `count` numbers, which are sorted; NaN of none. */
static double median_of(double *values, int64_t count)
{
    for (int64_t i = 1; i < count; i++) {
        const double value = values[i];
        int64_t k = i;
        for (; k > 0 && values[k - 1] > value; k--)
            values[k] = values[k - 1];
        values[k] = value;
    }
    if (count == 0)
        return NAN;
    return count % 2 ? values[count / 2] : (values[count / 2 - 1] + values[count / 2]) / 2.0;
}

/* Set `near` to those of the `count` ends that are averaged for the paper beyond `end`; return their number. */
static int64_t witnesses(
    const outer_t *all, const outer_end_t *ends, int64_t count, const outer_end_t *end, double reach, int64_t *near)
{
    const double *at = all->pixels + 2 * end->who, *sides = all->sides + 4 * end->who;
    const double column = sqrt(sides[0] * sides[0] + sides[1] * sides[1]);
    const double row = sqrt(sides[2] * sides[2] + sides[3] * sides[3]);
    const double limit = reach * (column > row ? column : row);
    /* Singles come first; if there are none, the others are used, too. */
    for (int singles = 1; singles >= 0; singles--) {
        int64_t found = 0;
        for (int64_t k = 0; k < count; k++) {
            if (ends[k].which != end->which || ends[k].single < singles || all->owner[ends[k].who] != all->owner[end->who])
                continue;
            const double *other = all->pixels + 2 * ends[k].who;
            const double u = other[0] - at[0], v = other[1] - at[1];
            if (sqrt(u * u + v * v) < limit)
                near[found++] = k;
        }
        if (found)
            return found;
    }
    return 0;
}

/* Set `one` and `other` to the brightness on both sides of the line beyond the board at each step, NaN outside the image. */
static void read_sides(
    const outer_t *all, const picture_t *image, const outer_end_t *end, const paper_rules_t *rules, float *one, float *other)
{
    /* Direction, in cells (column, row), of each of the ends of a corner. */
    static const double OUTWARDS[4][2] = {{0.0, -1.0}, {0.0, 1.0}, {1.0, 0.0}, {-1.0, 0.0}};
    const double *way = OUTWARDS[end->which], *pixel = all->pixels + 2 * end->who, *sides = all->sides + 4 * end->who;
    const double right = (double)(image->width - 1), bottom = (double)(image->height - 1);
    for (int64_t k = 0; k < rules->step_count; k++)
        for (int side = 0; side < 2; side++) {
            const double lateral = side ? -rules->lateral : rules->lateral;
            const double column = way[0] * rules->steps[k] + lateral * way[1];
            const double row = way[1] * rules->steps[k] + lateral * way[0];
            const double u = pixel[0] + (column * sides[0] + row * sides[2]);
            const double v = pixel[1] + (column * sides[1] + row * sides[3]);
            const int inside = u >= 0.0 && v >= 0.0 && u <= right && v <= bottom;
            (side ? other : one)[k] = inside ? sampled(image, u, v) : NAN;
        }
}

/* Set `end->end` to the place, in squares, where the differences (steps), which are 1 inside the squares, end; return whether
 * they do. */
static int find_end(outer_end_t *end, const paper_rules_t *rules, double *differs)
{
    const int64_t count = rules->step_count;
    int64_t peak = 0, at = 0;
    double most = -2.0;
    for (int64_t k = 0; k < count; k++) {
        const double near = isfinite(differs[k]) && rules->steps[k] < rules->first ? fabs(differs[k]) : -1.0;
        if (near > most) {
            most = near;
            peak = k;
        }
    }
    const double sign = differs[peak] > 0.0 ? 1.0 : differs[peak] < 0.0 ? -1.0 : differs[peak];
    for (int64_t k = 0; k < count; k++)
        differs[k] *= sign;
    for (int64_t k = peak + 1; k < count && !at; k++)
        at = differs[k] < 0.5 ? k : 0;
    if (!at)
        return 0;
    double fall = differs[at - 1] - differs[at];
    fall = fall < 1e-9 ? 1e-9 : fall;
    end->end = rules->steps[at] - (0.5 - differs[at]) / fall * (rules->steps[1] - rules->steps[0]);
    int goes_on = 0;
    for (int64_t k = at + 1; k < count; k++)
        goes_on |= differs[k] < rules->goes_on;
    return end->end < rules->last && !(goes_on && end->end > rules->cut);
}

/* Measure `end` with the typical contrast and blur: where the squares end, and the brightness beyond them. */
static void read_end(
    const outer_t *all, const picture_t *image, outer_end_t *end, const paper_rules_t *rules, double contrast, double blur,
    double *scratch)
{
    const int64_t count = rules->step_count;
    float *one = (float *)scratch, *other = one + count;
    double *differs = scratch + count;
    read_sides(all, image, end, rules, one, other);
    /* On both sides of the line beyond line 1 are the squares of line 2, with their edges and those of the next squares:
     * the difference of the two squares after blurring. */
    const double across = mean_gap(all, end->who, 1 - end->which / 2) / (sqrt(2.0) * blur);
    const double left = erf(rules->lateral * across) + erf((1.0 - rules->lateral) * across) - 1.0;
    for (int64_t k = 0; k < count; k++)
        differs[k] = (double)(one[k] - other[k]) / (contrast * left);
    end->found = find_end(end, rules, differs);
    if (!end->found)
        return;
    const double at = (end->end + blur / end->cell - rules->steps[0]) / (rules->steps[1] - rules->steps[0]);
    double within = at > 0.0 ? at : 0.0;
    within = within < (double)count - 2.0 ? within : (double)count - 2.0;
    const int64_t first = (int64_t)within;
    const float here = 0.5f * (one[first] + other[first]), next = 0.5f * (one[first + 1] + other[first + 1]);
    const double level = (double)here + (at - (double)first) * (double)(next - here);
    const double *pixel = all->pixels + 2 * end->who;
    end->bright = (level - (double)sampled(image, pixel[0], pixel[1])) / (0.5 * contrast * rules->seen);
    end->found = at <= (double)count - 1.0 && fabs(end->bright) < rules->max_paper;
}

/* Set `paper` and `out_gaps` of `count` corners as defined in `outer_squares.with_paper`. `scratch` has room for 4 numbers per
 * corner and 2 per step, `memory` for all ends, `near` for their indices. */
void find_paper(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *pixels, const double *sides,
    const double *gaps, const uint8_t *ends, const double *contrast, const double *blur, const double *sign, const int64_t *owner,
    const paper_rules_t *rules, double *scratch, uint8_t *memory, int64_t *near, double *paper, double *out_gaps)
{
    const outer_t all = {pixels, sides, gaps, contrast, blur, sign, ends, owner};
    const picture_t image = {grey, width, height, bytes};
    outer_end_t *every = (outer_end_t *)memory;
    int64_t number = 0;
    for (int64_t k = 0; k < 4 * count; k++) {
        paper[k] = NAN;
        out_gaps[k] = gaps[k];
        if (!ends[k])
            continue;
        const uint8_t *own = ends + k / 4 * 4;
        /* The line beyond the corner is as long as the cell's side, the mean of the sides before and behind the corner. */
        every[number++] = (outer_end_t){
            .who = k / 4,
            .which = k % 4,
            .cell = mean_gap(&all, k / 4, k % 4 / 2),
            .single = own[0] + own[1] + own[2] + own[3] == 1};
    }
    double *values = scratch + 2 * rules->step_count;
    for (int64_t k = 0; k < number; k++) {
        /* Contrast and blur of an outer corner that was fitted without the paper are wrong, some more than
         * others. */
        const int64_t close = witnesses(&all, every, number, every + k, rules->near_witness, near);
        for (int64_t i = 0; i < close; i++)
            values[i] = contrast[every[near[i]].who];
        const double typical = median_of(values, close);
        for (int64_t i = 0; i < close; i++)
            values[i] = blur[every[near[i]].who];
        read_end(&all, &image, every + k, rules, typical, median_of(values, close), scratch);
    }
    for (int64_t k = 0; k < number; k++) {
        /* Sheets are cut straight, and paper is uniform: a median over neighbours removes the noise of single measurements. */
        const int64_t close = witnesses(&all, every, number, every + k, rules->near_witness, near);
        int64_t found = 0;
        for (int64_t i = 0; i < close; i++)
            if (every[near[i]].found)
                near[found++] = near[i];
        if (!found)
            continue;
        for (int64_t i = 0; i < found; i++)
            values[i] = every[near[i]].bright;
        const int64_t place = 4 * every[k].who + every[k].which;
        paper[place] = median_of(values, found) * sign[every[k].who];
        for (int64_t i = 0; i < found; i++)
            values[i] = every[near[i]].end;
        out_gaps[place] = median_of(values, found) * every[k].cell;
    }
}

int64_t paper_memory(int64_t count)
{
    return 4 * count * (int64_t)sizeof(outer_end_t);
}
