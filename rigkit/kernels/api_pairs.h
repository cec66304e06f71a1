/* Declarations of api.h: poses and surfaces of pairs of images. */
#ifndef RIGKIT_KERNELS_API_PAIRS_H
#define RIGKIT_KERNELS_API_PAIRS_H

/* five_point.c, with roots.c */

enum { MAX_ROOTS = 10 };

EXPORT void five_rows(ARRAY(const double, rows, count, 5, 9), int64_t count, RESULT(double, out, count, MAX_ROOTS, 3, 3));

/* six_point.c */

EXPORT void six_rows(ARRAY(const double, rows, count, 6, 9), int64_t count, RESULT(double, out, count, 1, 3, 3));

/* pose_quality.c */

EXPORT void residuals(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(const double, E, hypotheses, 3, 3), int64_t hypotheses,
    RESULT(double, out, hypotheses, count));
EXPORT void qualities(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(const double, E, hypotheses, 3, 3), int64_t hypotheses,
    double noise, RESULT(double, out, hypotheses));
EXPORT void qualities_ahead(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(const double, R, hypotheses, 2, 3, 3),
    ARRAY(const double, t, hypotheses, 3), int64_t hypotheses, double noise, double sigmas, RESULT(double, out, hypotheses));
EXPORT void improve(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(double, R, hypotheses, 3, 3),
    ARRAY(double, t, hypotheses, 3), double noise, int64_t hypotheses, ARRAY(const int64_t, free, freedom), int64_t freedom,
    int64_t max_steps, double settled);

/* pose_minimum.c */

enum { NO_MEMORY = -1000 };

/* The measurements and options of the maximum likelihood pose (pose_problem.PoseProblem). `affine` are 25 rows of `chosen`
 * numbers (residuals.whitened_affinities). */
typedef struct {
    ARRAY(const double, packed, 18, count);
    ARRAY(const double, affine, 25, chosen);
    ARRAY(const double, point_weights, count);
    ARRAY(const int64_t, which, chosen);
    ARRAY(const int64_t, free, freedom);
    int64_t count, chosen, freedom, loss, max_iterations;
    double scale, tolerance;
} pose_problem_t;

EXPORT int64_t minimise(
    const pose_problem_t *problem, ARRAY(double, R, 3, 3), ARRAY(double, t, 3),
    RESULT(double, r, problem.count + 2 * problem.chosen), RESULT(double, J, problem.count + 2 * problem.chosen, 5),
    RESULT(double, w, problem.count + 2 * problem.chosen));

/* patches.c, with epipolar_lines.c */

/* Largest number of levels of a pyramid; largest half side of a patch in samples; the columns of a patch: position in image 2,
 * affinity row by row, correlation, variance of the brightness residuals, number of levels that the alignment is coarser than
 * the sharpness of the images permits, and the upper triangle of the covariance of position and affinity, row by row. */
enum { MAX_LEVELS = 8, MAX_HALF = 16, PATCH_COLUMNS = 9 + 21 };

/* An image and its reductions: pixel of level l = pixel of the image / 2^l. */
typedef struct {
    image_t levels[MAX_LEVELS];
    int64_t count;
} pyramid_t;

/* The constants of affine.refine_patches; `half` is the half side of the patch, its window a Gaussian of `width`, both in
 * samples. */
typedef struct {
    int64_t half, coarsest, max_steps;
    double width, settled, max_move, min_contrast, min_correlation, max_sigma, min_noise, excess_noise;
} patch_rules_t;

/* The rays of image 2 every `spacing` pixels, the essential matrix, and the standard deviations of a pair's distance from its
 * epipolar line, px, and of its affinity's deviation from it; an infinite sigma leaves the geometry out. */
typedef struct {
    ARRAY(const double, rays2, rows, columns, 3);
    int64_t rows, columns;
    double spacing, E21[9], sigma, sigma_A, max_distance;
} epipolar_t;

/* The grid over which patches are grown: node (r, c) is the pixel `step` * (c, r) of image 1. */
typedef struct {
    ARRAY(const double, rays1, rows, columns, 3);
    ARRAY(const double, jacobians1, rows, columns, 3, 2);
    ARRAY(double, out, rows, columns, PATCH_COLUMNS);
    SCRATCH(uint8_t, tries, rows, columns);
    SCRATCH(int32_t, heap, rows, columns);
    int64_t rows, columns, step, max_tries;
} patch_grid_t;

EXPORT void align_patches(
    const pyramid_t *first, const pyramid_t *second, const patch_rules_t *rules, ARRAY(const double, starts, count, 8),
    int64_t count, RESULT(double, out, count, PATCH_COLUMNS));

/* patch_growth.c */

EXPORT int64_t grow_patches(
    const pyramid_t *first, const pyramid_t *second, const epipolar_t *epipolar, const patch_rules_t *rules,
    const patch_grid_t *grid, ARRAY(const double, seeds, count, 8), int64_t count);

/* planes.c */

