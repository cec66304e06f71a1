/* What Python calls: every function, structure and constant that both sides know, declared here alone. The compiler
 * checks the kernels against this file, and rigkit.kernels.declarations reads it to make the calls, so it is plain: no
 * conditions, and of the preprocessor only the two macros below.
 *
 * ARRAY(type, name, sizes...) is a pointer to the first value of a C-contiguous array; its sizes are what the caller's
 * array must have, in terms of the other arguments or members. */
#ifndef RIGKIT_KERNELS_API_H
#define RIGKIT_KERNELS_API_H

#include <stdint.h>

#define ARRAY(type, name, ...) type *name

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* library.c */

/* The instruction set that hot functions are run with on this processor. */
EXPORT const char *instruction_set(void);

/* front.c */

/* Samples of a ring in half a turn (detection.saddles.ring): known here, the loops over them need no counting. */
enum { HALF = 16, TURN = 2 * HALF };

/* Pixels that the tests of a row are made for at a time: the results stay in registers and the first cache. */
enum { STRIP = 64 };

/* An image of brightness. */
typedef struct {
    ARRAY(const float, brightness, height, width);
    int64_t width, height;
} image_t;

/* How rings are read (detection.saddles.ring): `circle` holds the (u, v) of HALF samples in half a turn and of their
 * opposites; `gains` R_2 / R_4 over the ratio of harmonic 2 at half the radius to that on the ring, from 1/4 to 1. */
typedef struct {
    ARRAY(const float, circle, TURN, 2);
    ARRAY(const double, gains, gain_count);
    int64_t gain_count;
    double most_odd, most_centre, most_cosine, quick_odd, quick_centre, quick_sharp;
} ring_rules_t;

/* The constants of detection.lattice.links. */
typedef struct {
    int64_t neighbours, places, most;
    ARRAY(const double, along, places);
    double arm_cosine, contrast_ratio, length_ratio, aside, least_aside;
} link_rules_t;

/* The corners and the level that their edges are read from. */
typedef struct {
    ARRAY(const double, pixels, count, 2);
    ARRAY(const double, lines, count, 2, 2);
    ARRAY(const double, contrast, count);
    ARRAY(const double, least, count);
    ARRAY(const double, most, count);
    ARRAY(const double, reach, count);
    int64_t count;
} corners_t;

EXPORT void shrink_floats(
    ARRAY(const float, image, height, width), int64_t height, int64_t width, int64_t factor, ARRAY(float, sums, width),
    ARRAY(float, out, height / factor, width / factor));
EXPORT void shrink_bytes(
    ARRAY(const uint8_t, image, height, width), int64_t height, int64_t width, int64_t factor,
    ARRAY(uint16_t, sums, width), ARRAY(float, out, height / factor, width / factor));
EXPORT void smooth_floats(
    ARRAY(const float, image, height, width), int64_t height, int64_t width, ARRAY(const float, kernel, 5),
    ARRAY(float, column, width + 4), ARRAY(float, out, height, width),
    ARRAY(float, half, (height + 1) / 2, (width + 1) / 2));
EXPORT void smooth_bytes(
    ARRAY(const uint8_t, image, height, width), int64_t height, int64_t width, ARRAY(const float, kernel, 5), float whole,
    ARRAY(uint16_t, column, width + 4), ARRAY(float, out, height, width),
    ARRAY(float, half, (height + 1) / 2, (width + 1) / 2));
EXPORT void typical_values(
    ARRAY(const float, smooth, height, width), int64_t height, int64_t width, int64_t step,
    int64_t few, ARRAY(float, response, ((height - 3) / step + 1) * ((width - 3) / step + 1)),
    ARRAY(float, brightness, ((height - 3) / step + 1) * ((width - 3) / step + 1)), ARRAY(float, out, 3));
EXPORT int64_t find_peaks(
    ARRAY(const float, smooth, height, width), int64_t height, int64_t width, float threshold,
    ARRAY(float, scratch, 5 * (width + STRIP + 4)), ARRAY(uint8_t, high, 5 * (width / STRIP + 1)),
    ARRAY(int32_t, at, (height / 3 + 1) * (width / 3 + 1), 2),
    ARRAY(float, response, (height / 3 + 1) * (width / 3 + 1)));
