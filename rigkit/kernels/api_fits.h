/* Declarations of api.h: sub-pixel fits of corners, tags, circles and whole boards. */
#ifndef RIGKIT_KERNELS_API_FITS_H
#define RIGKIT_KERNELS_API_FITS_H

/* edges.c, with edges_window.c, edges_model.c and edges_noise.c */

/* The autocovariance of the noise is estimated up to a lag of LAG pixels along both axes: LAGS lags, as opposite lags have the
 * same. The results of a corner: u, v, sigma, s, 2 b, RMS residual, RMS noise, whether it is valid, its number of pixels, and
 * for each lag the sum of products of the noise and the number of products. */
enum { LAG = 2, ACROSS_LAGS = 2 * LAG + 1, LAGS = LAG * ACROSS_LAGS + LAG + 1, OUTCOMES = 9 + 2 * LAGS };

/* The constants of detection.subpixel.edge_model and detection.subpixel.edge_fit, under their names there. */
typedef struct {
    double reach, end_sigmas, paper_sigmas, min_reach, near_sigmas, near_px, tail_sigmas, pixel_kurtosis, sharp_blur;
    double min_blur, max_blur, angle_sigma, log_blur_sigma, light_sigma;
    double max_move_px, max_turn, max_blur_change, max_light_change;
    double min_variance, ridge, converged_px, blur_lag, valid_move_px, valid_move_cells, max_mirrored, radius_px;
    int64_t iterations, mirrored, min_mirrored;
} edge_rules_t;

EXPORT int64_t edges_scratch(const edge_rules_t *rules);
EXPORT void fit_edges(
    IMAGE(grey), int64_t count, ARRAY(const double, pixels, count, 2), ARRAY(const double, sides, count, 2, 2),
    ARRAY(const double, curvature, count, 2), ARRAY(const double, curvature_sigma, count, 2),
    ARRAY(const double, gaps, count, 2, 2), ARRAY(const double, tilts, count, 2, 2), ARRAY(const double, reach, count, 2, 2),
    ARRAY(const double, paper, count, 2, 2), ARRAY(const double, single, count, 2), ARRAY(const double, sign, count),
    ARRAY(const double, blur, count), ARRAY(const double, window_blur, count), ARRAY(const double, contrast, count),
    ARRAY(const uint8_t, ends, count, 2, 2), const edge_rules_t *rules, SCRATCH(float, scratch, edges_scratch(rules)),
    RESULT(double, out, count, OUTCOMES));

/* Constants of the windows of corners of tags: the width of a tag's border, in sides of a tag, the distance in s that a window
 * keeps from the code within it, and the distance of neighbouring lines, px, where there are none. */
typedef struct {
    double border, blurs, nothing_near;
} tag_window_t;

/* correlation.c */

/* The constants of detection.subpixel.correlation, under their names there. */
typedef struct {
    double light_share, lost_error, min_left, covered_times, min_factor, min_alike, uneven_times, min_blur, radius_px;
} factor_rules_t;

EXPORT void sigma_factors(
    ARRAY(const double, products, count, LAGS), ARRAY(const double, pairs, count, LAGS), ARRAY(const double, noise, count),
    ARRAY(const double, pixels, count, 2), ARRAY(const double, sides, count, 2, 2), ARRAY(const double, blur, count),
    ARRAY(const double, used, count), ARRAY(const uint8_t, good, count), ARRAY(const int64_t, owner, count), int64_t count,
    int64_t boards, const factor_rules_t *rules, RESULT(double, out, boards));
EXPORT void uneven_factors(
    ARRAY(const double, products, count, LAGS), ARRAY(const double, pairs, count, LAGS), ARRAY(const double, noise, count),
    ARRAY(const double, pixels, count, 2), ARRAY(const double, sides, count, 2, 2), ARRAY(const double, blur, count),
    ARRAY(const double, used, count), ARRAY(const uint8_t, good, count), ARRAY(const int64_t, owner, count), int64_t count,
    int64_t boards, ARRAY(const double, typical, boards), const factor_rules_t *rules, RESULT(double, out, count));

/* curvatures.c */

/* The constants of detection.subpixel.edge_curvature. */
typedef struct {
    double decay, min_sigma, free, bent;
    int64_t reach;
} curvature_rules_t;

