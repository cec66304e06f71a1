/* Shared by the five-point and the six-point solver: the null space of the equations, and the ten cubic constraints on the
 * combinations of its basis that are essential matrices (Nister, "An efficient solution to the five-point relative pose problem",
 * 2004). Functions repeat those that their comments name. */
#ifndef RIGKIT_MINIMAL_H
#define RIGKIT_MINIMAL_H

#include "kernels.h"

enum { CUBICS = 10, MONOMIALS = 20 };

/* Indices of the monomials of products of polynomials in x, y, z. The order of degree one is x y z 1, of degree two x2 xy xz y2 yz
 * z2 x y z 1, and of degree three x3 y3 x2y xy2 x2z x2 y2z y2 xyz xy | xz2 xz x yz2 yz y z3 z2 z 1; the first ten are
 * eliminated. */
static const int QUADRATIC[4][4] = {{0, 1, 2, 6}, {1, 3, 4, 7}, {2, 4, 5, 8}, {6, 7, 8, 9}};
static const int CUBIC[10][4] = {
    {0, 2, 4, 5},     {2, 3, 8, 9},   {4, 8, 10, 11}, {3, 1, 6, 7},     {8, 6, 13, 14},
    {10, 13, 16, 17}, {5, 9, 11, 12}, {9, 7, 14, 15}, {11, 14, 17, 18}, {12, 15, 18, 19},
};

/* Add sign * a * b with a and b of degree one, and a * b with a of degree two. */
INLINE void add_product(const double *a, const double *b, double sign, double *out)
{
#pragma GCC unroll 4
    for (int i = 0; i < 4; i++) {
#pragma GCC unroll 4
        for (int j = 0; j < 4; j++)
            out[QUADRATIC[i][j]] += sign * a[i] * b[j];
    }
}

INLINE void add_cubic(const double *a, const double *b, double *out)
{
#pragma GCC unroll 10
    for (int i = 0; i < 10; i++) {
#pragma GCC unroll 4
        for (int j = 0; j < 4; j++)
            out[CUBIC[i][j]] += a[i] * b[j];
    }
}

/* Set `basis` (9 - count, 9) to an orthonormal basis of the null space of the `count` rows, by Householder reflections. */
INLINE void null_space(const double *rows, int count, double *basis)
{
    double v[6][9], work[6][9];
    memcpy(work, rows, sizeof(double) * 9 * (size_t)count);
    for (int k = 0; k < count; k++) {
        double square = 0.0;
        for (int i = k; i < 9; i++)
            square += work[k][i] * work[k][i];
        const double size = sqrt(square);
        memset(v[k], 0, sizeof v[k]);
        /* A zero row is no constraint; a row that is not finite makes the basis NaN. */
        if (size == 0.0)
            continue;
        memcpy(v[k] + k, work[k] + k, sizeof(double) * (size_t)(9 - k));
        v[k][k] += v[k][k] < 0.0 ? -size : size;
        /* |v|^2 = 2 size (size + |first|) */
        const double scale = 1.0 / sqrt(size * fabs(v[k][k]));
        for (int i = k; i < 9; i++)
            v[k][i] *= scale;
        for (int j = k + 1; j < count; j++) {
            double along = 0.0;
            for (int i = k; i < 9; i++)
                along += v[k][i] * work[j][i];
            for (int i = k; i < 9; i++)
                work[j][i] -= along * v[k][i];
        }
    }
    for (int j = 0; j < 9 - count; j++) {
        double *e = basis + 9 * j;
        memset(e, 0, 9 * sizeof(double));
        e[count + j] = 1.0;
        for (int k = count - 1; k >= 0; k--) {
            double along = 0.0;
            for (int i = 0; i < 9; i++)
                along += v[k][i] * e[i];
            for (int i = 0; i < 9; i++)
                e[i] -= along * v[k][i];
        }
    }
}

/* Set `out` (10, 20) to the coefficients of 2 E E^T E - tr(E E^T) E = 0 and det E = 0 for E = x X + y Y + z Z + W with X to W the
 * rows of `basis` (reference.minimal._constraint_coefficients, which interpolates them). */
INLINE void constraints(const double *basis, double out[CUBICS][MONOMIALS])
{
    double E[3][3][4], square[3][3][10], minor[3][10];
    for (int e = 0; e < 9; e++)
        for (int j = 0; j < 4; j++)
            E[e / 3][e % 3][j] = basis[9 * j + e];
    memset(square, 0, sizeof square);
    memset(minor, 0, sizeof minor);
    memset(out, 0, sizeof(double) * CUBICS * MONOMIALS);
    for (int i = 0; i < 3; i++)
        for (int j = i; j < 3; j++) {
            for (int k = 0; k < 3; k++)
                add_product(E[i][k], E[j][k], 1.0, square[i][j]);
            memcpy(square[j][i], square[i][j], sizeof square[i][j]);
        }
    for (int m = 0; m < 10; m++) {
        const double trace = square[0][0][m] + square[1][1][m] + square[2][2][m];
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                square[i][j][m] = 2.0 * square[i][j][m] - (i == j ? trace : 0.0);
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            for (int k = 0; k < 3; k++)
                add_cubic(square[i][k], E[k][j], out[3 * i + j]);
    for (int j = 0; j < 3; j++) {
        const int a = (j + 1) % 3, b = (j + 2) % 3;
        add_product(E[1][a], E[2][b], 1.0, minor[j]);
        add_product(E[1][b], E[2][a], -1.0, minor[j]);
        add_cubic(minor[j], E[0][j], out[9]);
    }
}

#endif