EXPORT int64_t keep_strongest(
    ARRAY(int32_t, at, count, 2), ARRAY(float, response, count), int64_t count, int64_t height, int64_t width, int64_t side,
    int64_t most, int64_t finest, ARRAY(float, squares, (height / side + 1) * (width / side + 1)),
    ARRAY(int32_t, bins, finest + 1), ARRAY(int32_t, share, count));
EXPORT int64_t find_corners(
    image_t image, const ring_rules_t *rules, double radius, double most_step, double most_sharp,
    ARRAY(const int32_t, peaks, count, 2), ARRAY(const float, response, count), int64_t count,
    ARRAY(double, saddles, count, 2), ARRAY(int64_t, which, count), ARRAY(double, angles, count + 1, 2),
    ARRAY(double, contrast, count + 1), ARRAY(int64_t, found, 1));
EXPORT int64_t mark_known(
    ARRAY(const double, fresh, count, 2), int64_t count, ARRAY(const double, known, known_count, 2), int64_t known_count,
    double reach, ARRAY(uint8_t, mark, count));
EXPORT int64_t find_links(
    const corners_t *corners, image_t image, double scale, double offset, const link_rules_t *rules,
    ARRAY(int64_t, nearest, corners.count, 4), ARRAY(int64_t, both, corners.count, 4));

/* growth.c */

enum { FIT_COLUMNS = 12 };

/* The constants of detection.lattice.local_fit. */
typedef struct {
    int64_t degree, radius, leave_out;
    double width, ridge[2];
} fit_rules_t;

/* See the constants of detection.lattice.grow, detection.lattice.links and detection.saddles.ring. */
typedef struct {
    fit_rules_t predictions[2];
    const ring_rules_t *ring;
    ARRAY(const double, along, places);
    int64_t places, most, tried, fewest;
    double reach, ring_part, min_ring, max_ring, line_sine, contrast_ratio, aside, min_aside, max_aside, least_area;
} growth_rules_t;

/* The brightness of a level: full-resolution pixel = scale * level pixel + offset. */
typedef struct {
    image_t image;
    double scale, offset;
} pyramid_level_t;

/* A lattice within empty cells; `sign` of the cell (0, 0) is +1 where brightness grows with the angle across its +column
 * edge. `due` marks the cells to be tried with each of the two predictions. */
typedef struct {
    ARRAY(double, pixels, rows, columns, 2);
    ARRAY(double, contrast, rows, columns);
    ARRAY(uint8_t, due, 2, rows, columns);
    int64_t rows, columns;
    double sign;
} sheet_t;

/* Points in squares: those of square b are order[first[b]] to order[first[b + 1] - 1]; filled by `sort_points`. */
typedef struct {
    const double *points;
    int32_t *first, *order;
    int64_t columns, rows;
    double left, top, side;
} squares_t;

EXPORT void fit_cells(
    ARRAY(const double, lattice, rows, columns, 2), int64_t rows, int64_t columns,
    ARRAY(const uint8_t, cells, rows, columns), const fit_rules_t *rules, int64_t count,
    ARRAY(double, out, count, FIT_COLUMNS));
EXPORT int64_t squares_memory(int64_t count);
EXPORT void sort_points(
    ARRAY(const double, points, count, 2), int64_t count, ARRAY(int32_t, memory, squares_memory(count)), squares_t *out);
EXPORT int64_t grow_lattice(
    sheet_t *sheet, const pyramid_level_t *level, const squares_t *saddles, const growth_rules_t *rules, int64_t rings,
    ARRAY(double, fresh, sheet.rows * sheet.columns, 3), ARRAY(int64_t, where, sheet.rows * sheet.columns));
EXPORT int64_t find_components(
    int64_t count, ARRAY(int64_t, to, count, 4), ARRAY(int64_t, label, count), ARRAY(int64_t, grid, count, 2),
    ARRAY(int64_t, turn, count), ARRAY(int64_t, members, count), ARRAY(int64_t, queue, 2 * count),
    ARRAY(uint8_t, bound, 4 * count));

/* lattice.c */

/* The constants of detection.subpixel.scatter. */
typedef struct {
    double unexplained, median_of_normal;
    int64_t fewest_corners, fewest_differences, first_order, last_order;
} scatter_rules_t;

EXPORT void uneven_steps(
    ARRAY(const double, pixels, rows, columns, 2), int64_t rows, int64_t columns,
    ARRAY(double, scratch, 2 * rows * columns), int64_t inner, ARRAY(double, typical, inner),
    ARRAY(int64_t, seen, inner), ARRAY(double, every, 2));
