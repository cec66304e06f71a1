/* Kernels of rigkit.relative_pose.solvers.minimal: essential matrices from five equations, and from six.
 *
 * Every function repeats the one of the package that its comment names. The numpy version takes the real solutions of the
 * five-point problem from the eigenvectors of a 10x10 matrix, this one from the real roots of a polynomial of degree ten
 * (Nister, "An efficient solution to the five-point relative pose problem", 2004), isolated by Sturm's theorem; both
 * solve the same ten cubics. */
#include "kernels.h"

#define CUBICS 10
#define MONOMIALS 20
#define DEGREE 10
/* Roots of the polynomial lose digits on the way to it: solutions worse than this are polished. */
#define EXACT 1e-11
/* What is worse than this afterwards, far above the rounding even of double roots, was none. */
#define NONE 1e-6

/* Places in products of polynomials in x, y, z: of degree one (x y z 1), two (x2 xy xz y2 yz z2 x y z 1) and three:
 * x3 y3 x2y xy2 x2z x2 y2z y2 xyz xy | xz2 xz x yz2 yz y z3 z2 z 1, the first ten of which are eliminated. */
static const int QUADRATIC[4][4] = {{0, 1, 2, 6}, {1, 3, 4, 7}, {2, 4, 5, 8}, {6, 7, 8, 9}};
static const int CUBIC[10][4] = {
    {0, 2, 4, 5},   {2, 3, 8, 9},   {4, 8, 10, 11}, {3, 1, 6, 7},    {8, 6, 13, 14},
    {10, 13, 16, 17}, {5, 9, 11, 12}, {9, 7, 14, 15}, {11, 14, 17, 18}, {12, 15, 18, 19},
};

/* Add sign * a * b of degree one, and of degrees two and one. */
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

/* Fill `basis` (9 - count, 9) with orthonormal vectors perpendicular to the `count` rows: Householder reflections. */
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
        /* A row that says nothing; one that is not finite makes everything NaN. */
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

/* Fill `out` (10, 20) with the coefficients of 2 E E^T E - tr(E E^T) E = 0 and det E = 0, E = x X + y Y + z Z + W with
 * X to W the rows of `basis` (minimal._constraint_coefficients, which finds them from values). */
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

/* Eliminate the first ten columns; afterwards rows 4 to 9 hold their monomials in terms of the last ten columns. Return
 * whether that was possible. */
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

/* A chain of Sturm: coefficient d of polynomial i at [d][i], zero above its degree. */
typedef struct {
    double at[DEGREE + 1][12];
    int count;
} chain_t;

/* Fill the chain of p, lowest coefficient first. */
INLINE void sturm_chain(const double *p, chain_t *chain)
{
    double poly[DEGREE + 2][DEGREE + 1];
    int degree[DEGREE + 2];
    memset(poly, 0, sizeof poly);
    memset(chain->at, 0, sizeof chain->at);
    memcpy(poly[0], p, sizeof(double) * (DEGREE + 1));
    degree[0] = DEGREE;
    while (degree[0] > 0 && poly[0][degree[0]] == 0.0)
        degree[0]--;
    for (int d = 1; d <= degree[0]; d++)
        poly[1][d - 1] = d * poly[0][d];
    degree[1] = degree[0] - 1;
    chain->count = degree[0] > 0 ? 2 : 1;
    while (degree[0] > 0 && degree[chain->count - 1] > 0) {
        const int i = chain->count;
        double *rest = poly[i];
        const double *divisor = poly[i - 1];
        memcpy(rest, poly[i - 2], sizeof poly[i]);
        for (int d = degree[i - 2]; d >= degree[i - 1]; d--) {
            const double factor = rest[d] / divisor[degree[i - 1]];
            for (int k = 0; k <= degree[i - 1]; k++)
                rest[d - degree[i - 1] + k] -= factor * divisor[k];
            rest[d] = 0.0;
        }
        double most = 0.0;
        for (int d = 0; d < degree[i - 1]; d++)
            most = fabs(rest[d]) > most ? fabs(rest[d]) : most;
        if (!(most > 1e-300))
            break;
        degree[i] = -1;
        for (int d = 0; d < degree[i - 1]; d++) {
            rest[d] = -rest[d] / most;
            /* A leading coefficient that is rounding is none: division by it would make the rest rounding too. */
            degree[i] = fabs(rest[d]) > 1e-13 ? d : degree[i];
        }
        for (int d = degree[i] + 1; d <= DEGREE; d++)
            rest[d] = 0.0;
        chain->count++;
    }
    for (int i = 0; i < chain->count; i++)
        for (int d = 0; d <= DEGREE; d++)
            chain->at[d][i] = poly[i][d];
}

