/* Essential matrices from six linear equations (rigkit.relative_pose.solvers.minimal). */
#include "minimal.h"

/* A pivot below this part of the largest is rounding. */
#define ROUNDING 1e-16
/* A direction that turns by less in a step of inverse iteration is the singular vector, far below any noise of the rows. */
#define STEADY 1e-13
/* A step takes a tenth of a microsecond; where so many do not suffice, Jacobi's rotations take ten. */
#define INVERSE_STEPS 40

/* Rotate the `size` columns of `m`, of `length` numbers each, until they are orthogonal, and set `v` (size columns of size) to the
 * rotations: a singular value decomposition by one-sided Jacobi, which is accurate for small singular values, too (Golub and Van
 * Loan, "Matrix Computations"). */
INLINE void orthogonalise(double *m, int length, double *v, int size)
{
    for (int i = 0; i < size * size; i++)
        v[i] = i % (size + 1) == 0;
    for (int sweep = 0, turned = 1; turned && sweep < 30; sweep++) {
        turned = 0;
        for (int i = 0; i < size - 1; i++)
            for (int j = i + 1; j < size; j++) {
                double *a = m + length * i, *b = m + length * j, *p = v + size * i, *q = v + size * j;
                double aa = 0.0, ab = 0.0, bb = 0.0;
                for (int k = 0; k < length; k++) {
                    aa += a[k] * a[k];
                    ab += a[k] * b[k];
                    bb += b[k] * b[k];
                }
                if (!(ab * ab > 1e-30 * aa * bb))
                    continue;
                turned = 1;
                const double zeta = (bb - aa) / (2.0 * ab);
                const double tangent = (zeta < 0.0 ? -1.0 : 1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                const double c = 1.0 / sqrt(1.0 + tangent * tangent), s = c * tangent;
                for (int k = 0; k < length; k++) {
                    const double kept = a[k];
                    a[k] = c * kept - s * b[k];
                    b[k] = s * kept + c * b[k];
                }
                for (int k = 0; k < size; k++) {
                    const double kept = p[k];
                    p[k] = c * kept - s * q[k];
                    q[k] = s * kept + c * q[k];
                }
            }
    }
}

/* Return the index of the longest of the `size` columns of `m`, or with `sign` -1 of the shortest. */
INLINE int extreme(const double *m, int length, int size, double sign)
{
    int found = 0;
    double most = -INFINITY;
    for (int i = 0; i < size; i++) {
        double square = 0.0;
        for (int k = 0; k < length; k++)
            square += m[length * i + k] * m[length * i + k];
        if (sign * square > most) {
            most = sign * square;
            found = i;
        }
    }
    return found;
}

/* Replace the columns of `m` (size columns of size numbers) by those of R of its QR decomposition, its diagonal by the reciprocals:
 * Householder reflections. A pivot of nothing but rounding is taken for the rounding. Return whether `m` is finite and not zero. */
INLINE int triangle(double *m, int size)
{
    double largest = 0.0;
    for (int k = 0; k < size; k++) {
        double *v = m + size * k, square = 0.0;
        for (int i = k; i < size; i++)
            square += v[i] * v[i];
        const double length = v[k] < 0.0 ? -sqrt(square) : sqrt(square);
        largest = fmax(largest, fabs(length));
        const double first = v[k] + length;
        if (first != 0.0)
            for (int j = k + 1; j < size; j++) {
                double *column = m + size * j, along = first * column[k];
                for (int i = k + 1; i < size; i++)
                    along += v[i] * column[i];
                const double share = along / (length * first);
                column[k] -= share * first;
                for (int i = k + 1; i < size; i++)
                    column[i] -= share * v[i];
            }
        v[k] = -length;
    }
    if (!(largest > 0.0 && largest < INFINITY))
        return 0;
    for (int k = 0; k < size; k++)
        m[(size + 1) * k] = 1.0 / (fabs(m[(size + 1) * k]) > ROUNDING * largest ? m[(size + 1) * k] : ROUNDING * largest);
    return 1;
}

/* Write the right singular vector `x` of `triangle`'s matrix for its smallest singular value: inverse iteration. Return 0 where it
 * does not converge soon, because the two smallest are nearly equal. */
INLINE int least_direction(const double *m, double *x, int size)
{
    double y[CUBICS], kept[CUBICS] = {0.0};
    for (int step = 0; step < INVERSE_STEPS; step++) {
        for (int i = 0; i < size; i++) {
            double sum = 0.0;
            for (int k = 0; k < i; k++)
                sum += m[size * i + k] * y[k];
            /* The first right side is of ones, with signs for which the solution is long: it is not perpendicular to `x`. */
            const double right = step ? kept[i] : sum > 0.0 ? -1.0 : 1.0;
            y[i] = (right - sum) * m[(size + 1) * i];
        }
        double square = 0.0, change = 0.0;
        for (int i = size - 1; i >= 0; i--) {
            x[i] = y[i] * m[(size + 1) * i];
            for (int k = 0; k < i; k++)
                y[k] -= m[size * i + k] * x[i];
            square += x[i] * x[i];
        }
        const double scale = 1.0 / sqrt(square);
        for (int i = 0; i < size; i++) {
            x[i] *= scale;
            change += (x[i] - kept[i]) * (x[i] - kept[i]);
            kept[i] = x[i];
        }
        if (change < STEADY * STEADY)
            return 1;
    }
    return 0;
}

/* Write the right singular vector `x` of `m` (size columns of size numbers, destroyed) for its smallest singular value. */
INLINE void smallest_singular_vector(double *m, double *x, int size)
{
    double v[CUBICS * CUBICS], copy[CUBICS * CUBICS];
    memcpy(copy, m, sizeof(double) * (size_t)(size * size));
    if (triangle(copy, size) && least_direction(copy, x, size))
        return;
    orthogonalise(m, size, v, size);
    memcpy(x, v + size * extreme(m, size, size, -1.0), sizeof(double) * (size_t)size);
}

/* Replace E by the nearest essential matrix of unit norm (pose.essential_nearest). */
INLINE void make_essential(double *E)
{
    double m[9], v[9];
    for (int i = 0; i < 9; i++)
        m[3 * (i % 3) + i / 3] = E[i];
    orthogonalise(m, 3, v, 3);
    const int least = extreme(m, 3, 3, -1.0);
    memset(E, 0, 9 * sizeof(double));
    for (int k = 0; k < 3; k++) {
        const double *left = m + 3 * k;
        const double size = sqrt(2.0 * (left[0] * left[0] + left[1] * left[1] + left[2] * left[2]));
        for (int i = 0; k != least && i < 9; i++)
            E[i] += left[i / 3] * v[3 * k + i % 3] / size;
    }
}

/* Write the essential matrix of six rows (minimal.essential_from_six_rows): the vector of monomials that violates the cubics
 * least. */
INLINE void solve_six(const double *rows, double *E)
{
    /* The first of four basis matrices is zero: ten of the monomials do not contain x. */
    static const int WITHOUT_X[CUBICS] = {1, 6, 7, 13, 14, 15, 16, 17, 18, 19};
    /* The multiplicity of each among the products of three of y, z, 1, and the index of each product. */
    static const double OFTEN[CUBICS] = {1.0, 3.0, 3.0, 3.0, 6.0, 3.0, 1.0, 3.0, 3.0, 1.0};
    static const int PRODUCTS[3][9] = {{0, 1, 2, 1, 3, 4, 2, 4, 5}, {1, 3, 4, 3, 6, 7, 4, 7, 8}, {2, 4, 5, 4, 7, 8, 5, 8, 9}};
    double basis[4 * 9] = {0.0}, cubics[CUBICS][MONOMIALS], m[CUBICS * CUBICS], found[CUBICS];
    null_space(rows, 6, basis + 9);
    constraints(basis, cubics);
    for (int k = 0; k < CUBICS; k++)
        for (int i = 0; i < CUBICS; i++)
            m[CUBICS * k + i] = cubics[i][WITHOUT_X[k]] / sqrt(OFTEN[k]);
    smallest_singular_vector(m, found, CUBICS);
    double products[27], turn[9];
    for (int i = 0; i < 27; i++)
        products[i] = found[PRODUCTS[i / 9][i % 9]] / sqrt(OFTEN[PRODUCTS[i / 9][i % 9]]);
    orthogonalise(products, 9, turn, 3);
    const double *weights = turn + 3 * extreme(products, 9, 3, 1.0);
    for (int i = 0; i < 9; i++)
        E[i] = weights[0] * basis[9 + i] + weights[1] * basis[18 + i] + weights[2] * basis[27 + i];
    make_essential(E);
}

/* Solve `count` problems: `rows` (count, 6, 9), `out` (count, 9). */
FOR_EACH_PROCESSOR void six_rows(const double *rows, int64_t count, double *out)
{
    for (int64_t b = 0; b < count; b++)
        solve_six(rows + 54 * b, out + 9 * b);
}