EXPORT void excess_scatter(
    ARRAY(const double, pixels, height, width, 2), ARRAY(const double, sigma, height, width), int64_t height,
    int64_t width, ARRAY(const int64_t, parts, count, 4), int64_t count, const scatter_rules_t *rules,
    ARRAY(double, scratch, 7 * height * width), ARRAY(double, out, count));
EXPORT void edge_shifts(
    ARRAY(const double, pixels, rows, columns, 2), int64_t rows, int64_t columns, double sign, image_t image, double scale,
    double offset, double reach, ARRAY(const double, along, parts), int64_t parts, int64_t steps, int64_t most,
    ARRAY(double, sums, parts, steps + 1), ARRAY(double, out, parts));

/* departures.c */

/* Displacements of an image that models leave out: so many powers of the radius, and of those that are not radial eight
 * (calibration.departures). A pose has six numbers. */
enum { RADIAL_POWERS = 5, DISPLACEMENTS = RADIAL_POWERS + 8, POSE = 6 };

/* Corners of boards, view after view so many: their derivatives, what turns with the pose (board corner less the board's
 * origin, in the camera frame), where they project, the residuals, and which of them tell anything. The derivatives by the
 * parameters count in units of `sigmas`. */
typedef struct {
    ARRAY(const double, d_pixels_d_point, 2, 3, count);
    ARRAY(const double, d_pixels_d_parameters, 2, parameters, count);
    ARRAY(const double, sigmas, parameters);
    ARRAY(const double, lever, 3, count);
    ARRAY(const double, u, count);
    ARRAY(const double, v, count);
    ARRAY(const double, residuals, count, 2);
    ARRAY(const uint8_t, told, count);
    ARRAY(const int64_t, counts, views);
    int64_t count, parameters, views, width, height;
} lens_corners_t;

EXPORT void displace_pixels(
    ARRAY(const double, u, count), ARRAY(const double, v, count), int64_t count, int64_t width, int64_t height,
    ARRAY(double, out, 2, DISPLACEMENTS, count));
EXPORT void displace_by(
    ARRAY(const double, u, count), ARRAY(const double, v, count), int64_t count, int64_t width, int64_t height,
    ARRAY(const double, amounts, DISPLACEMENTS), ARRAY(double, out, 2, count));
EXPORT int64_t lens_memory(int64_t parameters);
EXPORT void lens_products(
    const lens_corners_t *corners, ARRAY(double, memory, lens_memory(corners.parameters)),
    ARRAY(double, with_pose, corners.views, POSE + corners.parameters + DISPLACEMENTS + 1, POSE),
    ARRAY(double, products, corners.parameters + DISPLACEMENTS + 1, corners.parameters + DISPLACEMENTS + 1));
EXPORT void average_amounts(
    ARRAY(const double, information, DISPLACEMENTS, DISPLACEMENTS), ARRAY(const double, score, DISPLACEMENTS),
    ARRAY(const double, sizes, count), int64_t count, ARRAY(double, out, DISPLACEMENTS, DISPLACEMENTS));

/* linearise.c */

/* Views of boards, padded to so many corners each, and what their residuals weigh (calibration.linearise): poses, the boards'
 * points and by how much a warp moves them, which point each corner is, and where each point stands among those released (-1
 * where it does not). Corners that do not project are `lost_px` off, along both axes; the loss is least squares where
 * `loss_px` is zero. */
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

/* What they come to: residuals, which corners project, the cost of each view, and the sums of products of its `across` rows;
 * of the released points those with all rows of their corners and their own three, and with the poses. */
typedef struct {
    ARRAY(double, residuals, 2, views, corners);
    ARRAY(uint8_t, valid, views, corners);
    ARRAY(double, costs, views);
    ARRAY(double, products, views, across, across);
    ARRAY(double, own, released, 3, across + 3);
    ARRAY(double, poses, views, released, 3, POSE);
    int64_t views, corners, across, released;
} view_sums_t;

/* Where the corners of the views from `first` on stand in the camera frame, and those without the translation. */
EXPORT void place_corners(
    const board_views_t *seen, int64_t first, int64_t count, ARRAY(double, lever, 3, count), ARRAY(double, points, 3, count));
