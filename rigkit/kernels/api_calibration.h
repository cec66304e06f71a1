/* Declarations of api.h: cameras and the normal equations of calibrations. */
#ifndef RIGKIT_KERNELS_API_CALIBRATION_H
#define RIGKIT_KERNELS_API_CALIBRATION_H

/* departures.c */

/* Displacements of an image that lens models leave out: RADIAL_POWERS powers of the radius, and eight that are not radial
 * (calibration.departures). A pose has POSE parameters. */
enum { RADIAL_POWERS = 5, DISPLACEMENTS = RADIAL_POWERS + 8, POSE = 6 };

/* Corners of boards, `counts` in each view: derivatives of their pixels, lever arms (board corner minus the board's origin, in
 * the camera frame), projections, residuals, and which corners are used. Derivatives by the parameters are multiplied by
 * `sigmas`. */
typedef struct {
    ARRAY(const double, d_pixels_d_point, 2, 3, count);
    ARRAY(const double, d_pixels_d_parameters, 2, parameters, count);
    ARRAY(const double, sigmas, parameters);
    ARRAY(const double, lever, 3, count);
    ARRAY(const double, u, count);
    ARRAY(const double, v, count);
    ARRAY(const double, residuals, count, 2);
    ARRAY(const uint8_t, usable, count);
    ARRAY(const int64_t, counts, views);
    int64_t count, parameters, views, width, height;
} lens_corners_t;

EXPORT void displace_pixels(
    ARRAY(const double, u, count), ARRAY(const double, v, count), int64_t count, int64_t width, int64_t height,
    RESULT(double, out, 2, DISPLACEMENTS, count));
EXPORT void displace_by(
    ARRAY(const double, u, count), ARRAY(const double, v, count), int64_t count, int64_t width, int64_t height,
    ARRAY(const double, amounts, DISPLACEMENTS), RESULT(double, out, 2, count));
EXPORT int64_t lens_memory(int64_t parameters);
EXPORT void lens_products(
    const lens_corners_t *corners, SCRATCH(double, memory, lens_memory(corners.parameters)),
    RESULT(double, products, corners.views, POSE + corners.parameters + DISPLACEMENTS + 1,
        POSE + corners.parameters + DISPLACEMENTS + 1));
EXPORT void average_amounts(
    ARRAY(const double, information, DISPLACEMENTS, DISPLACEMENTS), ARRAY(const double, score, DISPLACEMENTS),
    ARRAY(const double, sizes, count), int64_t count, RESULT(double, out, DISPLACEMENTS, DISPLACEMENTS),
    RESULT(double, average, DISPLACEMENTS));

/* board_pose.c */

/* Set the residuals of the poses and their derivatives; `sets` is 1 (the same rays for all poses) or `poses`. */
EXPORT void ray_residuals(
    ARRAY(const double, rays, sets, count, 3), ARRAY(const double, bases, sets, count, 2, 3), int64_t sets,
    ARRAY(const double, points, count, 3), int64_t count, ARRAY(const double, rotation, poses, 3, 3),
    ARRAY(const double, translation, poses, 3), int64_t poses, RESULT(double, residuals, poses, count, 2),
    RESULT(double, jacobian, poses, count, 2, POSE));
/* Replace the poses by the minima that the descent from them reaches. */
EXPORT void refine_board_poses(
    ARRAY(const double, rays, sets, count, 3), ARRAY(const double, bases, sets, count, 2, 3), int64_t sets,
    ARRAY(const double, points, count, 3), int64_t count, ARRAY(double, rotation, poses, 3, 3),
    ARRAY(double, translation, poses, 3), int64_t poses, int64_t max_steps, double tolerance, RESULT(double, costs, poses));

/* linearise.c */

/* Views of boards, padded to `corners` corners each, and the weights of their residuals (calibration.linearise): poses, the
 * boards' points (`table`) with their derivatives by the warp parameters, the point of each corner, and the index of each point
 * among the released ones (-1 if it is fixed). Corners that do not project have residuals of `lost_px` along both axes. The loss
 * is Cauchy's of scale `loss_px`, or least squares if that is zero. */
typedef struct {
    ARRAY(const double, rotation, views, 3, 3);
    ARRAY(const double, translation, views, 3);
    ARRAY(const double, table, points, 3);
    ARRAY(const double, warp, points, 3, warps);
    ARRAY(const int64_t, place, points);
    ARRAY(const int64_t, point, views, corners);
    ARRAY(const double, pixels, views, corners, 2);
    ARRAY(const double, weight, views, corners);
    int64_t views, corners, points, warps, released;
    double loss_px, lost_px;
} board_views_t;

/* The linearised views: residuals, which corners project, the cost of each view, and J^T J of its `across` columns; for each
 * released point the products of its three columns with all columns and with themselves, and with those of each view's pose. */
typedef struct {
    ARRAY(double, residuals, 2, views, corners);
    ARRAY(uint8_t, valid, views, corners);
    ARRAY(double, costs, views);
    ARRAY(double, products, views, across, across);
    ARRAY(double, own, released, 3, across + 3);
    ARRAY(double, poses, views, released, 3, POSE);
    int64_t views, corners, across, released;
} view_sums_t;

/* Return the corners of the views from `first` on in the camera frame (`points`), and without the translation (`lever`). */
EXPORT void place_corners(
    const board_views_t *seen, int64_t first, int64_t count, RESULT(double, lever, 3, count),
    RESULT(double, points, 3, count));