EXPORT void line_curvatures(
    ARRAY(const double, pixels, rows, columns, 2), ARRAY(const double, sigma, rows, columns),
    ARRAY(const uint8_t, wanted, rows, columns), int64_t rows, int64_t columns, int64_t count,
    ARRAY(const double, sides, count, 2), const curvature_rules_t *rules, RESULT(double, out, count, 2),
    RESULT(double, out_sigma, count, 2));

/* paper.c */

/* The constants of detection.subpixel.outer_squares, under their names there. */
typedef struct {
    ARRAY(const double, steps, step_count);
    int64_t step_count;
    double lateral, first, last, goes_on, cut, near_witness, seen, max_paper;
} paper_rules_t;

EXPORT int64_t paper_memory(int64_t count);
EXPORT void find_paper(
    IMAGE(grey), int64_t count, ARRAY(const double, pixels, count, 2), ARRAY(const double, sides, count, 2, 2),
    ARRAY(const double, gaps, count, 2, 2), ARRAY(const uint8_t, ends, count, 2, 2), ARRAY(const double, contrast, count),
    ARRAY(const double, blur, count), ARRAY(const double, sign, count), ARRAY(const int64_t, owner, count),
    const paper_rules_t *rules, SCRATCH(double, scratch, 2 * rules.step_count + 4 * count),
    SCRATCH(uint8_t, memory, paper_memory(count)), SCRATCH(int64_t, near, 4 * count), RESULT(double, paper, count, 2, 2),
    RESULT(double, out_gaps, count, 2, 2));

/* surface.c */

/* Highest degree of the polynomial that models the distortion of a perspective map, and its number of terms x^i y^j. */
enum { SURFACE_DEGREE = 8, SURFACE_TERMS = (SURFACE_DEGREE + 1) * (SURFACE_DEGREE + 2) / 2 };

/* The columns of the map at a place on a board: the pixel, its first derivatives by x and by y, its second derivatives by x and
 * by y, the standard deviation of the pixel for points of standard deviation 1, the curvatures of the lines along x and along
 * y, and the distances from them, px, of the lines one unit of the board further. */
enum { SEEN = 0, SIDES = 2, SECOND = 6, GAIN = 10, CURVATURE = 11, HEIGHTS = 13, SURFACE_COLUMNS = 15 };

/* Scratch of `fit_polynomials` for each point: five numbers, and the powers of x and y. */
enum { FIT_SCRATCH = 5 + 2 * (SURFACE_DEGREE + 1) };

EXPORT void project_places(
    ARRAY(const double, places, count, 2), int64_t count, ARRAY(const double, homography, 3, 3),
    RESULT(double, out, count, SURFACE_COLUMNS));
EXPORT double fit_perspective(
    ARRAY(const double, places, count, 2), ARRAY(const double, pixels, count, 2), int64_t count, RESULT(double, out, 3, 3));
EXPORT int64_t fit_polynomials(
    ARRAY(const double, places, count, 2), ARRAY(const double, values, count, 2), int64_t count, int64_t terms,
    double max_leverage, SCRATCH(double, basis, terms, count), SCRATCH(double, scratch, FIT_SCRATCH, count),
    RESULT(double, unit, 3), ARRAY(double, triangle, terms, terms), RESULT(double, basis_values, terms, 2),
    RESULT(double, misses, SURFACE_DEGREE + 1), RESULT(double, off, count), RESULT(double, gain, count),
    RESULT(double, scatter, 1));
EXPORT int64_t fit_map(
    ARRAY(const double, places, count, 2), ARRAY(const double, pixels, count, 2), int64_t count, int64_t terms,
    double max_leverage, double nearest, SCRATCH(double, rest, count, 2), SCRATCH(double, basis, terms, count),
    SCRATCH(double, scratch, FIT_SCRATCH, count), RESULT(double, homography, 3, 3), RESULT(double, unit, 3),
    ARRAY(double, triangle, terms, terms), RESULT(double, basis_values, terms, 2), RESULT(double, misses, SURFACE_DEGREE + 1),
    RESULT(double, off, count), RESULT(double, gain, count), RESULT(double, scatter, 1));
EXPORT void add_polynomial(
    ARRAY(const double, wanted, count, 2), int64_t count, ARRAY(const double, unit, 3), int64_t terms, int64_t degree,
    ARRAY(const double, triangle, terms, terms), ARRAY(const double, basis_values, terms, 2),
    ARRAY(const double, misses, SURFACE_DEGREE + 1), int64_t most_certain, ARRAY(double, out, count, SURFACE_COLUMNS));