EXPORT int64_t rows_memory(int64_t across);
EXPORT void add_views(
    const board_views_t *seen, int64_t first, int64_t count, int64_t parameters,
    ARRAY(const double, d_pixels_d_point, 2, 3, count), ARRAY(const double, d_pixels_d_parameters, 2, parameters, count),
    ARRAY(const double, u, count), ARRAY(const double, v, count), ARRAY(const uint8_t, projects, count),
    ARRAY(const double, lever, 3, count), ARRAY(double, memory, rows_memory(sums.across)), const view_sums_t *sums);

/* coverage.c */

EXPORT void cover_pixels(
    ARRAY(const int64_t, grid, count, 2), ARRAY(const double, corners, count, 2), int64_t count,
    ARRAY(const int64_t, counts, views), int64_t views, double squares, ARRAY(const double, pixels, asked, 2), int64_t asked,
    ARRAY(uint8_t, covered, asked));

/* brown.c */

/* Points in the camera frame and a camera: fx, fy, cx, cy, k1, k2, p1, p2, k3 ... k6, zero where it has less of them. Of
 * derivatives by parameters so many `rows` are written, none or those that the camera has; zeros are not. */
typedef struct {
    ARRAY(const double, x, count);
    ARRAY(const double, y, count);
    ARRAY(const double, z, count);
    ARRAY(const double, parameters, 12);
    int64_t count, rows, rational;
    double max_r;
} brown_points_t;

EXPORT void differentiate_brown(
    const brown_points_t *points, ARRAY(double, d_pixels_d_point, 2, 3, points.count),
    ARRAY(double, d_pixels_d_parameters, 2, points.rows, points.count), ARRAY(double, u, points.count),
    ARRAY(double, v, points.count), ARRAY(uint8_t, valid, points.count));

/* monotone.c */

/* Functions linear x + factor P(x) - offset that increase from `low` to `high`, and a table of their roots, even in a target
 * from `first` to `last`. */
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

EXPORT void invert_increasing(const increasing_t *functions, ARRAY(double, out, functions.count));

/* edges.c */

/* How far two pixels lie apart, both ways, whose noise is compared: LAGS pairs, of which the opposite ones are the same.
 * What comes out of a corner: u, v, sigma, s, 2 b, RMS residual, RMS noise, whether it is valid, its pixels, for each of
 * the LAGS the sum of products of the noise, and of how many. */
enum { LAG = 2, ACROSS_LAGS = 2 * LAG + 1, LAGS = LAG * ACROSS_LAGS + LAG + 1, OUTCOMES = 9 + 2 * LAGS };

/* The constants of detection.subpixel.edge_model and detection.subpixel.edge_fit, under their names there. */
typedef struct {
    double reach, end_sigmas, paper_sigmas, least_reach, near_sigmas, near_px, tail_sigmas, pixel_kurtosis, sharp_blur;
    double least_blur, most_blur, angle_sigma, log_blur_sigma, light_sigma;
    double most_move_px, most_turn, most_blur_change, most_light_change;
    double least_variance, ridge, converged_px, blur_lag, valid_move_px, valid_move_cells, most_mirrored, radius_px;
    int64_t iterations, mirrored, fewest_mirrored;
} edge_rules_t;

/* The constants of detection.subpixel.edge_curvature. */
typedef struct {
    double decay, least_sigma, free, bent;
    int64_t reach;
} bend_rules_t;

EXPORT int64_t edges_scratch(const edge_rules_t *rules);
EXPORT void fit_edges(
    ARRAY(const void, grey, height, width), int64_t bytes, int64_t width, int64_t height, int64_t count,
    ARRAY(const double, pixels, count, 2), ARRAY(const double, sides, count, 2, 2),
    ARRAY(const double, curvature, count, 2), ARRAY(const double, curvature_sigma, count, 2),
    ARRAY(const double, gaps, count, 2, 2), ARRAY(const double, tilts, count, 2, 2),
    ARRAY(const double, reach, count, 2, 2),
    ARRAY(const double, paper, count, 2, 2), ARRAY(const double, single, count, 2), ARRAY(const double, sign, count),
    ARRAY(const double, blur, count), ARRAY(const double, contrast, count), ARRAY(const uint8_t, ends, count, 2, 2), const edge_rules_t *rules,
    ARRAY(float, scratch, edges_scratch(rules)), ARRAY(double, out, count, OUTCOMES));
