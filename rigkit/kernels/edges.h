/* Shared by the files of the edge model's fit: the window of pixels around a corner, and the functions of each file. The
 * definitions in numpy are in tests/kernels/reference/edges.py and edge_model.py, the numbers in rigkit.detection.subpixel. */
#ifndef RIGKIT_EDGES_H
#define RIGKIT_EDGES_H

#include "kernels.h"

/* Columns of the results of a corner (OUTCOMES in api_fits.h). */
enum { SIGMA = 2, BLUR, CONTRAST, RESIDUAL, NOISE, VALID, PIXELS };

/* Parameters: corner, angles of both lines, blur, mean brightness and half the contrast, relative gradient of the light, curvatures
 * of both lines. FEWER leaves the curvatures out. Pixels are processed in blocks of GROUPS vectors of LANES. */
enum { X, Y, T1, T2, S, A, B, GX, GY, K1, K2, PARAMETERS };
enum { FEWER = K1, ROWS = PARAMETERS + 1, LANES = 8, GROUPS = 8, BLOCK = LANES * GROUPS };

/* Vectors of LANES numbers at any address. */
typedef float lanes_t __attribute__((vector_size(4 * LANES), aligned(4)));
typedef int32_t mask_t __attribute__((vector_size(4 * LANES)));

/* The lattice at a corner: the cell's sides; the curvatures of its two lines and their standard deviations; for the neighbouring
 * lines before and after both, their distances (`gaps`), their angles to the corner's line (`tilts`), the reach of the window
 * towards them, in sides of the cell (NaN: by rule), whether the lattice has no corner there (`ends`), and the brightness of the
 * paper beyond (NaN: unknown). `single`: on which side of each line the square is, +1 or -1, for corners of one square alone;
 * 0 for others. */
typedef struct {
    const double *sides, *curvature, *curvature_sigma, *gaps, *tilts, *reach, *paper, *single;
    const uint8_t *ends;
} geometry_t;

/* The pixels of a corner, relative to (centre_u, centre_v), at most `radius` from it along both axes. `rows` has room for the
 * rows of reference.edge_model.linearise, block by block; `square`, `turned`, `change` and `paired` for `across` x `across`
 * pixels around the centre. */
typedef struct {
    float *u, *v, *value, *rows, *square, *turned, *change, *paired;
    int64_t count, across, radius;
    double centre_u, centre_v, size;
} window_t;

typedef float block_row_t[BLOCK];

/* Return the rows of the block of pixels that begins at `start`. */
INLINE block_row_t *rows_of(const window_t *window, int64_t start)
{
    return (block_row_t *)(window->rows + start * ROWS);
}

/* edges_window.c */

void collect_window(
    window_t *window, const picture_t image, const double pixel[2], const geometry_t at, double blur, const edge_rules_t *rules);
int is_surrounded(const window_t *window, float x, float y);

/* edges_model.c */

void set_brightness(double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double sign);
void normal_equations(
    const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products);
void all_normal_equations(
    const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products);
void papered_equations(
    const int n, const double *values, const window_t *window, const geometry_t at, const edge_rules_t *rules, double *products);

/* edges_noise.c */

double leave_residuals(window_t *window, const double *step, int parameters);
double unmirrored(const double *values, window_t *window, int parameters, const edge_rules_t *rules);
void lag_products(const window_t *window, double y, double *out);

/* edges.c */

void fit_tag_edges(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t places, const uint8_t *cells, const double *steps,
    const double *signs, int64_t count, const double *pixels, const double *surface, const double *single, const double *contrast,
    const double *blur, const tag_window_t *tag, const edge_rules_t *rules, float *scratch, double *out);
double blur_of_tags(
    const void *grey, int64_t bytes, int64_t width, int64_t height, int64_t places, const uint8_t *cells, const double *steps,
    const double *signs, int64_t count, const double *pixels, const double *surface, const double *single, const double *contrast,
    int64_t stride, double blur, const tag_window_t *tag, const edge_rules_t *rules, float *scratch, double *found);

#endif
