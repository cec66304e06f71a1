/* The curvatures of the lines of a lattice at its corners, from Taylor series along each line. The definition in numpy is in
 * tests/kernels/reference/edges.py, the numbers in rigkit.detection.subpixel.edge_curvature. */
#include "kernels.h"

enum { TERMS = 6 };

/* The normal equations of a line's Taylor coefficients, in sides of the cell, without their prior: element (i, j) of the matrix is
 * moment i + j. */
typedef struct {
    double moment[2 * TERMS - 1], right[TERMS][2];
} taylor_t;

/* Set `out` to the most probable coefficients along both axes, with priors of standard deviation `sigma`, and return the standard
 * deviation of the coefficient of degree 2. */
INLINE double most_probable(const taylor_t *line, const double sigma[TERMS], double free, double out[TERMS][2])
{
    /* Right-hand sides: both axes, and the unit vector for a column of the inverse. `lower` has the reciprocals of its diagonal. */
    double lower[TERMS][TERMS], right[TERMS][3] = {{0.0}};
    right[2][2] = 1.0;
    for (int j = 0; j < TERMS; j++) {
        right[j][0] = line->right[j][0] * sigma[j];
        right[j][1] = line->right[j][1] * sigma[j];
        for (int i = j; i < TERMS; i++) {
            double sum = line->moment[i + j] * sigma[i] * sigma[j] + (i > j ? 0.0 : j < 2 ? free : 1.0);
            for (int k = 0; k < j; k++)
                sum -= lower[i][k] * lower[j][k];
            lower[i][j] = i == j ? 1.0 / sqrt(sum) : sum * lower[j][j];
        }
        for (int axis = 0; axis < 3; axis++) {
            for (int k = 0; k < j; k++)
                right[j][axis] -= lower[j][k] * right[k][axis];
            right[j][axis] *= lower[j][j];
        }
    }
    for (int j = TERMS - 1; j >= 0; j--)
        for (int axis = 0; axis < 3; axis++) {
            for (int k = j + 1; k < TERMS; k++)
                right[j][axis] -= lower[k][j] * right[k][axis];
            right[j][axis] *= lower[j][j];
        }
    for (int j = 0; j < TERMS; j++)
        for (int axis = 0; axis < 2; axis++)
            out[j][axis] = right[j][axis] * sigma[j];
    return sqrt(right[2][2]) * sigma[2];
}

/* Set `out` to the curvature, 1/px, at index `at` of a line of `count` corners, `stride` cells apart, and its standard
 * deviation. */
INLINE void line_curvature(
    const double *pixels, const double *sigma, int64_t stride, int64_t at, int64_t count, double side,
    const curvature_rules_t *rules, double *out, double *out_sigma)
{
    taylor_t line = {0};
    const double per_side = 1.0 / side;
    for (int64_t step = -rules->reach; step <= rules->reach; step++) {
        if (at + step < 0 || at + step >= count)
            continue;
        const double *other = pixels + 2 * step * stride;
        double wide = sigma[step * stride];
        if (!isfinite(wide) || !isfinite(other[0]))
            continue;
        wide = per_side * (wide > rules->min_sigma ? wide : rules->min_sigma);
        const double u = (other[0] - pixels[0]) * per_side, v = (other[1] - pixels[1]) * per_side;
        double moment = 1.0 / (wide * wide);
        for (int k = 0; k < 2 * TERMS - 1; k++) {
            line.moment[k] += moment;
            if (k < TERMS) {
                line.right[k][0] += moment * u;
                line.right[k][1] += moment * v;
            }
            moment *= (double)step;
        }
    }
    double expected[TERMS] = {1.0}, found[TERMS][2];
    for (int k = 1; k < TERMS; k++)
        expected[k] = expected[k - 1] * rules->decay;
    double wide = most_probable(&line, expected, rules->free, found);
    const double second = 2.0 * hypot(found[2][0], found[2][1]), third = sqrt(2.0 * hypot(found[3][0], found[3][1]));
    const double turn = second > third ? second : third;
    if (turn > rules->bent) {
        double size = 0.5;
        for (int k = 2; k < TERMS; k++) {
            size *= turn;
            expected[k] = expected[k] > size ? expected[k] : size;
        }
        wide = most_probable(&line, expected, rules->free, found);
    }
    const double cross = 2.0 * (found[1][0] * found[2][1] - found[1][1] * found[2][0]);
    double square = found[1][0] * found[1][0] + found[1][1] * found[1][1];
    square = square > 1e-12 ? square : 1e-12;
    *out = cross / (square * sqrt(square) * side);
    *out_sigma = 2.0 * wide / (square * side);
}

/* Set `out` (M, 2) to the curvatures of row and column at the M wanted cells and `out_sigma` to their standard deviations
 * (reference.edges.line_curvatures). */
FOR_EACH_PROCESSOR
void line_curvatures(
    const double *pixels, const double *sigma, const uint8_t *wanted, int64_t rows, int64_t columns, int64_t count,
    const double *sides, const curvature_rules_t *rules, double *out, double *out_sigma)
{
    (void)count;
    for (int64_t row = 0; row < rows; row++)
        for (int64_t column = 0; column < columns; column++) {
            const int64_t cell = row * columns + column;
            if (!wanted[cell])
                continue;
            line_curvature(pixels + 2 * cell, sigma + cell, 1, column, columns, *sides++, rules, out++, out_sigma++);
            line_curvature(pixels + 2 * cell, sigma + cell, columns, row, rows, *sides++, rules, out++, out_sigma++);
        }
}