EXPORT void line_bends(
    ARRAY(const double, pixels, rows, columns, 2), ARRAY(const double, sigma, rows, columns),
    ARRAY(const uint8_t, wanted, rows, columns), int64_t rows, int64_t columns, int64_t count,
    ARRAY(const double, sides, count, 2), const bend_rules_t *rules, ARRAY(double, out, count, 2),
    ARRAY(double, out_sigma, count, 2));

/* paper.c */

/* The constants of detection.subpixel.outer_squares, under their names there. */
typedef struct {
    ARRAY(const double, steps, step_count);
    int64_t step_count;
    double aside, first, last, goes_on, cut, near_witness, seen, max_paper;
} paper_rules_t;

EXPORT int64_t paper_memory(int64_t count);
EXPORT void find_paper(
    ARRAY(const void, grey, height, width), int64_t bytes, int64_t width, int64_t height, int64_t count,
    ARRAY(const double, pixels, count, 2), ARRAY(const double, sides, count, 2, 2), ARRAY(const double, gaps, count, 2, 2),
    ARRAY(const uint8_t, ends, count, 2, 2), ARRAY(const double, contrast, count), ARRAY(const double, blur, count),
    ARRAY(const double, sign, count), ARRAY(const int64_t, owner, count), const paper_rules_t *rules,
    ARRAY(double, scratch, 2 * rules.step_count + 4 * count), ARRAY(uint8_t, memory, paper_memory(count)),
    ARRAY(int64_t, near, 4 * count), ARRAY(double, paper, count, 2, 2), ARRAY(double, out_gaps, count, 2, 2));

/* surface.c */

/* Degree of the polynomial that a lens adds to a perspective, at most, and how many terms x^i y^j that has. */
enum { SURFACE_DEGREE = 8, SURFACE_TERMS = (SURFACE_DEGREE + 1) * (SURFACE_DEGREE + 2) / 2 };

EXPORT double fit_perspective(
    ARRAY(const double, places, count, 2), ARRAY(const double, pixels, count, 2), int64_t count, ARRAY(double, out, 3, 3));
EXPORT int64_t fit_polynomials(
    ARRAY(const double, places, count, 2), ARRAY(const double, values, count, 2), int64_t count, double middle_x,
    double middle_y, double size, int64_t terms, double most_leverage, ARRAY(double, basis, terms, count),
    ARRAY(double, triangle, terms, terms), ARRAY(double, told, terms, 2), ARRAY(double, scratch, 4, count),
    ARRAY(double, misses, SURFACE_DEGREE + 1), ARRAY(double, foretold, count, 2), ARRAY(double, leverage, count));
EXPORT void polynomial_at(
    ARRAY(const double, wanted, count, 2), int64_t count, double middle_x, double middle_y, double size, int64_t terms,
    int64_t degree, ARRAY(const double, triangle, terms, terms), ARRAY(const double, told, terms, 2),
    ARRAY(double, out, 5, count, 2));
EXPORT void surest_polynomial(
    ARRAY(const double, wanted, count, 2), int64_t count, double middle_x, double middle_y, double size, int64_t terms,
    ARRAY(const double, triangle, terms, terms), ARRAY(const double, told, terms, 2),
    ARRAY(const double, misses, SURFACE_DEGREE + 1), ARRAY(double, out, count, 3));
EXPORT void read_modules(
    ARRAY(const void, grey, height, width), int64_t bytes, int64_t width, int64_t height,
    ARRAY(const double, maps, count, 3, 3), int64_t count, int64_t side,
    ARRAY(double, bright, count, side * side), ARRAY(double, spread, count));

/* tags.c */

/* What comes out of a tag: moves of the four corners (8), their standard deviations (4), blur, contrast, RMS residual,
 * whether it settled. Terms of a cubic polynomial of two variables. Pixels on a side of the squares that are
 * taken at once, and the doubles of one. */
enum { TAG_OUTCOMES = 16, TAG_TERMS = 10, TAG_SIDE = 4, TAG_BLOCK = 80 };

/* The constants of detection.tags.whole, under their names there. */
typedef struct {
    double tail_sigmas, pixel_kurtosis, sharp_blur, least_blur, most_blur, most_move_px, most_blur_change, light_sigma;
    double least_variance, converged_px;
    int64_t iterations;
} tag_rules_t;

