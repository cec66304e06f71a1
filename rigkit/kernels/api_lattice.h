/* Declarations of api.h: from an image to lattices of corners. */
#ifndef RIGKIT_KERNELS_API_LATTICE_H
#define RIGKIT_KERNELS_API_LATTICE_H

/* An image of brightness. */
typedef struct {
    ARRAY(const float, brightness, height, width);
    int64_t width, height;
} image_t;

/* looks.c */

EXPORT int64_t has_mosaic(
    IMAGE(grey), int64_t step, double least, double share,
    SCRATCH(double, scratch, 2 * (height / 2 / step) * (width / 2 / step)));

EXPORT int64_t count_bad_pixels(
    IMAGE(grey), int64_t first, int64_t apart, double step, double share, RESULT(double, span, 1));

EXPORT void count_alternating(
    IMAGE(grey), int64_t groups, int64_t tiles, double step, RESULT(int64_t, more, tiles, tiles),
    RESULT(int64_t, less, tiles, tiles));

/* smoothing.c */

EXPORT void shrink_floats(
    ARRAY(const float, image, height, width), int64_t height, int64_t width, int64_t factor, SCRATCH(float, sums, width),
    RESULT(float, out, height / factor, width / factor));
EXPORT void shrink_bytes(
    ARRAY(const uint8_t, image, height, width), int64_t height, int64_t width, int64_t factor,
    SCRATCH(uint16_t, sums, 2 * width), RESULT(float, out, height / factor, width / factor));
/* The kernel that smooths levels, multiples of 1 / whole, and the constants of their thresholds (detection.saddles.response). */
typedef struct {
    ARRAY(const float, kernel, 5);
    double whole, extreme, min_span, noise_factor, floor, ceiling;
} level_rules_t;

/* Rows are tested STRIP pixels at a time, so that the results stay in registers and the first-level cache. Every strip of
 * STRIP_ROWS rows has its own threshold: strip (u - STRIPS_FROM) / STRIP of band v / STRIP_ROWS. */
enum { STRIP = 64, STRIP_ROWS = 32, STRIPS_FROM = 3 };

/* Number of rows searched for peaks at a time, and of rows of the response that are kept in a ring buffer. */
enum { TRIPLE = 3, RING = 3 * TRIPLE };

EXPORT void make_level(
    IMAGE(image), int64_t step, const level_rules_t *rules,
    SCRATCH(float, scratch, width + 4 + 3 * ((height - 3) / step + 1) * ((width - 3) / step + 1)),
    ARRAY(float, smooth, height, width), ARRAY(float, half, (height + 1) / 2, (width + 1) / 2),
    RESULT(float, thresholds, height / STRIP_ROWS + 1, width / STRIP + 1));

/* peaks.c */

EXPORT int64_t find_peaks(
    ARRAY(const float, smooth, height, width), int64_t height, int64_t width,
    ARRAY(const float, thresholds, height / STRIP_ROWS + 1, width / STRIP + 1),
    SCRATCH(float, scratch, (RING + 2) * (width + STRIP + 4)), SCRATCH(uint8_t, high, 2 * (width / STRIP + 1)),
    SCRATCH(int32_t, columns, TRIPLE * (width / 3 + 1)),
    RESULT(int32_t, at, (height / 3 + 1) * (width / 3 + 1), 2), RESULT(float, response, (height / 3 + 1) * (width / 3 + 1)));
EXPORT int64_t keep_strongest(
    ARRAY(int32_t, at, count, 2), ARRAY(float, response, count), int64_t count, int64_t height, int64_t width, int64_t side,
    int64_t most, int64_t finest, ARRAY(float, squares, (height / side + 1) * (width / side + 1)),
    ARRAY(int32_t, bins, finest + 1), SCRATCH(int32_t, share, count));

/* corners.c; rings also in growth.c */

/* Samples of a ring in half a turn (detection.saddles.ring), a constant so that the compiler unrolls the loops over them. */
enum { HALF = 16, TURN = 2 * HALF };

