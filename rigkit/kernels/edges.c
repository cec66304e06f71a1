/* The fit of the edge model to chessboard corners, one corner after the other. The definitions in numpy are in
 * tests/kernels/reference/edges.py, the numbers in rigkit.detection.subpixel.
 *
 * The pixels of a corner are gathered once (edges_window.c). Every Gauss-Newton step evaluates the model and its derivatives
 * (edges_model.c). Products are summed in float32 lanes, and the normal equations solved in double: for PARAMETERS unknowns, or
 * for FEWER if the curvatures of the lines are given. The noise is estimated from the residuals (edges_noise.c). */
#include "edges.h"

enum { CACHE_LINE = 64 };

/* Set the initial brightness: half the contrast is given, the mean is that of the pixels. The model is linear in the mean, which
 * the first step corrects. */
static void level(double *values, const window_t *window, double half)
{
    lanes_t sums = {0.0f};
    const int64_t whole = window->count / LANES * LANES;
    for (int64_t i = 0; i < whole; i += LANES)
        sums += *(const lanes_t *)(window->value + i);
    double sum = 0.0;
    for (int lane = 0; lane < LANES; lane++)
        sum += (double)sums[lane];
    for (int64_t i = whole; i < window->count; i++)
        sum += (double)window->value[i];
    values[A] = sum / (double)(window->count > 0 ? window->count : 1);
    values[B] = half;
}

/* Factor the lower half of `matrix` (n rows of ROWS) in place, Cholesky, with one over the diagonal on the diagonal;
 * return whether it is positive definite. */
INLINE int factor(double *matrix, const int n)
{
    for (int j = 0; j < n; j++) {
        const double pivot = matrix[j * ROWS + j];
        if (!(pivot > 0.0))
            return 0;
        const double scale = matrix[j * ROWS + j] = 1.0 / sqrt(pivot);
        double column[PARAMETERS];
        for (int i = j + 1; i < n; i++)
            column[i] = matrix[i * ROWS + j] *= scale;
        /* Updates of the remaining columns, which are independent of each other. */
        for (int i = j + 1; i < n; i++)
            for (int k = j + 1; k <= i; k++)
                matrix[i * ROWS + k] -= column[i] * column[k];
    }
    return 1;
}

/* Replace `right` by L^-1 `right`, and by L^-T `right`, with the factor `lower` of `factor`. */
INLINE void forward(const double *lower, double *right, const int n)
{
    for (int i = 0; i < n; i++) {
        double sum = right[i];
        for (int k = 0; k < i; k++)
            sum -= lower[i * ROWS + k] * right[k];
        right[i] = sum * lower[i * ROWS + i];
    }
}

INLINE void backward(const double *lower, double *right, const int n)
{
    for (int i = n - 1; i >= 0; i--) {
        double sum = right[i];
        for (int k = i + 1; k < n; k++)
            sum -= lower[k * ROWS + i] * right[k];
        right[i] = sum * lower[i * ROWS + i];
    }
}

/* Replace `step`, the right-hand side, by the solution of the normal equations `matrix` of `n` unknowns, and `matrix` by its
 * factor; return whether it is positive definite. */
INLINE int solved_step(double *matrix, double *step, const int n)
{
    if (!factor(matrix, n))
        return 0;
    forward(matrix, step, n);
    backward(matrix, step, n);
    return 1;
}

/* Return element (k, k) of the inverse of the matrix with the factor `lower`. */
static double inverse_at(const double *lower, int k, int n)
{
    double unit[PARAMETERS] = {0.0}, total = 0.0;
    unit[k] = 1.0;
    forward(lower, unit, n);
    for (int i = k; i < n; i++)
        total += unit[i] * unit[i];
    return total;
}

static double clipped(double value, double low, double high)
{
    return value < low ? low : value > high ? high : value;
}

/* Move `values` by `step`, clipped to the range in which the model is nearly linear (reference.edges._limited). */
static void move(double *values, const double *step, int n, const edge_rules_t *rules)
{
    const double limits[PARAMETERS] = {
        rules->max_move_px,
        rules->max_move_px,
        rules->max_turn,
        rules->max_turn,
        rules->max_blur_change * values[S],
        INFINITY,
        INFINITY,
        rules->max_light_change,
        rules->max_light_change,
        INFINITY,
        INFINITY};
    for (int k = 0; k < n; k++)
        values[k] += clipped(step[k], -limits[k], limits[k]);
    values[S] = clipped(values[S], rules->min_blur, rules->max_blur);
}