/* tag_board.c and tag_rounds.c */

/* Columns of a corner (detection.guided.board_guide.FITTED): u, v, contrast, RMS residual, RMS noise, sigma, s; NaN if missing.
 * Marks of corners: does not exist; not found, and not searched again until a corner near it is found; part of the last fit of
 * all corners; selected for the current operation. Numbers of a board: whether the map is that of the current corners, whether
 * it is a polynomial added to a camera's map or to a perspective, the terms of that polynomial and the lowest degree that fits,
 * its scatter, the scatter at the last fit of all corners, and the number of corners of that fit. */
enum {
    CORNER_CONTRAST = 2, CORNER_RESIDUAL = 3, CORNER_NOISE = 4, CORNER_SIGMA = 5, CORNER_BLUR = 6, CORNER_COLUMNS = 7,
    MARK_VAIN = 0, MARK_WAITING = 1, MARK_FITTED = 2, MARK_CELLS = 3, TAG_MARKS = 4,
    MAP_KNOWN = 0, MAP_BY_CAMERA = 1, MAP_BY_PERSPECTIVE = 2, MAP_TERMS = 3, MAP_PLAIN_DEGREE = 4, MAP_SCATTER = 5,
    FITTED_SCATTER = 6, FITTED_COUNT = 7, TAG_NUMBERS = 8
};

/* Doubles of scratch for each corner of a board of tags, and for its map. */
enum {
    ROOM_OF_CORNER = SURFACE_TERMS + SURFACE_COLUMNS + OUTCOMES + FIT_SCRATCH + 15,
    ROOM_OF_MAP = SURFACE_TERMS * SURFACE_TERMS + 2 * SURFACE_TERMS + SURFACE_DEGREE + 1 + 13
};

/* The constants of detection.tags.corners and of the modules that it imports, under their names there. `first` are the rules of
 * a quick fit, `last` of the final one, `rough` of the final one without an estimate of the noise. */
typedef struct {
    const edge_rules_t *first, *last, *rough;
    const tag_window_t *window;
    double points_a_term, max_leverage, nearest_depth, hardly_more, median_of_rayleigh;
    double first_blur, few_corners, min_contrast, rough_px, better_known, bent_sigmas, wide_blur, max_gain, margin_px;
    double moved_cells, added_contrast, added_residual, max_sigma_cells, narrow_blurs, code_contrast, likeness;
    double scatter_floor, outlier, judging_gain, displaced_cells;
    int64_t min_predicting, min_guiding;
} tag_corner_rules_t;

/* detection.tags.placing.TagBoard: its corners row by row, whether black squares join its tags, its border in sides of a tag. */
typedef struct {
    ARRAY(const double, places, count, 2);
    ARRAY(const double, steps, count, 2, 2);
    ARRAY(const double, signs, count);
    ARRAY(const int64_t, numbers, count / 4);
    ARRAY(const double, patterns, codes, modules * modules);
    ARRAY(const int64_t, code_numbers, codes);
    ARRAY(const int64_t, code_turns, codes);
    int64_t rows, columns, count, codes, modules, joined;
    double spacing, border;
} tag_board_t;

/* The fit of a board of tags in an image. `base` is a camera's map of its corners; `fitted` (results) and `sides` belong to the
 * corners marked FITTED; `curvature` is that of the lines in the last fit of each corner. `windows`, `map` and `room` are
 * scratch. */
typedef struct {
    const tag_board_t *board;
    const tag_corner_rules_t *rules;
    ARRAY(const void, grey, height, width);
    int64_t bytes, width, height;
    ARRAY(double, corners, board.count, CORNER_COLUMNS);
    ARRAY(uint8_t, marks, TAG_MARKS, board.count);
    ARRAY(double, base, board.count, SURFACE_COLUMNS);
    SCRATCH(double, fitted, board.count, OUTCOMES);
    SCRATCH(double, sides, board.count, 2, 2);
    ARRAY(double, curvature, board.count, 2);
    ARRAY(double, numbers, TAG_NUMBERS);
    SCRATCH(double, off, 2, board.count);
    SCRATCH(double, map, ROOM_OF_MAP);
    SCRATCH(double, room, board.count, ROOM_OF_CORNER);
    SCRATCH(double, modules, board.count / 4, board.modules * board.modules);
    SCRATCH(float, windows, edges_scratch(rules.last.contents));
} tag_fit_t;