EXPORT int64_t rows_memory(int64_t across);
EXPORT void add_views(
    const board_views_t *seen, int64_t first, int64_t count, int64_t parameters,
    ARRAY(const double, d_pixels_d_point, 2, 3, count), ARRAY(const double, d_pixels_d_parameters, 2, parameters, count),
    ARRAY(const double, u, count), ARRAY(const double, v, count), ARRAY(const uint8_t, projects, count),
    ARRAY(const double, lever, 3, count), SCRATCH(double, memory, rows_memory(sums.across)), const view_sums_t *sums);

/* schur.c */

/* Blocks of the normal equations of global parameters and of the poses of views (calibration.normal_equations). */
typedef struct {
    ARRAY(const double, gg, globals, globals);
    ARRAY(const double, gp, views, globals, POSE);
    ARRAY(const double, pp, views, POSE, POSE);
    ARRAY(const double, g, globals);
    ARRAY(const double, p, views, POSE);
    int64_t globals, views;
} normal_equations_t;

EXPORT int64_t schur_memory(int64_t globals, int64_t views);
EXPORT int64_t solve_schur(
    const normal_equations_t *normal, double damping, SCRATCH(double, memory, schur_memory(normal.globals, normal.views)),
    RESULT(double, step_g, normal.globals), RESULT(double, step_p, normal.views, POSE), RESULT(double, predicted, 1));

/* close_pairs.c */

EXPORT int64_t close_pairs(
    ARRAY(const double, points, count, axes), int64_t count, int64_t axes, double reach, ARRAY(const int64_t, ends, count, 4),
    ARRAY(int64_t, pairs, capacity, 2), int64_t capacity);

/* leverage.c */

EXPORT void sum_series(
    ARRAY(const double, leverage, clusters, n, n), ARRAY(const double, pull, clusters, columns, n), int64_t clusters,
    int64_t columns, int64_t n, double bound, ARRAY(const double, series, terms), int64_t terms,
    SCRATCH(double, memory, 3 * n), RESULT(double, out, clusters, columns, n));

/* coverage.c */

EXPORT void cover_pixels(
    ARRAY(const int64_t, grid, count, 2), ARRAY(const double, corners, count, 2), int64_t count,
    ARRAY(const int64_t, counts, views), int64_t views, double squares, ARRAY(const double, pixels, asked, 2), int64_t asked,
    RESULT(truth_t, covered, asked));

/* brown.c */

/* Points in the camera frame and the parameters of a camera: fx, fy, cx, cy, k1, k2, p1, p2, k3 ... k6, zero for those that it
 * lacks. Derivatives are written by `axes` coordinates of the point and by `rows` parameters, each all or 0; derivatives that
 * are always zero are not written. */
typedef struct {
    ARRAY(const double, x, count);
    ARRAY(const double, y, count);
    ARRAY(const double, z, count);
    ARRAY(const double, parameters, 12);
    int64_t count, axes, rows, rational;
    double max_r;
} brown_points_t;

EXPORT void differentiate_brown(
    const brown_points_t *points, ARRAY(double, d_pixels_d_point, 2, points.axes, points.count),
    ARRAY(double, d_pixels_d_parameters, 2, points.rows, points.count), RESULT(double, u, points.count),
    RESULT(double, v, points.count), RESULT(truth_t, valid, points.count));
EXPORT void undistort_brown(
    ARRAY(const double, parameters, 12), double max_r, int64_t rational, ARRAY(const double, m, 2, count), int64_t count,
    ARRAY(double, plane, 2, count), RESULT(truth_t, valid, count));

/* radial.c */

/* Points in the camera frame and a camera with rotational symmetry: pixel = L s (x, y) + centre with L = ((l00, l01), (0, l11)),
 * and the coefficients of s: k1 ... k4, or those of f(rho) from the power zero on. Derivatives as above. */
typedef struct {
    ARRAY(const double, x, count);
    ARRAY(const double, y, count);
    ARRAY(const double, z, count);
    ARRAY(const double, polynomial, terms);
    int64_t count, terms, axes, rows;
    double l00, l01, l11, cx, cy, max_angle, max_radius;
} radial_points_t;

EXPORT void differentiate_kannala_brandt(
    const radial_points_t *points, ARRAY(double, d_pixels_d_point, 2, points.axes, points.count),
    ARRAY(double, d_pixels_d_parameters, 2, points.rows, points.count), RESULT(double, u, points.count),
    RESULT(double, v, points.count), RESULT(truth_t, valid, points.count));
EXPORT void differentiate_scaramuzza(
    const radial_points_t *points, ARRAY(double, d_pixels_d_point, 2, points.axes, points.count),
    ARRAY(double, d_pixels_d_parameters, 2, points.rows, points.count), RESULT(double, u, points.count),
    RESULT(double, v, points.count), RESULT(truth_t, valid, points.count));

/* monotone.c */

/* Functions linear x + factor P(x) - offset, which increase from `low` to `high`, and a table of approximate roots at equal steps
 * of `target` from `first` to `last`. */
typedef struct {
    ARRAY(const double, polynomial, terms);
    ARRAY(const double, linear, count);
    ARRAY(const double, factor, count);
    ARRAY(const double, offset, count);
    ARRAY(const double, target, count);
    ARRAY(const double, table, cells + 1);
    int64_t terms, count, cells;
    double first, last, low, high;
} increasing_t;

EXPORT void invert_increasing(const increasing_t *functions, RESULT(double, out, functions.count));
EXPORT double smallest_root(
    ARRAY(const double, polynomials, count, terms), int64_t count, int64_t terms, double limit,
    SCRATCH(double, memory, 2 * terms));

#endif
