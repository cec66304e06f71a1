/* Essential matrices from five linear equations (rigkit.relative_pose.solvers.minimal), by the real roots of a polynomial of degree
 * ten (Nister, "An efficient solution to the five-point relative pose problem", 2004). tests/kernels/reference/minimal.py solves
 * the same ten cubics by the eigenvectors of a 10 x 10 matrix. */
#include "minimal.h"
#include "roots.h"

/* The coefficients of the polynomial have rounding errors: solutions with a larger `violation` are polished. */
#define EXACT 1e-11
/* Polished solutions with a larger `violation` are none; this is far above the rounding errors of double roots. */
#define NONE 1e-6

/* Eliminate the first ten columns (Gauss, partial pivoting), so that rows 4 to 9 express their monomials by the last ten; return
 * whether the pivots are not zero. */
INLINE int eliminate(double m[CUBICS][MONOMIALS])
{
    for (int k = 0; k < CUBICS; k++) {
        int pivot = k;
        for (int i = k + 1; i < CUBICS; i++)
            pivot = fabs(m[i][k]) > fabs(m[pivot][k]) ? i : pivot;
        if (!(fabs(m[pivot][k]) > 1e-14))
            return 0;
        if (pivot != k)
            for (int j = 0; j < MONOMIALS; j++) {
                const double kept = m[k][j];
                m[k][j] = m[pivot][j];
                m[pivot][j] = kept;
            }
        const double scale = 1.0 / m[k][k];
        for (int j = k; j < MONOMIALS; j++)
            m[k][j] *= scale;
        for (int i = k > 4 ? 4 : k + 1; i < CUBICS; i++) {
            if (i == k)
                continue;
            const double factor = m[i][k];
            for (int j = k; j < MONOMIALS; j++)
                m[i][j] -= factor * m[k][j];
        }
    }
    return 1;
}

/* Add a * b of polynomials in z to `out`. */
INLINE void add_poly(const double *a, int degree_a, const double *b, int degree_b, double sign, double *out)
{
    for (int i = 0; i <= degree_a; i++)
        for (int j = 0; j <= degree_b; j++)
            out[i + j] += sign * a[i] * b[j];
}

/* Set `E` to x X + y Y + z Z + W at unit norm. */
INLINE void combine(const double *basis, const double place[3], double *E)
{
    double square = 0.0;
    for (int i = 0; i < 9; i++) {
        E[i] = place[0] * basis[i] + place[1] * basis[9 + i] + place[2] * basis[18 + i] + basis[27 + i];
        square += E[i] * E[i];
    }
    const double scale = 1.0 / sqrt(square);
    for (int i = 0; i < 9; i++)
        E[i] *= scale;
}

/* Return the largest entry of 2 E E^T E - E, which is zero for an essential matrix of unit norm and for no other. */
INLINE double violation(const double *E)
{
    double square[9], most = 0.0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            square[3 * i + j] = E[3 * i] * E[3 * j] + E[3 * i + 1] * E[3 * j + 1] + E[3 * i + 2] * E[3 * j + 2];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const double *row = square + 3 * i;
            const double entry = 2.0 * (row[0] * E[j] + row[1] * E[3 + j] + row[2] * E[6 + j]) - E[3 * i + j];
            most = fabs(entry) > most ? fabs(entry) : most;
        }
    return most;
}

/* Move (x, y, z) by a Gauss-Newton step on the ten cubics. */
INLINE void polish(const double cubics[CUBICS][MONOMIALS], double place[3])
{
    const double x = place[0], y = place[1], z = place[2], xx = x * x, yy = y * y, zz = z * z;
    const double terms[4][MONOMIALS] = {
        {3.0 * xx, 0.0, 2.0 * x * y, yy, 2.0 * x * z, 2.0 * x, 0.0, 0.0, y * z, y, zz, z, 1.0},
        {0.0, 3.0 * yy, xx, 2.0 * x * y, 0.0, 0.0, 2.0 * y * z, 2.0 * y, x * z, x, 0.0, 0.0, 0.0, zz, z, 1.0},
        {0.0, 0.0, 0.0, 0.0, xx, 0.0, yy, 0.0, x * y, 0.0, 2.0 * x * z, x, 0.0, 2.0 * y * z, y, 0.0, 3.0 * zz, 2.0 * z, 1.0},
        {x * xx, y * yy, xx * y, x * yy, xx * z, xx, yy * z, yy, x * y * z, x * y,
         x * zz, x * z,  x,      y * zz, y * z,  y,  z * zz, zz, z,         1.0},
    };
    /* The normal equations with their right-hand side in the last column, solved by Cramer's rule. */
    double gram[3][4] = {{0.0}};
    for (int c = 0; c < CUBICS; c++) {
        double sums[4] = {0.0};
        for (int part = 0; part < 4; part++)
            for (int m = 0; m < MONOMIALS; m++)
                sums[part] += terms[part][m] * cubics[c][m];
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 4; j++)
                gram[i][j] += sums[i] * sums[j];
    }
    const double a = gram[0][0], b = gram[0][1], c = gram[0][2], d = gram[1][1], e = gram[1][2], f = gram[2][2];
    const double aa = d * f - e * e, ab = c * e - b * f, ac = b * e - c * d;
    const double bb = a * f - c * c, bc = b * c - a * e, cc = a * d - b * b, det = a * aa + b * ab + c * ac;
    const double p = gram[0][3], q = gram[1][3], r = gram[2][3];
    const double move[3] = {aa * p + ab * q + ac * r, ab * p + bb * q + bc * r, ac * p + bc * q + cc * r};
    /* At a double root the equations are singular and the step is not used. */
    for (int i = 0; i < 3; i++)
        if (!(det > 0.0 && fabs(move[i]) < 0.3 * det * (1.0 + fabs(x) + fabs(y) + fabs(z))))
            return;
    for (int i = 0; i < 3; i++)
        place[i] -= move[i] / det;
}