/* Measurements of a surface at the nodes of a grid (reconstruction.growing.surface): values, NaN where missing, their information
 * matrices (inverse covariances), and the matrices that map a plane to the predicted values; offsets of the measured points from
 * their nodes, which are `step` px apart, and the variances of the windows that measured them, px^2. */
typedef struct {
    ARRAY(const double, values, rows, columns, 3);
    ARRAY(const double, information, rows, columns, 3, 3);
    ARRAY(const double, frames, rows, columns, 3, 3);
    ARRAY(const double, offsets, rows, columns, 2);
    ARRAY(const double, windows, rows, columns);
    int64_t rows, columns, reach, rounds;
    double turn, step;
} plane_grid_t;

EXPORT int64_t fit_planes(
    const plane_grid_t *grid, RESULT(double, planes, grid.rows, grid.columns, 3),
    RESULT(double, normals, grid.rows, grid.columns, 3, 3), RESULT(double, support, grid.rows, grid.columns),
    RESULT(double, squares, grid.rows, grid.columns), RESULT(double, mixed, grid.rows, grid.columns, 3, 3),
    RESULT(double, bends, grid.rows, grid.columns, 3, 3), RESULT(double, pull, grid.rows, grid.columns, 3));

/* sweep.c */

/* Samples of image 1 (rows x columns), and at every `spacing`-th of them the pixel of image 2 at each range of a sweep
 * (reconstruction.growing.sweep), NaN outside its field of view; in between these pixels are interpolated. */
typedef struct {
    ARRAY(const float, table, levels, table_rows, table_columns, 2);
    int64_t levels, table_rows, table_columns, spacing, rows, columns;
} sweep_t;

/* Costs of a step to the next level (`bend`), and of any larger one: `jump` where the brightness is constant, halfway from `bend`
 * to `jump` where it changes by `even`. */
typedef struct {
    int64_t rows, columns, levels, bend, jump;
    double even;
} surface_rules_t;

/* Bits of the census transform over 5 x 5 samples: whether each of the neighbours is darker. */
enum { CENSUS_BITS = 24 };

EXPORT int64_t sweep_levels(int64_t levels);
EXPORT int64_t sweep_cost_memory(int64_t columns);
EXPORT int64_t sweep_path_memory(int64_t columns, int64_t levels);
EXPORT void sweep_costs(
    const sweep_t *sweep, const image_t *image2, ARRAY(const float, samples1, sweep.rows, sweep.columns),
    SCRATCH(float, memory, sweep_cost_memory(sweep.columns)),
    RESULT(uint8_t, costs, sweep.rows, sweep.columns, sweep_levels(sweep.levels)));
EXPORT void sweep_surfaces(
    const surface_rules_t *rules, ARRAY(const uint8_t, costs, rules.rows, rules.columns, sweep_levels(rules.levels)),
    ARRAY(const float, samples1, rules.rows, rules.columns),
    SCRATCH(uint8_t, memory, sweep_path_memory(rules.columns, rules.levels)),
    RESULT(uint16_t, total, rules.rows, rules.columns, sweep_levels(rules.levels)));
EXPORT void sweep_winners(
    const surface_rules_t *rules, ARRAY(const uint16_t, total, rules.rows, rules.columns, sweep_levels(rules.levels)),
    RESULT(int32_t, best, rules.rows, rules.columns), RESULT(int32_t, around, rules.rows, rules.columns, 4));

/* Surfaces at some samples (row, column): the level, its change per row and per column, and the number of levels from it at which
 * another surface begins. The weight of a neighbouring sample falls with its distance, in units of `radius` samples, and with the
 * difference of its brightness, in units of `alike`. */
typedef struct {
    ARRAY(const int32_t, samples, count, 2);
    ARRAY(const float, surfaces, count, 4);
    int64_t count, rows, columns, levels;
    double radius, alike;
} claims_t;

EXPORT void sweep_rivals(
    const claims_t *claims, ARRAY(const uint8_t, costs, claims.rows, claims.columns, sweep_levels(claims.levels)),
    ARRAY(const float, samples1, claims.rows, claims.columns), SCRATCH(uint16_t, memory, sweep_levels(claims.levels)),
    RESULT(float, found, claims.count, 2));

/* sweep_planes.c */

/* The surface of a sweep: its levels, where it is seen, and the brightness of image 1; some samples (row, column), around which
 * planes are fitted over `reach` samples. A weight falls with the distance, in units of `radius` samples, and with the difference
 * of brightness, in units of `alike`. */
typedef struct {
    ARRAY(const double, winners, rows, columns);
    ARRAY(const uint8_t, seen, rows, columns);
    ARRAY(const float, brightness, rows, columns);
    ARRAY(const int32_t, samples, count, 2);
    int64_t rows, columns, count, reach;
    double radius, alike;
} level_grid_t;

EXPORT int64_t level_fit_memory(int64_t reach);
EXPORT void fit_level_planes(
    const level_grid_t *grid, SCRATCH(float, memory, level_fit_memory(grid.reach)), RESULT(double, planes, grid.count, 3),
    RESULT(double, normals, grid.count, 3, 3), RESULT(double, agreement, grid.count, 2));

#endif