/* The constants of detection.saddles.ring. `circle` holds the unit vectors (u, v) to the HALF samples of half a turn and to the
 * opposite ones; `gains` R_2 / R_4, tabulated over the ratio of harmonic 2 at half the radius to harmonic 2 on the ring, from
 * 1/4 to 1. */
typedef struct {
    ARRAY(const float, circle, TURN, 2);
    ARRAY(const double, gains, gain_count);
    int64_t gain_count;
    double max_odd, max_centre, even_odd, even_centre, max_cosine, quick_odd, quick_centre, quick_even, quick_sharp;
} ring_rules_t;

EXPORT int64_t find_corners(
    ARRAY(const float, smooth, height, width), int64_t width, int64_t height, ARRAY(const int32_t, peaks, count, 2),
    ARRAY(const float, response, count), int64_t count, double radius, double max_step, double max_sharp,
    const ring_rules_t *rules, double scale, double offset, ARRAY(const double, known, known_count, 2), int64_t known_count,
    double reach, RESULT(double, saddles, count, 2), RESULT(double, pixels, count, 2), RESULT(double, angles, count, 2),
    RESULT(double, contrast, count), RESULT(truth_t, smeared, count), RESULT(truth_t, repeated, count),
    RESULT(int64_t, found, 2));
EXPORT int64_t mark_known(
    ARRAY(const double, fresh, count, 2), int64_t count, ARRAY(const double, known, known_count, 2), int64_t known_count,
    double reach, RESULT(truth_t, mark, count));

/* links.c */

/* The constants of detection.lattice.links. */
typedef struct {
    int64_t neighbours, places, min_places;
    ARRAY(const double, along, places);
    double arm_cosine, contrast_ratio, length_ratio, lateral, min_lateral;
} link_rules_t;

/* Corners to be linked: positions, unit vectors along both lines, contrast, the range of the contrast of possible neighbours,
 * and the largest distance from an edge, px of the level, at which its brightness is read. */
typedef struct {
    ARRAY(const double, pixels, count, 2);
    ARRAY(const double, lines, count, 2, 2);
    ARRAY(const double, contrast, count);
    ARRAY(const double, min_contrast, count);
    ARRAY(const double, max_contrast, count);
    ARRAY(const double, reach, count);
    int64_t count;
} corners_t;

EXPORT int64_t find_links(
    const corners_t *corners, image_t image, double scale, double offset, const link_rules_t *rules,
    SCRATCH(int64_t, nearest, corners.count, 4), RESULT(int64_t, both, corners.count, 4));

/* growth.c */

/* Results of a fit, and the largest numbers that the kernels have room for: rows and columns on each side of a cell in a fit, and
 * saddles that are tried in a cell. */
enum { FIT_COLUMNS = 12, MAX_FIT_RADIUS = 3, MAX_TRIED = 16 };

/* The constants of detection.lattice.local_fit. */
typedef struct {
    int64_t degree, radius, leave_out;
    double width, ridge[2];
} fit_rules_t;

/* The constants of detection.lattice.grow, detection.lattice.links and detection.saddles.ring. */
typedef struct {
    fit_rules_t predictions[2];
    const ring_rules_t *ring;
    ARRAY(const double, along, places);
    int64_t places, min_places, tried, min_predicting;
    double reach, ring_part, min_ring, max_ring, line_sine, contrast_ratio, lateral, min_lateral, max_lateral, min_area;
} growth_rules_t;

/* A level of the image pyramid: full-resolution pixel = scale * level pixel + offset. */
typedef struct {
    image_t image;
    double scale, offset;
} pyramid_level_t;

/* A lattice surrounded by empty cells (NaN). `sign` is +1 if the brightness at cell (0, 0) grows with the angle across its
 * +column edge. `due` marks the cells to be tried with each of the two predictions. */
typedef struct {
    ARRAY(double, pixels, rows, columns, 2);
    ARRAY(double, contrast, rows, columns);
    ARRAY(uint8_t, due, 2, rows, columns);
    int64_t rows, columns;
    double sign;
} sheet_t;

/* Points sorted into a grid of squares: those of square b are order[first[b]] to order[first[b + 1] - 1] (`sort_points`). */
typedef struct {
    const double *points;
    int32_t *first, *order;
    int64_t columns, rows;
    double left, top, side;
} squares_t;