/* Three equations [..] x + [..] y + [..] = 0 whose coefficients are polynomials in z, the lowest power first. */
typedef struct {
    double at[3][3][5];
} pencil_t;

/* Set them from the eliminated cubics with the leading monomials x2z, x2, y2z, y2, xyz, xy: each pair gives one equation, the first
 * minus z times the second. */
INLINE void fill_pencil(const double cubics[CUBICS][MONOMIALS], pencil_t *out)
{
    for (int r = 0; r < 3; r++) {
        const double *with_z = cubics[4 + 2 * r] + 10, *without = cubics[5 + 2 * r] + 10;
        for (int g = 0; g < 3; g++) {
            const int first = 3 * g, top = g < 2 ? 2 : 3;
            for (int d = 0; d <= top + 1; d++)
                out->at[r][g][d] = (d <= top ? with_z[first + top - d] : 0.0) - (d > 0 ? without[first + top + 1 - d] : 0.0);
        }
    }
}

/* Set `p` to the determinant of the equations, scaled so that its largest coefficient is 1; return whether it is not zero. */
INLINE int fill_determinant(const pencil_t *pencil, double p[DEGREE + 1])
{
    memset(p, 0, sizeof(double) * (DEGREE + 1));
    for (int r = 0; r < 3; r++) {
        const int s = (r + 1) % 3, t = (r + 2) % 3;
        double minor[7] = {0.0};
        add_poly(pencil->at[s][0], 3, pencil->at[t][1], 3, 1.0, minor);
        add_poly(pencil->at[s][1], 3, pencil->at[t][0], 3, -1.0, minor);
        add_poly(minor, 6, pencil->at[r][2], 4, 1.0, p);
    }
    double most = 0.0;
    for (int d = 0; d <= DEGREE; d++)
        most = fabs(p[d]) > most ? fabs(p[d]) : most;
    if (!(most > 0.0 && most < 1e300))
        return 0;
    for (int d = 0; d <= DEGREE; d++)
        p[d] /= most;
    return 1;
}

/* Set `place` to the solution (x, y, z) of the equations at z; return whether it is finite. */
INLINE int solve_at(const pencil_t *pencil, double z, double place[3])
{
    double v[3][3], best[3] = {0.0}, longest = 0.0;
    for (int r = 0; r < 3; r++)
        for (int g = 0; g < 3; g++) {
            double value = 0.0;
            for (int d = g < 2 ? 3 : 4; d >= 0; d--)
                value = value * z + pencil->at[r][g][d];
            v[r][g] = value;
        }
    for (int r = 0; r < 3; r++) {
        const double *a = v[r], *b = v[(r + 1) % 3];
        const double normal[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
        const double length = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
        if (length > longest) {
            longest = length;
            memcpy(best, normal, sizeof best);
        }
    }
    if (!(best[2] * best[2] > 1e-24 * longest))
        return 0;
    place[0] = best[0] / best[2];
    place[1] = best[1] / best[2];
    place[2] = z;
    return 1;
}

/* Write up to MAX_ROOTS essential matrices of unit norm from five rows, and NaN for the others
 * (minimal.essential_from_five_rows). */
INLINE void solve_five(const double *rows, double *out)
{
    double basis[4 * 9], cubics[CUBICS][MONOMIALS], given[CUBICS][MONOMIALS], p[DEGREE + 1], roots[MAX_ROOTS];
    pencil_t pencil;
    for (int i = 0; i < 9 * MAX_ROOTS; i++)
        out[i] = NAN;
    null_space(rows, 5, basis);
    constraints(basis, cubics);
    memcpy(given, cubics, sizeof given);
    if (!eliminate(cubics))
        return;
    fill_pencil(cubics, &pencil);
    if (!fill_determinant(&pencil, p))
        return;
    const int count = real_roots(p, roots);
    int written = 0;
    for (int k = 0; k < count; k++) {
        double place[3], *E = out + 9 * written;
        if (!solve_at(&pencil, roots[k], place))
            continue;
        combine(basis, place, E);
        for (int step = 0; step < 8 && violation(E) > EXACT; step++) {
            polish(given, place);
            combine(basis, place, E);
        }
        if (violation(E) < NONE)
            written++;
    }
    for (int i = 9 * written; i < 9 * MAX_ROOTS; i++)
        out[i] = NAN;
}

/* Solve `count` problems: `rows` (count, 5, 9), `out` (count, MAX_ROOTS, 9). */
FOR_EACH_PROCESSOR void five_rows(const double *rows, int64_t count, double *out)
{
    for (int64_t b = 0; b < count; b++)
        solve_five(rows + 45 * b, out + 9 * MAX_ROOTS * b);
}
