/* Planes through what the nodes of a grid say of a surface, robustly: tests/kernels/reference/planes.py says what is
 * computed. */
#include "kernels.h"

typedef struct {
    double m[3][3];
} m3_t;

INLINE m3_t read_m3(const double *at)
{
    m3_t out;
    memcpy(&out, at, sizeof out);
    return out;
}

/* Return the inverse of a symmetric matrix, and whether it has one; scaled first, its units differ by thousands. */
INLINE int inverse_of(const m3_t *M, m3_t *out)
{
    double s[3];
    m3_t a;
    for (int64_t i = 0; i < 3; i++) {
        if (!(M->m[i][i] > 0.0))
            return 0;
        s[i] = 1.0 / sqrt(M->m[i][i]);
    }
    for (int64_t i = 0; i < 3; i++)
        for (int64_t j = 0; j < 3; j++)
            a.m[i][j] = M->m[i][j] * s[i] * s[j];
    for (int64_t i = 0; i < 3; i++) {
        for (int64_t j = 0; j < 3; j++) {
            const int64_t p = (j + 1) % 3, q = (j + 2) % 3, r = (i + 1) % 3, t = (i + 2) % 3;
            out->m[i][j] = a.m[p][r] * a.m[q][t] - a.m[p][t] * a.m[q][r];
        }
    }
    const double determinant = a.m[0][0] * out->m[0][0] + a.m[0][1] * out->m[1][0] + a.m[0][2] * out->m[2][0];
    if (!(determinant > 1e-13))
        return 0;
    for (int64_t i = 0; i < 3; i++)
        for (int64_t j = 0; j < 3; j++)
            out->m[i][j] *= s[i] * s[j] / determinant;
    return 1;
}

INLINE void apply_m3(const m3_t *M, const double v[3], double out[3])
{
    for (int64_t i = 0; i < 3; i++)
        out[i] = M->m[i][0] * v[0] + M->m[i][1] * v[1] + M->m[i][2] * v[2];
}

/* Return A^T B C, or with `turned` A B C^T where A is C. */
INLINE m3_t congruent(const m3_t *F, const m3_t *M, int turned)
{
    m3_t half, out;
    for (int64_t i = 0; i < 3; i++)
        for (int64_t j = 0; j < 3; j++)
            half.m[i][j] = turned ? F->m[i][0] * M->m[0][j] + F->m[i][1] * M->m[1][j] + F->m[i][2] * M->m[2][j]
                                  : F->m[0][i] * M->m[0][j] + F->m[1][i] * M->m[1][j] + F->m[2][i] * M->m[2][j];
    for (int64_t i = 0; i < 3; i++)
        for (int64_t j = 0; j < 3; j++)
            out.m[i][j] = turned ? half.m[i][0] * F->m[j][0] + half.m[i][1] * F->m[j][1] + half.m[i][2] * F->m[j][2]
                                 : half.m[i][0] * F->m[0][j] + half.m[i][1] * F->m[1][j] + half.m[i][2] * F->m[2][j];
    return out;
}

INLINE double square_in(const m3_t *M, const double v[3])
{
    double turned[3];
    apply_m3(M, v, turned);
    return v[0] * turned[0] + v[1] * turned[1] + v[2] * turned[2];
}

/* Fit the plane of one node; return the sum of weights, negative where there is no plane. */
INLINE double fit_plane(const plane_grid_t *g, int64_t row, int64_t column, double plane[3], m3_t *normal)
{
    const int64_t here = row * g->columns + column;
    m3_t spread;
    const m3_t F = read_m3(g->frames + 9 * here), W = read_m3(g->information + 9 * here);
    double value[3], right[3];
    *normal = congruent(&F, &W, 0);
    apply_m3(&W, g->values + 3 * here, value);
    for (int64_t i = 0; i < 3; i++)
        right[i] = F.m[0][i] * value[0] + F.m[1][i] * value[1] + F.m[2][i] * value[2];
    if (!inverse_of(normal, &spread))
        return -1.0;
    apply_m3(&spread, right, plane);
    const int64_t top = row > g->reach ? row - g->reach : 0, left = column > g->reach ? column - g->reach : 0;
    const int64_t bottom = row + g->reach < g->rows - 1 ? row + g->reach : g->rows - 1;
    const int64_t end = column + g->reach < g->columns - 1 ? column + g->reach : g->columns - 1;
    double support = 0.0;
    for (int64_t round = 0; round < g->rounds; round++) {
        memset(normal, 0, sizeof *normal);
        memset(right, 0, sizeof right);
        support = 0.0;
        for (int64_t r = top; r <= bottom; r++) {
            for (int64_t c = left; c <= end; c++) {
                const int64_t there = r * g->columns + c;
                const double *z = g->values + 3 * there;
                if (!isfinite(z[0]))
                    continue;
                const m3_t Fj = read_m3(g->frames + 9 * there), Wj = read_m3(g->information + 9 * there);
                double miss[3], seen[3];
                apply_m3(&Fj, plane, seen);
                for (int64_t i = 0; i < 3; i++)
                    miss[i] = z[i] - seen[i];
                double square;
                if (round == 0) {
                    /* The node's own plane is as uncertain as its neighbours say of theirs. */
                    m3_t both, inner, doubt = congruent(&Fj, &spread, 1);
                    if (!inverse_of(&Wj, &both))
                        continue;
                    for (int64_t i = 0; i < 3; i++)
                        for (int64_t j = 0; j < 3; j++)
                            both.m[i][j] += doubt.m[i][j];
                    if (!inverse_of(&both, &inner))
                        continue;
                    square = square_in(&inner, miss);
                } else {
                    square = square_in(&Wj, miss);
                }
                double weight = 1.0 / (1.0 + square / (3.0 * g->turn * g->turn));
                weight *= weight;
                const m3_t own = congruent(&Fj, &Wj, 0);
                apply_m3(&Wj, z, value);
                for (int64_t i = 0; i < 3; i++) {
                    right[i] += weight * (Fj.m[0][i] * value[0] + Fj.m[1][i] * value[1] + Fj.m[2][i] * value[2]);
                    for (int64_t j = 0; j < 3; j++)
                        normal->m[i][j] += weight * own.m[i][j];
                }
                support += weight;
            }
        }
        if (!inverse_of(normal, &spread))
            return -1.0;
        apply_m3(&spread, right, plane);
    }
    return support;
}

/* Fill planes, the normal matrices of their fits, and the sums of weights; NaN where there is no plane. */
FOR_EACH_PROCESSOR void fit_planes(const plane_grid_t *grid, double *planes, double *normals, double *support)
{
    for (int64_t row = 0; row < grid->rows; row++) {
        for (int64_t column = 0; column < grid->columns; column++) {
            const int64_t at = row * grid->columns + column;
            m3_t normal;
            support[at] = isfinite(grid->values[3 * at]) ? fit_plane(grid, row, column, planes + 3 * at, &normal) : -1.0;
            if (support[at] >= 0.0) {
                memcpy(normals + 9 * at, &normal, sizeof normal);
                continue;
            }
            support[at] = NAN;
            for (int64_t k = 0; k < 3; k++)
                planes[3 * at + k] = NAN;
            for (int64_t k = 0; k < 9; k++)
                normals[9 * at + k] = NAN;
        }
    }
}