/* Return how many signs change along the chain at x. */
INLINE int sign_changes(const chain_t *chain, double x)
{
    double value[12] = {0.0};
    for (int d = DEGREE; d >= 0; d--)
        for (int i = 0; i < 12; i++)
            value[i] = value[i] * x + chain->at[d][i];
    int changes = 0;
    double last = value[0];
    for (int i = 1; i < chain->count; i++) {
        if (value[i] == 0.0)
            continue;
        changes += (value[i] < 0.0) != (last < 0.0);
        last = value[i];
    }
    return changes;
}

/* Return the root of p between `low` and `high`, at which its signs differ: Newton's method inside the bracket. */
INLINE double root_between(const double *p, double low, double high, int low_negative)
{
    double x = 0.5 * (low + high);
    for (int step = 0; step < 60; step++) {
        double value = p[DEGREE], slope = 0.0;
        for (int d = DEGREE - 1; d >= 0; d--) {
            slope = slope * x + value;
            value = value * x + p[d];
        }
        if (value == 0.0)
            return x;
        if ((value < 0.0) == low_negative)
            low = x;
        else
            high = x;
        double next = x - value / slope;
        if (!(next > low && next < high))
            next = 0.5 * (low + high);
        if (fabs(next - x) < 1e-13)
            return next;
        x = next;
    }
    return x;
}

INLINE double value_of(const double *p, double x)
{
    double value = p[DEGREE];
    for (int d = DEGREE - 1; d >= 0; d--)
        value = value * x + p[d];
    return value;
}

/* Append the roots of p in (-1, 1] to `roots`; return their new number. */
INLINE int roots_inside(const double *p, double *roots, int found)
{
    chain_t chain;
    sturm_chain(p, &chain);
    struct {
        double low, high;
        int at_low, at_high;
    } todo[64];
    int depth = 0;
    const int first = sign_changes(&chain, -1.0), last = sign_changes(&chain, 1.0);
    if (first > last) {
        todo[0].low = -1.0, todo[0].high = 1.0, todo[0].at_low = first, todo[0].at_high = last;
        depth = 1;
    }
    while (depth > 0 && found < MOST_ROOTS) {
        depth--;
        const double low = todo[depth].low, high = todo[depth].high, middle = 0.5 * (low + high);
        const int at_low = todo[depth].at_low, at_high = todo[depth].at_high;
        if (at_low - at_high == 1) {
            const double below = value_of(p, low), above = value_of(p, high);
            if ((below < 0.0) != (above < 0.0)) {
                roots[found++] = root_between(p, low, high, below < 0.0);
                continue;
            }
        }
        if (high - low < 1e-11) {
            /* A double root, to rounding. */
            roots[found++] = middle;
            continue;
        }
        const int between = sign_changes(&chain, middle);
        if (between > at_high && depth < 63) {
            todo[depth].low = middle, todo[depth].high = high, todo[depth].at_low = between, todo[depth].at_high = at_high;
            depth++;
        }
        if (at_low > between && depth < 63) {
            todo[depth].low = low, todo[depth].high = middle, todo[depth].at_low = at_low, todo[depth].at_high = between;
            depth++;
        }
    }
    return found;
}

/* Return the real roots of the polynomial p of degree ten: those within the unit circle, and the others as inverses of
 * roots of the reversed polynomial, so that no root lies far out. */
INLINE int real_roots(const double *p, double *roots)
{
    double reversed[DEGREE + 1];
    for (int d = 0; d <= DEGREE; d++)
        reversed[d] = p[DEGREE - d];
    const int inside = roots_inside(p, roots, 0);
    const int all = roots_inside(reversed, roots, inside);
    int kept = inside;
    for (int i = inside; i < all; i++)
        if (fabs(roots[i]) > 1e-12)
            roots[kept++] = 1.0 / roots[i];
    return kept;
}