/* The prior of a corner's parameters: means and inverse variances (0: none), the number of parameters that are fitted, whether the
 * model includes paper or single squares, and whether the contrast is given. */
typedef struct {
    double mean[PARAMETERS], information[PARAMETERS];
    int count, papered, levelled;
} prior_t;

static prior_t prior_of(const window_t *window, const geometry_t at, double blur, double contrast, const edge_rules_t *rules)
{
    const double turn = 1.0 / (rules->angle_sigma * rules->angle_sigma);
    const double width = 1.0 / (rules->log_blur_sigma * rules->log_blur_sigma * blur * blur);
    const double light = 1.0 / (rules->light_sigma * rules->light_sigma * window->size * window->size);
    const double bend1 = at.curvature_sigma[0], bend2 = at.curvature_sigma[1];
    prior_t prior = {
        .mean =
            {0.0, 0.0, atan2(at.sides[1], at.sides[0]), atan2(at.sides[3], at.sides[2]), blur, 0.0, 0.0, 0.0, 0.0, at.curvature[0],
             at.curvature[1]},
        .information = {0.0, 0.0, turn, turn, width, 0.0, 0.0, light, light, 1.0 / (bend1 * bend1), 1.0 / (bend2 * bend2)},
        .count = bend1 > 0.0 && bend2 > 0.0 ? PARAMETERS : FEWER,
        .papered = at.single[0] != 0.0,
        .levelled = isfinite(contrast) != 0};
    for (int k = 0; k < 4; k++)
        prior.papered |= isfinite(at.paper[k]) != 0;
    return prior;
}

/* The end of the Gauss-Newton iteration: the factor of the normal equations, if `solved`, the last step, and the variance of the
 * residuals. */
typedef struct {
    double products[ROWS * ROWS], last[PARAMETERS], variance;
    int solved;
} minimum_t;

/* Move `values` to the maximum of the posterior by Gauss-Newton steps. */
FOR_EACH_PROCESSOR static void descend(
    double *values, const window_t *window, const geometry_t at, const prior_t *prior, const edge_rules_t *rules, minimum_t *out)
{
    const int n = prior->count;
    const int64_t more = window->count - FEWER;
    double *products = out->products;
    out->variance = INFINITY;
    out->solved = 0;
    memset(out->last, 0, sizeof out->last);
    for (int64_t turns = 0; turns < rules->iterations; turns++) {
        if (prior->papered)
            papered_equations(n, values, window, at, rules, products);
        else
            (n == FEWER ? normal_equations : all_normal_equations)(values, window, at, rules, products);
        double variance = products[n * ROWS + n] / (double)(more > 1 ? more : 1);
        variance = variance > rules->min_variance ? variance : rules->min_variance;
        out->variance = variance;
        double step[PARAMETERS];
        for (int k = 0; k < n; k++) {
            products[k * ROWS + k] += prior->information[k] * variance + rules->ridge;
            step[k] = products[n * ROWS + k] + prior->information[k] * variance * (prior->mean[k] - values[k]);
        }
        /* Written twice, so that the number of unknowns is a constant. */
        out->solved = n == FEWER ? solved_step(products, step, FEWER) : solved_step(products, step, PARAMETERS);
        if (!out->solved)
            return;
        for (int k = 0; k < n; k++)
            out->last[k] = -values[k];
        move(values, step, n, rules);
        for (int k = 0; k < n; k++)
            out->last[k] += values[k];
        /* The residuals before a first step that corrects the brightness are not those of the model. */
        if ((turns > 0 || !prior->levelled) && fabs(step[X]) <= rules->converged_px && fabs(step[Y]) <= rules->converged_px
            && fabs(step[S]) <= rules->blur_lag * rules->converged_px * values[S])
            return;
    }
}

/* Fit one corner, whose `contrast` may be unknown (NaN), and set `out` to its OUTCOMES. The sums and numbers of `lag_products` are
 * 0 where the noise is unknown or as small as that of rounding. */