EXPORT void fit_tags(
    ARRAY(const void, grey, height, width), int64_t bytes, int64_t width, int64_t height, int64_t count,
    ARRAY(const double, maps, count, 2, TAG_TERMS), ARRAY(const double, centres, count, 2), ARRAY(const double, scales, count),
    ARRAY(const uint8_t, ink, count, cells, cells), int64_t cells, ARRAY(const double, breaks, cells - 1), double reach,
    ARRAY(const double, blur, count), ARRAY(const double, contrast, count), ARRAY(const double, bend_sigma, count), const tag_rules_t *rules, int64_t most,
    ARRAY(double, scratch, most, TAG_BLOCK), ARRAY(double, out, count, TAG_OUTCOMES));

/* boards.c */

/* Planes of the picture of a board: the pattern, its slopes along u and v, what lies beyond each of the four sides, how the
 * pattern changes as they go further out. */
enum { BOARD_PLANES = 11 };

EXPORT void board_places(
    ARRAY(const double, coefficients, rows + 2, columns + 2, 2), int64_t rows, int64_t columns, int64_t left, int64_t top,
    int64_t width, int64_t height, double around, ARRAY(double, places, height, width, 2));
EXPORT void board_picture(
    ARRAY(const double, places, height, width, 2), int64_t width, int64_t height, int64_t rows, int64_t columns,
    ARRAY(const double, ends, 2, 2), ARRAY(const double, paper, 4), double sharp, ARRAY(float, out, BOARD_PLANES, height, width));

/* board_changes.c */

EXPORT void board_shares(
    ARRAY(const double, places, height, width, 2), int64_t width, int64_t height, int64_t rows, int64_t columns, double spacing,
    double most, int64_t cubic, int64_t margin, ARRAY(int32_t, nodes, height, width, 2),
    ARRAY(float, weights, height, width, 2, 4), ARRAY(int64_t, boxes, rows * columns, 4));
EXPORT void board_values(
    ARRAY(const int32_t, nodes, height, width, 2), ARRAY(const float, weights, height, width, 2, 4), int64_t width,
    int64_t height, int64_t rows, int64_t columns, ARRAY(const double, values, count, rows, columns), int64_t count,
    ARRAY(float, out, count, height, width));
EXPORT void move_blocks(
    ARRAY(const int32_t, nodes, height, width, 2), ARRAY(const float, weights, height, width, 2, 4), int64_t width,
    int64_t height, int64_t rows, int64_t columns, ARRAY(const float, gradient, 2, height, width),
    ARRAY(const float, weight, height, width), ARRAY(const float, taps, 2 * radius + 1), int64_t radius,
    ARRAY(const int64_t, boxes, rows * columns, 4), ARRAY(const int64_t, starts, rows * columns), int64_t room,
    ARRAY(float, scratch, 3 * room), int64_t size, ARRAY(float, data, size));
EXPORT void share_blocks(
    ARRAY(const int32_t, nodes, height, width, 2), ARRAY(const float, weights, height, width, 2, 4), int64_t width,
    int64_t height, int64_t rows, int64_t columns, ARRAY(const float, planes, wide_by, height, width), int64_t wide_by,
    ARRAY(const int64_t, boxes, rows * columns, 4), ARRAY(const int64_t, starts, rows * columns), int64_t room,
    ARRAY(float, scratch, room), int64_t size, ARRAY(float, data, size));
EXPORT void block_products(
    ARRAY(const int64_t, boxes, count, 4), ARRAY(const int64_t, starts, count), ARRAY(const int64_t, wide_by, count),
    ARRAY(const int64_t, first, count), int64_t count, int64_t size, ARRAY(const float, data, size),
    ARRAY(const float, rest, height, width), int64_t width, int64_t height, int64_t unknowns,
    ARRAY(double, out, unknowns, unknowns), ARRAY(double, right, unknowns));

/* circles.c */

/* What comes out of a circle: u, v, the map (4), covariance of (u, v) at noise of variance 1 (uu, uv, vv), blur, brightness
 * outside, brightness inside less that, RMS residual, pixels, whether it settled, harmonics 3 to 6 of the edge (8). */
enum { CIRCLE_OUTCOMES = 23, SPOT = 3 };

/* The constants of detection.circles.fit, under their names there. */
typedef struct {
    double near_sigmas, near_px, least_blur, most_blur, most_move_px, most_growth, most_light, converged_px;
    int64_t iterations, fewest;
} circle_rules_t;