EXPORT double tag_sigma_factor(const tag_fit_t *fit, const factor_rules_t *rules);
EXPORT double tag_scatter(const tag_fit_t *fit, double factor);
EXPORT void tag_heights(
    ARRAY(const double, pixels, rows, columns, 2), int64_t rows, int64_t columns,
    RESULT(double, longer, rows / 2, columns / 2), RESULT(double, height, rows / 2, columns / 2));
EXPORT void fit_tag_board(const tag_fit_t *fit, double blur);
EXPORT void refit_tag_corners(const tag_fit_t *fit);
EXPORT int64_t add_tag_corners(const tag_fit_t *fit, int64_t rounds, int64_t by_this_map);
EXPORT int64_t drop_tag_corners(const tag_fit_t *fit, int64_t rounds);

/* tag_places.c */

EXPORT int64_t squares_of_lattice(
    ARRAY(const double, pixels, rows, columns, 2), int64_t rows, int64_t columns, int64_t odd,
    RESULT(double, quads, rows * columns, 4, 2), RESULT(int64_t, cells, rows * columns, 2));
EXPORT int64_t vote_place(
    ARRAY(const int64_t, cells, count, 2), ARRAY(const int64_t, turns, count), ARRAY(const int64_t, places, count, 2),
    int64_t count, int64_t columns, int64_t rows, SCRATCH(int64_t, scratch, count, 3), ARRAY(int64_t, place, 3));

/* codes.c */

EXPORT void maps_of_quads(ARRAY(const double, quads, count, 4, 2), int64_t count, RESULT(double, out, count, 3, 3));
EXPORT void read_modules(
    IMAGE(grey), ARRAY(const double, quads, count, 4, 2), int64_t count, int64_t side,
    RESULT(double, bright, count, side * side), RESULT(double, spread, count));
EXPORT void read_codes(
    IMAGE(grey), ARRAY(const double, quads, count, 4, 2), int64_t count, int64_t side,
    ARRAY(const double, patterns, codes, side * side), int64_t codes, double least,
    SCRATCH(double, bright, count, side * side), RESULT(int64_t, best, count), RESULT(double, likeness, count));

/* tags.c */

/* The results of a tag: moves of the four corners (8), their standard deviations (4), blur, contrast, RMS residual, whether the
 * fit converged. The number of terms of a cubic polynomial of two variables. The side, px, of the squares that are processed at
 * once, and the doubles that hold one. */
enum { TAG_OUTCOMES = 16, TAG_TERMS = 10, TAG_SIDE = 4, TAG_BLOCK = 80 };

/* The constants of detection.tags.whole_tags, under their names there. */
typedef struct {
    double tail_sigmas, pixel_kurtosis, sharp_blur, min_blur, max_blur, max_move_px, max_blur_change, light_sigma;
    double min_variance, converged_px, max_taken;
    int64_t iterations;
} tag_rules_t;

EXPORT void fit_tags(
    IMAGE(grey), int64_t count, ARRAY(const double, maps, count, 2, TAG_TERMS), ARRAY(const double, centres, count, 2),
    ARRAY(const double, scales, count), ARRAY(const uint8_t, ink, count, cells, cells), int64_t cells,
    ARRAY(const double, breaks, cells - 1), double reach, ARRAY(const double, blur, count),
    ARRAY(const double, contrast, count), ARRAY(const double, curvature_sigma, count), const tag_rules_t *rules, int64_t most,
    SCRATCH(double, scratch, most, TAG_BLOCK), RESULT(double, out, count, TAG_OUTCOMES));

/* board_places.c */

EXPORT void board_places(
    ARRAY(const double, coefficients, rows + 2, columns + 2, 2), int64_t rows, int64_t columns, int64_t left, int64_t top,
    int64_t width, int64_t height, double around, RESULT(double, places, height, width, 2));
/* Return the columns and rows of the places in a raster with `each` samples per square that begins at the place `first`, outside
 * of it for pixels without a place; and for both kinds of corners whether a place is nearest to one of them and within its
 * `reach`, squares. */