FOR_EACH_PROCESSOR static void fit_corner(
    window_t *window, const double pixel[2], const geometry_t at, double sign, double blur, double contrast,
    const edge_rules_t *rules, double *out)
{
    const prior_t prior = prior_of(window, at, blur, contrast, rules);
    const int64_t more = window->count - FEWER;
    double values[PARAMETERS];
    minimum_t found;
    memcpy(values, prior.mean, sizeof values);
    values[X] = pixel[0] - window->centre_u;
    values[Y] = pixel[1] - window->centre_v;
    if (prior.levelled)
        level(values, window, 0.5 * contrast * sign);
    else
        set_brightness(values, window, at, rules, sign);
    descend(values, window, at, &prior, rules, &found);
    double variance = found.variance, noise = variance;
    memset(out + OUTCOMES - 2 * LAGS, 0, 2 * LAGS * sizeof(double));
    if (rules->mirrored && more > 0) {
        variance = leave_residuals(window, found.last, prior.count) / (double)more;
        variance = variance > rules->min_variance ? variance : rules->min_variance;
        const double mean = unmirrored(values, window, prior.count, rules);
        noise = mean < 0.0 ? variance : mean * (double)window->count / (double)more;
        if (mean >= 0.0 && noise > rules->min_variance)
            lag_products(window, values[Y], out + OUTCOMES - 2 * LAGS);
        noise = noise > rules->min_variance ? noise : rules->min_variance;
    }
    const double spread = found.solved
        ? 0.5 * noise * (inverse_at(found.products, X, prior.count) + inverse_at(found.products, Y, prior.count))
        : NAN;
    const double u = window->centre_u + values[X], v = window->centre_v + values[Y];
    const double side1 = hypot(at.sides[0], at.sides[1]), side2 = hypot(at.sides[2], at.sides[3]);
    double most = rules->valid_move_cells * (side1 > side2 ? side1 : side2);
    most = most > rules->valid_move_px ? most : rules->valid_move_px;
    const int valid = hypot(u - pixel[0], v - pixel[1]) < most && spread > 0.0 && isfinite(spread) && more > 0
        && is_surrounded(window, (float)values[X], (float)values[Y]);
    const double outcome[] = {
        u,
        v,
        valid ? sqrt(spread) : 0.0,
        values[S],
        2.0 * values[B] * sign,
        sqrt(variance),
        sqrt(noise),
        (double)valid,
        (double)window->count};
    memcpy(out, outcome, sizeof outcome);
}

/* Return the side of the square that holds the window and the empty margin in which mirrored pixels may lie. */
static int64_t across_square(const edge_rules_t *rules)
{
    return 2 * ((int64_t)floor(rules->radius_px) + (int64_t)ceil(2.0 * rules->max_mirrored) + LANES) + 1;
}

/* Return the largest number of pixels of a window, padded to blocks. */
static int64_t room_of_window(double radius_px)
{
    const int64_t side = 2 * (int64_t)floor(radius_px) + 1;
    return (side * side / BLOCK + 2) * BLOCK;
}

/* Return the number of floats of scratch that fit_edges needs. */
int64_t edges_scratch(const edge_rules_t *rules)
{
    const int64_t across = across_square(rules);
    return (3 + ROWS) * room_of_window(rules->radius_px) + 4 * across * across + CACHE_LINE / (int64_t)sizeof(float);
}

/* Return an empty window whose arrays are in `scratch` (edges_scratch). */
static window_t window_in(float *scratch, const edge_rules_t *rules)
{
    const int64_t room = room_of_window(rules->radius_px), across = across_square(rules);
    /* Reading a vector across the boundary of two cache lines takes twice the time. */
    scratch += (CACHE_LINE - (uintptr_t)scratch % CACHE_LINE) % CACHE_LINE / sizeof(float);
    float *pictures = scratch + (3 + ROWS) * room;
    /* The margin around the mirrored differences is 0. */
    if (rules->mirrored)
        memset(pictures + 2 * across * across, 0, 2 * (size_t)(across * across) * sizeof(float));
    return (window_t){
        .u = scratch,
        .v = scratch + room,
        .value = scratch + 2 * room,
        .rows = scratch + 3 * room,
        .square = pictures,
        .turned = pictures + across * across,
        .change = pictures + 2 * across * across,
        .paired = pictures + 3 * across * across,
        .across = across,
        .radius = (int64_t)floor(rules->radius_px)};
}

/* Fit the edge model around `count` corners (reference.edges.fit_corners). `window_blur` is the blur by which the windows are
 * chosen; the geometry is that of `geometry_t`. */