/* Add a * b of polynomials in z to `out`. */
INLINE void add_poly(const double *a, int degree_a, const double *b, int degree_b, double sign, double *out)
{
    for (int i = 0; i <= degree_a; i++)
        for (int j = 0; j <= degree_b; j++)
            out[i + j] += sign * a[i] * b[j];
}

/* Write x X + y Y + z Z + W, unit norm. */
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

/* Take a Gauss-Newton step of (x, y, z) on the ten cubics. */
INLINE void polish(const double cubics[CUBICS][MONOMIALS], double place[3])
{
    const double x = place[0], y = place[1], z = place[2], xx = x * x, yy = y * y, zz = z * z;
    const double terms[4][MONOMIALS] = {
        {3.0 * xx, 0.0, 2.0 * x * y, yy, 2.0 * x * z, 2.0 * x, 0.0, 0.0, y * z, y, zz, z, 1.0},
        {0.0, 3.0 * yy, xx, 2.0 * x * y, 0.0, 0.0, 2.0 * y * z, 2.0 * y, x * z, x, 0.0, 0.0, 0.0, zz, z, 1.0},
        {0.0, 0.0, 0.0, 0.0, xx, 0.0, yy, 0.0, x * y, 0.0, 2.0 * x * z, x, 0.0, 2.0 * y * z, y, 0.0, 3.0 * zz, 2.0 * z,
         1.0},
        {x * xx, y * yy, xx * y, x * yy, xx * z, xx, yy * z, yy, x * y * z, x * y, x * zz, x * z, x, y * zz, y * z, y,
         z * zz, zz, z, 1.0},
    };
    /* The normal equations, and in the last column their right hand side; solved by Cramer's rule. */
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
    /* At a double root the equations are singular and the step means nothing. */
    for (int i = 0; i < 3; i++)
        if (!(det > 0.0 && fabs(move[i]) < 0.3 * det * (1.0 + fabs(x) + fabs(y) + fabs(z))))
            return;
    for (int i = 0; i < 3; i++)
        place[i] -= move[i] / det;
}

/* Write the up to ten E of five rows, 9 numbers each, unit norm, NaN for those that are missing
 * (minimal.essential_from_five_rows). */