EXPORT void sheet_places(
    ARRAY(const double, places, height, width, 2), int64_t width, int64_t height, ARRAY(const uint8_t, corners, 2, rows, columns),
    int64_t rows, int64_t columns, ARRAY(const double, first, 2), double each, ARRAY(const double, reach, 2),
    RESULT(float, on_sheet, 2, height, width), RESULT(truth_t, near, 2, height, width));

/* boards.c */

/* Planes of the rendered board: the pattern, its derivatives by u and v, the share of the paper beyond each of the four sides, and
 * the derivatives of the pattern by the positions of these sides. `board_picture` draws all of them, or the first. */
enum { BOARD_PLANES = 11 };

EXPORT void board_picture(
    ARRAY(const double, places, height, width, 2), int64_t width, int64_t height, int64_t rows, int64_t columns,
    ARRAY(const double, ends, 2, 2), ARRAY(const double, paper, 4), double sharp, int64_t planes,
    RESULT(float, out, planes, height, width));

/* board_changes.c */

EXPORT void board_shares(
    ARRAY(const double, places, height, width, 2), int64_t width, int64_t height, int64_t rows, int64_t columns,
    double spacing, double most, int64_t cubic, int64_t margin, RESULT(int32_t, nodes, height, width, 2),
    RESULT(float, weights, height, width, 2, 4), RESULT(int64_t, boxes, rows * columns, 4));
EXPORT void board_values(
    ARRAY(const int32_t, nodes, height, width, 2), ARRAY(const float, weights, height, width, 2, 4), int64_t width,
    int64_t height, int64_t rows, int64_t columns, ARRAY(const double, values, count, rows, columns), int64_t count,
    RESULT(float, out, count, height, width));
EXPORT void move_blocks(
    ARRAY(const int32_t, nodes, height, width, 2), ARRAY(const float, weights, height, width, 2, 4), int64_t width,
    int64_t height, int64_t rows, int64_t columns, ARRAY(const float, gradient, 2, height, width),
    ARRAY(const float, weight, height, width), ARRAY(const float, taps, 2 * radius + 1), int64_t radius,
    ARRAY(const int64_t, boxes, rows * columns, 4), ARRAY(const int64_t, starts, rows * columns), int64_t room,
    SCRATCH(float, scratch, 3 * room), int64_t size, ARRAY(float, data, size));
EXPORT void share_blocks(
    ARRAY(const int32_t, nodes, height, width, 2), ARRAY(const float, weights, height, width, 2, 4), int64_t width,
    int64_t height, int64_t rows, int64_t columns, ARRAY(const float, planes, wide_by, height, width), int64_t wide_by,
    ARRAY(const int64_t, boxes, rows * columns, 4), ARRAY(const int64_t, starts, rows * columns), int64_t room,
    SCRATCH(float, scratch, room), int64_t size, ARRAY(float, data, size));
EXPORT void block_products(
    ARRAY(const int64_t, boxes, count, 4), ARRAY(const int64_t, starts, count), ARRAY(const int64_t, wide_by, count),
    ARRAY(const int64_t, first, count), int64_t count, int64_t size, ARRAY(const float, data, size),
    ARRAY(const float, rest, height, width), int64_t width, int64_t height, int64_t unknowns,
    RESULT(double, out, unknowns, unknowns), RESULT(double, right, unknowns));

/* circles.c */

/* The results of a circle: u, v, the map (4), covariance of (u, v) at noise of variance 1 (uu, uv, vv), blur, brightness outside,
 * brightness inside less outside, RMS residual, number of pixels, whether the fit converged, variances of e1 to e3 at noise of
 * variance 1 (3), harmonics 3 to 8 of the edge (12), the gradient (2) and normal equations (uu, uv, vv) of an anisotropic blur, and the
 * move (2) of the centre by a gradient of added light, with its covariance (uu, uv, vv) at noise of variance 1. */
enum { HARMONICS = 6, CIRCLE_OUTCOMES = 28 + 2 * HARMONICS, SPOT = 3, BESIDE = 6 };

/* The constants of detection.circles.fit, under their names there. `brief`: residual and variances are those at the last step, and
 * what is not needed for a further fit stays 0: harmonics, anisotropic blur and added light. */
typedef struct {
    double near_sigmas, near_px, min_blur, max_blur, max_move_px, max_growth, max_light, converged_px,
        converged_sigmas, near_beside;
    int64_t iterations, plain_iterations, min_pixels, brief;
} circle_rules_t;