EXPORT void fit_cells(
    ARRAY(const double, lattice, rows, columns, 2), int64_t rows, int64_t columns,
    ARRAY(const uint8_t, cells, rows, columns), const fit_rules_t *rules, int64_t count,
    RESULT(double, out, count, FIT_COLUMNS));
EXPORT int64_t squares_memory(int64_t count);
EXPORT void sort_points(
    ARRAY(const double, points, count, 2), int64_t count, ARRAY(int32_t, memory, squares_memory(count)), squares_t *out);
EXPORT int64_t grow_lattice(
    sheet_t *sheet, const pyramid_level_t *level, const squares_t *saddles, const growth_rules_t *rules, int64_t rings,
    SCRATCH(double, fresh, sheet.rows * sheet.columns, 3), SCRATCH(int64_t, where, sheet.rows * sheet.columns));

/* components.c */

EXPORT int64_t find_components(
    int64_t count, ARRAY(int64_t, to, count, 4), RESULT(int64_t, label, count), RESULT(int64_t, grid, count, 2),
    RESULT(int64_t, turn, count), RESULT(int64_t, members, count), SCRATCH(int64_t, queue, 2 * count),
    SCRATCH(uint8_t, bound, 4 * count));

/* lattice.c */

/* The largest order of differences, and the largest degree of surfaces, that the kernels have room for. */
enum { MAX_DIFFERENCE_ORDER = 8, MAX_SCATTER_DEGREE = 4, SCATTER_TERMS = (MAX_SCATTER_DEGREE + 1) * (MAX_SCATTER_DEGREE + 2) / 2 };

/* The constants of detection.subpixel.scatter. */
typedef struct {
    double unexplained, median_of_normal, min_term;
    int64_t min_corners, min_differences, first_order, last_order, degrees[2];
} scatter_rules_t;

EXPORT void uneven_steps(
    ARRAY(const double, pixels, rows, columns, 2), int64_t rows, int64_t columns,
    SCRATCH(double, scratch, 2 * rows * columns), int64_t inner, RESULT(double, typical, inner),
    RESULT(int64_t, seen, inner), RESULT(double, every, 2));
EXPORT void line_gaps(
    ARRAY(const double, sides, count, 2, 2), ARRAY(const double, curvatures, count, 2, 2), int64_t count,
    RESULT(double, out, count, 2, 2));
EXPORT void excess_scatter(
    ARRAY(const double, pixels, height, width, 2), ARRAY(const double, sigma, height, width), int64_t height, int64_t width,
    ARRAY(const int64_t, parts, count, 4), int64_t count, const scatter_rules_t *rules,
    SCRATCH(double, scratch, 7 * height * width), RESULT(double, out, count));
EXPORT void surface_scatter(
    ARRAY(const double, pixels, rows, columns, 2), ARRAY(const double, sigma, rows, columns), int64_t rows, int64_t columns,
    const scatter_rules_t *rules, SCRATCH(double, scratch, (5 + SCATTER_TERMS) * rows * columns), RESULT(double, out, 2));
EXPORT void edge_shifts(
    ARRAY(const double, pixels, rows, columns, 2), int64_t rows, int64_t columns, double sign, image_t image, double scale,
    double offset, ARRAY(const double, reach, parts), ARRAY(const double, along, parts), int64_t parts, int64_t steps,
    int64_t most, SCRATCH(double, sums, parts, steps + 1), RESULT(double, out, parts));

/* splits.c */

/* The constants of detection.checks.discontinuity. */
typedef struct {
    int64_t window, min_beside, min_free;
    double two_surfaces, jump, floor_cells, as_smooth, ridge;
} split_rules_t;

EXPORT int64_t splits_scratch(int64_t rows, int64_t columns);
EXPORT void clearest_splits(
    ARRAY(const double, pixels, rows, columns, 2), ARRAY(const double, sigma, rows, columns), int64_t rows, int64_t columns,
    int64_t several, const split_rules_t *rules, SCRATCH(double, scratch, splits_scratch(rows, columns)),
    RESULT(double, out, 2, 3));

#endif