EXPORT void fit_circles(
    ARRAY(const void, grey, height, width), int64_t bytes, int64_t width, int64_t height, int64_t count,
    ARRAY(const double, pixels, count, 2), ARRAY(const double, maps, count, 2, 2), ARRAY(const double, bends, count, 2, 3),
    ARRAY(const double, blur, count), ARRAY(const double, reach, count), const circle_rules_t *rules, int64_t most,
    ARRAY(double, scratch, most, SPOT), ARRAY(double, out, count, CIRCLE_OUTCOMES));

/* minimal.c */

enum { MOST_ROOTS = 10 };

EXPORT void five_rows(ARRAY(const double, rows, count, 5, 9), int64_t count, ARRAY(double, out, count, MOST_ROOTS, 3, 3));
EXPORT void six_rows(ARRAY(const double, rows, count, 6, 9), int64_t count, ARRAY(double, out, count, 1, 3, 3));

/* pose.c */

enum { NO_MEMORY = -1000 };

/* What the maximum likelihood pose is sought from (pose_problem.PoseProblem). `affine` are 25 rows of `chosen` numbers
 * (residuals.whitened_affinities). */
typedef struct {
    ARRAY(const double, packed, 18, count);
    ARRAY(const double, affine, 25, chosen);
    ARRAY(const double, point_weights, count);
    ARRAY(const int64_t, which, chosen);
    ARRAY(const int64_t, free, freedom);
    int64_t count, chosen, freedom, loss, most_iterations;
    double scale, tolerance;
} pose_problem_t;

EXPORT void residuals(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(const double, E, hypotheses, 3, 3), int64_t hypotheses,
    ARRAY(double, out, hypotheses, count));
EXPORT void qualities(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(const double, E, hypotheses, 3, 3), int64_t hypotheses,
    double noise, ARRAY(double, out, hypotheses));
EXPORT void qualities_ahead(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(const double, R, hypotheses, 2, 3, 3),
    ARRAY(const double, t, hypotheses, 3), int64_t hypotheses, double noise, double sigmas,
    ARRAY(double, out, hypotheses));
EXPORT void improve(
    ARRAY(const double, packed, 18, count), int64_t count, ARRAY(double, R, hypotheses, 3, 3),
    ARRAY(double, t, hypotheses, 3), double noise, int64_t hypotheses, ARRAY(const int64_t, free, freedom), int64_t freedom,
    int64_t most_steps, double settled);
EXPORT int64_t minimise(
    const pose_problem_t *problem, ARRAY(double, R, 3, 3), ARRAY(double, t, 3),
    ARRAY(double, r, problem.count + 2 * problem.chosen), ARRAY(double, J, problem.count + 2 * problem.chosen, 5),
    ARRAY(double, w, problem.count + 2 * problem.chosen));

/* patches.c */

/* Levels of a pyramid; the largest half side of a patch in samples; what is said of a patch: place in image 2, affinity row
 * by row, correlation, variance of its brightness, how many levels coarser it was aligned than the images' sharpness asks
 * for, and the upper triangle of the covariance of place and affinity, row by row. */
enum { MOST_LEVELS = 8, MOST_HALF = 16, PATCH_COLUMNS = 9 + 21 };

/* An image and its halvings: pixel of level l = pixel of the image / 2^l. */
typedef struct {
    image_t levels[MOST_LEVELS];
    int64_t count;
} pyramid_t;

/* The constants of affine.refine_patches; `half` is the half side of the patch, its window a Gaussian of `width`, both in
 * samples. */
typedef struct {
    int64_t half, coarsest, most_steps;
    double width, settled, most_move, least_contrast, least_correlation, most_sigma, least_noise, excess_noise;
} patch_rules_t;

/* The rays of image 2 every `spacing` pixels, and how well the pairs agree with E21: an infinite sigma is no knowledge. */
typedef struct {
    ARRAY(const double, rays2, rows, columns, 3);
    int64_t rows, columns;
    double spacing, E21[9], sigma, sigma_A, most_distance;
} epipolar_t;

/* The nodes that patches grow over: node (r, c) is the pixel `step` * (c, r) of image 1. */
typedef struct {
    ARRAY(const double, rays1, rows, columns, 3);
    ARRAY(const double, jacobians1, rows, columns, 3, 2);
    ARRAY(double, out, rows, columns, PATCH_COLUMNS);
    ARRAY(uint8_t, tries, rows, columns);
    ARRAY(int32_t, heap, rows, columns);
    int64_t rows, columns, step, most_tries;
} patch_grid_t;