EXPORT void fit_circles(
    IMAGE(grey), int64_t count, ARRAY(const double, pixels, count, 2), ARRAY(const double, maps, count, 2, 2),
    ARRAY(const double, curvatures, count, 2, 3), ARRAY(const double, blur, count), ARRAY(const double, uneven, count, 2),
    ARRAY(const double, reach, count), ARRAY(const int64_t, beside, count, BESIDE), const circle_rules_t *rules, int64_t most,
    SCRATCH(double, scratch, SPOT, most), RESULT(double, out, count, CIRCLE_OUTCOMES));

/* blobs.c */

/* The constants of detection.circles.blobs: the smallest difference from the local mean, in standard deviations, the range of the
 * areas of blobs and of their ratios to those of the ellipses, and the largest ratio of axes. The columns of a blob: its centroid,
 * its covariance (uu, uv, vv) and sign. */
typedef struct {
    double deviations, min_filling, max_filling, max_aspect;
    int64_t min_area, max_area;
} blob_rules_t;
enum { BLOB_COLUMNS = 6 };

EXPORT int64_t blobs_memory(int64_t width);
EXPORT int64_t find_blobs(
    ARRAY(const float, off, height, width), ARRAY(const float, variance, height, width), int64_t height, int64_t width,
    const blob_rules_t *rules, SCRATCH(uint8_t, signs, width), SCRATCH(uint8_t, memory, blobs_memory(width)),
    RESULT(double, out, height * width / rules.min_area + 1, BLOB_COLUMNS));

/* circle_maps.c */

/* The places around a circle that predict it, and the terms of their polynomials: at most. The columns of the map around a place:
 * pixel (2), first derivatives (uu, uv, vu, vv of the matrix), second (xx, xy, yy of u, then of v), number of circles used,
 * whether there is one on every side, and the standard deviations of pixel and first derivatives. */
enum { MAX_PREDICTORS = 64, PREDICTED_TERMS = 15, PREDICTED_COLUMNS = 16 };

/* The constants of detection.circles.local_map. */
typedef struct {
    double sigma_px, min_ridge, slight, min_below;
    int64_t leave_out;
} prediction_rules_t;

EXPORT void local_maps(
    ARRAY(const double, table, rows, columns, 2), int64_t rows, int64_t columns, ARRAY(const int64_t, places, count, 2),
    int64_t count, ARRAY(const int64_t, offsets, near, 2), ARRAY(const double, plane, near, 2),
    ARRAY(const double, weights, near), ARRAY(const uint8_t, next, near), int64_t near,
    ARRAY(const double, typical, PREDICTED_TERMS), const prediction_rules_t *rules, RESULT(double, out, count, PREDICTED_COLUMNS));

/* light.c */

/* The results of a step of the light: u, v of the corner, its standard deviation, direction, position and width of the step, the
 * light beyond it relative to that before it, whether there is a step. The number of parameters of corner and step; how far from
 * a corner a step is searched, px; the number of pixels processed at once: arrays have room for so many beyond their last. */
enum { LIGHT_OUTCOMES = 8, LIGHT_UNKNOWNS = 11, LIGHT_LATERAL = 11, LIGHT_BLOCK = 32 };

/* The constants of detection.subpixel.shadows, under their names there. */
typedef struct {
    double radius_px, reach_cells, min_left, max_left, max_light, min_pixels;
    double line_sigma, log_edge_sigma, log_width_sigma, first_width, min_width, max_width;
    int64_t angles, iterations;
} light_rules_t;

EXPORT void lit_unevenly(
    IMAGE(grey), int64_t count, ARRAY(const double, pixels, count, 2), ARRAY(const double, sides, count, 2, 2),
    ARRAY(const double, lateral, count), ARRAY(const uint8_t, ends, count), ARRAY(const double, along, parts), int64_t parts,
    double max_lateral, double min_px, double uneven, RESULT(truth_t, out, count));
EXPORT void fit_light_steps(
    IMAGE(grey), int64_t count, ARRAY(const double, start, count, 2), ARRAY(const double, sides, count, 2, 2),
    ARRAY(const double, curvature, count, 2), ARRAY(const double, lateral, count), double blur,
    ARRAY(const double, max_step, LIGHT_UNKNOWNS), const light_rules_t *rules, int64_t most,
    SCRATCH(double, scratch, 4, most), RESULT(double, out, count, LIGHT_OUTCOMES));

#endif