INLINE void solve_five(const double *rows, double *out)
{
    double basis[4 * 9], cubics[CUBICS][MONOMIALS], given[CUBICS][MONOMIALS], roots[MOST_ROOTS];
    for (int i = 0; i < 9 * MOST_ROOTS; i++)
        out[i] = NAN;
    null_space(rows, 5, basis);
    constraints(basis, cubics);
    memcpy(given, cubics, sizeof given);
    if (!eliminate(cubics))
        return;
    /* Rows 4 to 9: x2z, x2, y2z, y2, xyz, xy. From each pair one equation [..] x + [..] y + [..] = 0 in powers of z. */
    double part[3][3][5];
    for (int r = 0; r < 3; r++) {
        const double *with_z = cubics[4 + 2 * r] + 10, *without = cubics[5 + 2 * r] + 10;
        for (int g = 0; g < 3; g++) {
            const int first = 3 * g, top = g < 2 ? 2 : 3;
            for (int d = 0; d <= top + 1; d++)
                part[r][g][d] = (d <= top ? with_z[first + top - d] : 0.0) - (d > 0 ? without[first + top + 1 - d] : 0.0);
        }
    }
    double p[DEGREE + 1] = {0.0};
    for (int r = 0; r < 3; r++) {
        const int s = (r + 1) % 3, t = (r + 2) % 3;
        double minor[7] = {0.0};
        add_poly(part[s][0], 3, part[t][1], 3, 1.0, minor);
        add_poly(part[s][1], 3, part[t][0], 3, -1.0, minor);
        add_poly(minor, 6, part[r][2], 4, 1.0, p);
    }
    double most = 0.0;
    for (int d = 0; d <= DEGREE; d++)
        most = fabs(p[d]) > most ? fabs(p[d]) : most;
    if (!(most > 0.0 && most < 1e300))
        return;
    for (int d = 0; d <= DEGREE; d++)
        p[d] /= most;
    const int count = real_roots(p, roots);
    int written = 0;
    for (int k = 0; k < count; k++) {
        const double z = roots[k];
        double v[3][3], best[3] = {0.0}, longest = 0.0;
        for (int r = 0; r < 3; r++)
            for (int g = 0; g < 3; g++) {
                double value = 0.0;
                for (int d = g < 2 ? 3 : 4; d >= 0; d--)
                    value = value * z + part[r][g][d];
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
            continue;
        double place[3] = {best[0] / best[2], best[1] / best[2], z}, *E = out + 9 * written;
        combine(basis, place, E);
        for (int step = 0; step < 8 && violation(E) > EXACT; step++) {
            polish(given, place);
            combine(basis, place, E);
        }
        if (violation(E) < NONE)
            written++;
    }
    for (int i = 9 * written; i < 9 * MOST_ROOTS; i++)
        out[i] = NAN;
}

/* Rotate the `size` columns of `m`, `length` numbers each and one after the other, until they are perpendicular; `v`
 * (size columns of size) collects the rotations: one-sided Jacobi, as exact for the small singular values. */
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

/* Return which of the `size` columns of `m` is the longest, or with `sign` -1 the shortest. */
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

/* Replace E by the essential matrix nearest to it, unit norm (eight_point.essential_nearest). */
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

/* Write the E of six rows (minimal.essential_from_six_rows): the monomials that violate the cubics least. */
INLINE void solve_six(const double *rows, double *E)
{
    /* The first of four basis matrices is zero: ten of the monomials do not contain x. */
    static const int WITHOUT_X[CUBICS] = {1, 6, 7, 13, 14, 15, 16, 17, 18, 19};
    /* How often each occurs among the products of three of y, z, 1, and where each product is. */
    static const double OFTEN[CUBICS] = {1.0, 3.0, 3.0, 3.0, 6.0, 3.0, 1.0, 3.0, 3.0, 1.0};
    static const int PRODUCTS[3][9] = {{0, 1, 2, 1, 3, 4, 2, 4, 5}, {1, 3, 4, 3, 6, 7, 4, 7, 8}, {2, 4, 5, 4, 7, 8, 5, 8, 9}};
    double basis[4 * 9] = {0.0}, cubics[CUBICS][MONOMIALS], m[CUBICS * CUBICS], v[CUBICS * CUBICS];
    null_space(rows, 6, basis + 9);
    constraints(basis, cubics);
    for (int k = 0; k < CUBICS; k++)
        for (int i = 0; i < CUBICS; i++)
            m[CUBICS * k + i] = cubics[i][WITHOUT_X[k]] / sqrt(OFTEN[k]);
    orthogonalise(m, CUBICS, v, CUBICS);
    const double *found = v + CUBICS * extreme(m, CUBICS, CUBICS, -1.0);
    double products[27], turn[9];
    for (int i = 0; i < 27; i++)
        products[i] = found[PRODUCTS[i / 9][i % 9]] / sqrt(OFTEN[PRODUCTS[i / 9][i % 9]]);
    orthogonalise(products, 9, turn, 3);
    const double *weights = turn + 3 * extreme(products, 9, 3, 1.0);
    for (int i = 0; i < 9; i++)
        E[i] = weights[0] * basis[9 + i] + weights[1] * basis[18 + i] + weights[2] * basis[27 + i];
    make_essential(E);
}

/* `rows` (count, 5, 9) -> `out` (count, 10, 9). */
FOR_EACH_PROCESSOR void five_rows(const double *rows, int64_t count, double *out)
{
    for (int64_t b = 0; b < count; b++)
        solve_five(rows + 45 * b, out + 9 * MOST_ROOTS * b);
}

/* `rows` (count, 6, 9) -> `out` (count, 9). */
FOR_EACH_PROCESSOR void six_rows(const double *rows, int64_t count, double *out)
{
    for (int64_t b = 0; b < count; b++)
        solve_six(rows + 54 * b, out + 9 * b);
}