EXPORT void align_patches(
    const pyramid_t *first, const pyramid_t *second, const patch_rules_t *rules, ARRAY(const double, starts, count, 8),
    int64_t count, ARRAY(double, out, count, PATCH_COLUMNS));
EXPORT int64_t grow_patches(
    const pyramid_t *first, const pyramid_t *second, const epipolar_t *epipolar, const patch_rules_t *rules,
    const patch_grid_t *grid, ARRAY(const double, seeds, count, 8), int64_t count);

/* What nodes of a grid say of the surface (reconstruction.growing.surface): values, NaN where nothing, their information
 * (the inverse of their covariance), and the rows that predict them from a plane. */
typedef struct {
    ARRAY(const double, values, rows, columns, 3);
    ARRAY(const double, information, rows, columns, 3, 3);
    ARRAY(const double, frames, rows, columns, 3, 3);
    int64_t rows, columns, reach, rounds;
    double turn;
} plane_grid_t;

EXPORT void fit_planes(
    const plane_grid_t *grid, ARRAY(double, planes, grid.rows, grid.columns, 3),
    ARRAY(double, normals, grid.rows, grid.columns, 3, 3), ARRAY(double, support, grid.rows, grid.columns));

/* Samples of image 1 (rows x columns), and at every `spacing`-th of them where image 2 shows a surface at each of the ranges
 * of a sweep (reconstruction.growing.sweep); NaN where nowhere. In between places are interpolated. */
typedef struct {
    ARRAY(const float, table, levels, table_rows, table_columns, 2);
    int64_t levels, table_rows, table_columns, spacing, rows, columns;
} sweep_t;

/* Costs of a step to the next level, and of any larger one: `jump` where the brightness is even, half of what that is more
 * where it changes by `even`. */
typedef struct {
    int64_t rows, columns, levels, bend, jump;
    double even;
} surface_rules_t;

/* Whether each of the neighbours in 5 x 5 samples is darker. */
enum { CENSUS_BITS = 24 };

EXPORT int64_t sweep_levels(int64_t levels);
EXPORT int64_t sweep_cost_memory(int64_t columns);
EXPORT int64_t sweep_path_memory(int64_t columns, int64_t levels);
EXPORT void sweep_costs(
    const sweep_t *sweep, const image_t *image2, ARRAY(const float, samples1, sweep.rows, sweep.columns),
    ARRAY(float, memory, sweep_cost_memory(sweep.columns)),
    ARRAY(uint8_t, costs, sweep.rows, sweep.columns, sweep_levels(sweep.levels)));
EXPORT void sweep_surfaces(
    const surface_rules_t *rules, ARRAY(const uint8_t, costs, rules.rows, rules.columns, sweep_levels(rules.levels)),
    ARRAY(const float, samples1, rules.rows, rules.columns),
    ARRAY(uint8_t, memory, sweep_path_memory(rules.columns, rules.levels)),
    ARRAY(uint16_t, total, rules.rows, rules.columns, sweep_levels(rules.levels)));
EXPORT void sweep_winners(
    const surface_rules_t *rules, ARRAY(const uint16_t, total, rules.rows, rules.columns, sweep_levels(rules.levels)),
    ARRAY(int32_t, best, rules.rows, rules.columns), ARRAY(int32_t, around, rules.rows, rules.columns, 4));

/* Surfaces at some samples (row, column): the level there, its change from row to row and from column to column, and how
 * many levels away another surface begins. Samples count less the further they are, in units of `radius` samples, and the
 * more their brightness differs, in units of `alike`. */
typedef struct {
    ARRAY(const int32_t, samples, count, 2);
    ARRAY(const float, surfaces, count, 4);
    int64_t count, rows, columns, levels;
    double radius, alike;
} claims_t;

EXPORT void sweep_rivals(
    const claims_t *claims, ARRAY(const uint8_t, costs, claims.rows, claims.columns, sweep_levels(claims.levels)),
    ARRAY(const float, samples1, claims.rows, claims.columns), ARRAY(uint16_t, memory, sweep_levels(claims.levels)),
    ARRAY(float, found, claims.count, 2));

#endif