void fit_edges(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t count, const double *pixels, const double *sides,
    const double *curvature, const double *curvature_sigma, const double *gaps, const double *tilts, const double *reach,
    const double *paper, const double *single, const double *sign, const double *blur, const double *window_blur,
    const double *contrast, const uint8_t *ends, const edge_rules_t *rules, float *scratch, double *out)
{
    const picture_t image = {grey, width, height, bytes};
    window_t window = window_in(scratch, rules);
    for (int64_t n = 0; n < count; n++) {
        const geometry_t at = {sides + 4 * n, curvature + 2 * n, curvature_sigma + 2 * n, gaps + 4 * n, tilts + 4 * n,
                               reach + 4 * n, paper + 4 * n,     single + 2 * n,          ends + 4 * n};
        collect_window(&window, image, pixels + 2 * n, at, window_blur[n], rules);
        fit_corner(&window, pixels + 2 * n, at, sign[n], blur[n], contrast[n], rules, out + OUTCOMES * n);
    }
}

/* Fit the corner of a tag from `pixel`. `seen` is the row of the board's map (SURFACE_COLUMNS), `step` the distances of the
 * neighbouring lines in sides of a tag. The window reaches halfway to these, and ends in the tag's border before the code. */
static void fit_tag_corner(
    window_t *window, const picture_t image, const double pixel[2], const double *seen, const double step[4],
    const double single[2], double sign, double blur, double contrast, const tag_window_t *tag, const edge_rules_t *rules,
    double *out)
{
    static const double none[4] = {0.0}, unknown[4] = {NAN, NAN, NAN, NAN};
    static const uint8_t inside[4] = {0};
    const double *high = seen + HEIGHTS, border = tag->border * (high[0] < high[1] ? high[0] : high[1]);
    const double expected = clipped(blur, rules->min_blur, rules->max_blur);
    const double narrow = (border - tag->blurs * blur - rules->near_px) / rules->near_sigmas;
    double gaps[4], reach[4];
    for (int k = 0; k < 4; k++) {
        gaps[k] = single[0] != 0.0 ? tag->nothing_near : step[k] * high[k / 2];
        reach[k] = 0.5 * step[k] < rules->reach ? 0.5 * step[k] : rules->reach;
    }
    const geometry_t at = {seen + SIDES, seen + CURVATURE, none, gaps, none, reach, unknown, single, inside};
    collect_window(window, image, pixel, at, clipped(narrow, rules->min_blur, expected), rules);
    fit_corner(window, pixel, at, sign, expected, contrast, rules, out);
}

/* Fit the corners of tags (reference.edges.fit_tag_corners): the `count` of the board's `places` corners that `cells` marks. */
void fit_tag_edges(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t places, const uint8_t *cells, const double *steps,
    const double *signs, int64_t count, const double *pixels, const double *surface, const double *single, const double *contrast,
    const double *blur, const tag_window_t *tag, const edge_rules_t *rules, float *scratch, double *out)
{
    const picture_t image = {grey, width, height, bytes};
    window_t window = window_in(scratch, rules);
    for (int64_t place = 0, n = 0; place < places && n < count; place++)
        if (cells[place]) {
            fit_tag_corner(
                &window, image, pixels + 2 * n, surface + SURFACE_COLUMNS * n, steps + 4 * place, single + 2 * n, signs[place],
                blur[n], contrast[n], tag, rules, out + OUTCOMES * n);
            n++;
        }
}

/* Return the median blur s of every `stride`-th of these corners, fitted from `blur`; NaN if no fit succeeds. `found` is
 * scratch. */
double blur_of_tags(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t places, const uint8_t *cells, const double *steps,
    const double *signs, int64_t count, const double *pixels, const double *surface, const double *single, const double *contrast,
    int64_t stride, double blur, const tag_window_t *tag, const edge_rules_t *rules, float *scratch, double *found)
{
    const picture_t image = {grey, width, height, bytes};
    window_t window = window_in(scratch, rules);
    int64_t seen = 0;
    for (int64_t place = 0, n = 0; place < places && n < count; place++) {
        if (!cells[place])
            continue;
        if (n % stride == 0) {
            double fitted[OUTCOMES];
            fit_tag_corner(
                &window, image, pixels + 2 * n, surface + SURFACE_COLUMNS * n, steps + 4 * place, single + 2 * n, signs[place],
                blur, contrast[n], tag, rules, fitted);
            found[seen] = fitted[BLUR];
            seen += fitted[VALID] > 0.5 && fitted[CONTRAST] > 0.0;
        }
        n++;
    }
    return seen > 0 ? quick_median(found, seen) : NAN;
}
