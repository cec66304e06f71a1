/* Robust fits of planes to the measurements of a surface at the nodes of a grid. Adjacent nodes are fitted together, one in each
 * lane of a vector. The definition in numpy is in tests/kernels/reference/planes.py. */
#include "kernels.h"

enum { LANES = 8, UPPER = 6, XX = 0, XY, XZ, YY, YZ, ZZ };

/* The terms of each node in the fit of a plane m: |z - F m|^2 in sigmas is m'N m - 2 b'm + c. They are 0 for nodes without
 * measurements, and in a margin of `reach` nodes around the grid and of the last lanes. */
typedef struct {
    int64_t columns, size;
    double *terms;
} sums_t;

enum {
    TERM_N = 0,
    TERM_B = UPPER,
    TERM_C = UPPER + 3,
    TERM_SEEN = UPPER + 4,
    TERMS = UPPER + 5,
    /* For the curvature: W, W F, W z, the offset of the measured point from its node, and the variance of its window. */
    TERM_W = TERMS,
    TERM_WF = TERM_W + UPPER,
    TERM_WZ = TERM_WF + 9,
    TERM_OFF = TERM_WZ + 3,
    TERM_WINDOW = TERM_OFF + 2,
    ALL_TERMS = TERM_WINDOW + 1
};

static int make_sums(const plane_grid_t *g, sums_t *out)
{
    out->columns = g->columns + 2 * g->reach + LANES;
    out->size = out->columns * (g->rows + 2 * g->reach);
    out->terms = calloc((size_t)(ALL_TERMS * out->size), sizeof(double));
    if (out->terms == NULL)
        return 0;
    for (int64_t k = 0; k < g->rows * g->columns; k++) {
        const double *z = g->values + 3 * k, *W = g->information + 9 * k, *F = g->frames + 9 * k;
        if (!isfinite(z[0]))
            continue;
        double *at = out->terms + (k / g->columns + g->reach) * out->columns + k % g->columns + g->reach;
        double Wz[3], c = 0.0;
        for (int64_t i = 0; i < 3; i++) {
            Wz[i] = W[3 * i] * z[0] + W[3 * i + 1] * z[1] + W[3 * i + 2] * z[2];
            c += z[i] * Wz[i];
            at[(TERM_WZ + i) * out->size] = Wz[i];
            for (int64_t j = i; j < 3; j++)
                at[(TERM_W + i * (5 - i) / 2 + j) * out->size] = W[3 * i + j];
        }
        for (int64_t j = 0; j < 3; j++) {
            /* Column j of W F, and of the upper triangle of F'W F. */
            double Wf[3];
            for (int64_t i = 0; i < 3; i++)
                at[(TERM_WF + 3 * i + j) * out->size] = Wf[i] = W[3 * i] * F[j] + W[3 * i + 1] * F[3 + j] + W[3 * i + 2] * F[6 + j];
            for (int64_t i = 0; i <= j; i++)
                at[(TERM_N + i * (5 - i) / 2 + j) * out->size] = F[i] * Wf[0] + F[3 + i] * Wf[1] + F[6 + i] * Wf[2];
            at[(TERM_B + j) * out->size] = F[j] * Wz[0] + F[3 + j] * Wz[1] + F[6 + j] * Wz[2];
        }
        at[TERM_OFF * out->size] = g->offsets[2 * k];
        at[(TERM_OFF + 1) * out->size] = g->offsets[2 * k + 1];
        at[TERM_WINDOW * out->size] = g->windows[k];
        at[TERM_C * out->size] = c;
        at[TERM_SEEN * out->size] = 1.0;
    }
    return 1;
}

/* Set x to the solution of N x = b, with N a symmetric matrix given by its upper triangle; return whether N is positive definite. N
 * is scaled first to a unit diagonal, as the units of its rows differ by thousands. */
INLINE int solve3(const double N[UPPER], const double b[3], double x[3])
{
    const double s0 = 1.0 / sqrt(N[XX]), s1 = 1.0 / sqrt(N[YY]), s2 = 1.0 / sqrt(N[ZZ]);
    const double p = N[XY] * s0 * s1, q = N[XZ] * s0 * s2, r = N[YZ] * s1 * s2;
    const double xx = 1.0 - r * r, yy = 1.0 - q * q, zz = 1.0 - p * p, xy = q * r - p, xz = p * r - q, yz = p * q - r;
    const double determinant = xx + p * xy + q * xz, part = 1.0 / determinant;
    const double b0 = b[0] * s0, b1 = b[1] * s1, b2 = b[2] * s2;
    x[0] = s0 * part * (xx * b0 + xy * b1 + xz * b2);
    x[1] = s1 * part * (xy * b0 + yy * b1 + yz * b2);
    x[2] = s2 * part * (xz * b0 + yz * b1 + zz * b2);
    return N[XX] > 0.0 && N[YY] > 0.0 && N[ZZ] > 0.0 && determinant > 1e-13;
}

/* LANES planes with the sums of their last fit and of the one before. */
typedef struct {
    double plane[3][LANES], sum[TERMS][LANES], own[UPPER][LANES];
} fits_t;

/* Return |z - F m|^2 in sigmas of the neighbour `at` from the plane m of a lane, with N = F'W F and g = F'W (z - F m). */
INLINE double missed(const double *at, int64_t size, const fits_t *fits, int64_t lane, double N[UPPER], double g[3])
{
    const double x = fits->plane[0][lane], y = fits->plane[1][lane], z = fits->plane[2][lane];
    double b[3];
    for (int64_t k = 0; k < UPPER; k++)
        N[k] = at[(TERM_N + k) * size];
    for (int64_t k = 0; k < 3; k++)
        b[k] = at[(TERM_B + k) * size];
    g[0] = b[0] - (N[XX] * x + N[XY] * y + N[XZ] * z);
    g[1] = b[1] - (N[XY] * x + N[YY] * y + N[YZ] * z);
    g[2] = b[2] - (N[XZ] * x + N[YZ] * y + N[ZZ] * z);
    return at[TERM_C * size] - (b[0] + g[0]) * x - (b[1] + g[1]) * y - (b[2] + g[2]) * z;
}

/* Return the weight of a neighbour by Geman and McClure's loss. */
INLINE double weight_of(const double *at, int64_t size, double square, double loss)
{
    const double part = 1.0 / (1.0 + (square < 0.0 ? 0.0 : square) * loss);
    return at[TERM_SEEN * size] * part * part;
}

/* Add the terms of the neighbours at `there`, weighted by their distances from the plane (Geman-McClure), to the sums of a round;
 * in the first round the distance has the uncertainty of the node's own plane added. */
INLINE void add_neighbours(const sums_t *sums, const double *there, const int first, double loss, fits_t *fits)
{
#pragma omp simd
    for (int64_t l = 0; l < LANES; l++) {
        double N[UPPER], g[3];
        double square = missed(there + l, sums->size, fits, l, N, g);
        if (first) {
            /* With the covariance S of the plane: (W^-1 + F S F')^-1 = W - W F (S^-1 + F'W F)^-1 F'W (Woodbury). */
            double both[UPPER], less[3];
            for (int64_t k = 0; k < UPPER; k++)
                both[k] = fits->own[k][l] + N[k];
            solve3(both, g, less);
            square -= g[0] * less[0] + g[1] * less[1] + g[2] * less[2];
        }
        const double *at = there + l, weight = weight_of(at, sums->size, square, loss);
        for (int64_t k = 0; k < TERM_SEEN; k++)
            fits->sum[k][l] += weight * at[k * sums->size];
        fits->sum[TERM_SEEN][l] += weight;
    }
}

/* Set the planes from the sums; NaN in lanes without one. */
INLINE void solve_planes(fits_t *fits)
{
#pragma omp simd
    for (int64_t l = 0; l < LANES; l++) {
        double N[UPPER], b[3], x[3];
        for (int64_t k = 0; k < UPPER; k++)
            N[k] = fits->sum[TERM_N + k][l];
        for (int64_t k = 0; k < 3; k++)
            b[k] = fits->sum[TERM_B + k][l];
        const int good = solve3(N, b, x);
        for (int64_t k = 0; k < 3; k++)
            fits->plane[k][l] = good ? x[k] : NAN;
    }
}

/* Sums of the fit of a curvature k = (uu, uv, vv) together with a plane: F'W Q, Q'W Q (upper triangle) and Q'W (z - F m), where
 * a neighbour measures z = F m + Q k, about the plane m whose weights those of the fit are. */
typedef struct {
    double mixed[9][LANES], own[UPPER][LANES], pull[3][LANES], plane[3][LANES];
} bends_t;

/* Add a neighbour at `there`, (x, y) px away from the node, to the sums of the curvature. A plane fitted to a curved surface in a
 * window is parallel to its tangent in the middle of the window, and off by half the curvature times the window's variance. */
INLINE void add_bends(
    const sums_t *sums, const double *there, const fits_t *fits, const double x, const double y, double loss, const double *here,
    bends_t *bends)
{
#pragma omp simd
    for (int64_t l = 0; l < LANES; l++) {
        const double *at = there + l;
        double N[UPPER], g[3], W[UPPER], WF[9], r[3];
        const double weight = weight_of(at, sums->size, missed(at, sums->size, fits, l, N, g), loss);
        const double a = fits->plane[0][l], b = fits->plane[1][l], c = fits->plane[2][l];
        for (int64_t k = 0; k < UPPER; k++)
            W[k] = at[(TERM_W + k) * sums->size];
        for (int64_t k = 0; k < 9; k++)
            WF[k] = at[(TERM_WF + k) * sums->size];
        for (int64_t k = 0; k < 3; k++)
            r[k] = weight * (at[(TERM_WZ + k) * sums->size] - (WF[3 * k] * a + WF[3 * k + 1] * b + WF[3 * k + 2] * c));
        /* The first row of Q; the others are (dx, dy, 0) and (0, dx, dy). */
        const double dx = x - here[TERM_OFF * sums->size + l], dy = y - here[(TERM_OFF + 1) * sums->size + l];
        const double u = at[TERM_OFF * sums->size], v = at[(TERM_OFF + 1) * sums->size], s = at[TERM_WINDOW * sums->size];
        const double q[3] = {0.5 * (dx * dx + s) + dx * u, dx * dy + dx * v + dy * u, 0.5 * (dy * dy + s) + dy * v};
        for (int64_t k = 0; k < 3; k++) {
            bends->mixed[3 * k][l] += weight * (WF[k] * q[0] + WF[3 + k] * dx);
            bends->mixed[3 * k + 1][l] += weight * (WF[k] * q[1] + WF[3 + k] * dy + WF[6 + k] * dx);
            bends->mixed[3 * k + 2][l] += weight * (WF[k] * q[2] + WF[6 + k] * dy);
        }
        /* The columns of W Q. */
        const double first[3] = {W[XX] * q[0] + W[XY] * dx, W[XY] * q[0] + W[YY] * dx, W[XZ] * q[0] + W[YZ] * dx};
        const double second[3] = {
            W[XX] * q[1] + W[XY] * dy + W[XZ] * dx, W[XY] * q[1] + W[YY] * dy + W[YZ] * dx, W[XZ] * q[1] + W[YZ] * dy + W[ZZ] * dx};
        const double third[3] = {W[XX] * q[2] + W[XZ] * dy, W[XY] * q[2] + W[YZ] * dy, W[XZ] * q[2] + W[ZZ] * dy};
        bends->own[XX][l] += weight * (q[0] * first[0] + dx * first[1]);
        bends->own[XY][l] += weight * (q[0] * second[0] + dx * second[1]);
        bends->own[XZ][l] += weight * (q[0] * third[0] + dx * third[1]);
        bends->own[YY][l] += weight * (q[1] * second[0] + dy * second[1] + dx * second[2]);
        bends->own[YZ][l] += weight * (q[1] * third[0] + dy * third[1] + dx * third[2]);
        bends->own[ZZ][l] += weight * (q[2] * third[0] + dy * third[2]);
        bends->pull[0][l] += q[0] * r[0] + dx * r[1];
        bends->pull[1][l] += q[1] * r[0] + dy * r[1] + dx * r[2];
        bends->pull[2][l] += q[2] * r[0] + dy * r[2];
    }
}

/* Set the sums of the curvature from all nodes around. */
INLINE void add_all_bends(
    const plane_grid_t *g, const sums_t *sums, const double *here, const fits_t *fits, double loss, bends_t *bends)
{
    memset(bends, 0, sizeof *bends);
    memcpy(bends->plane, fits->plane, sizeof bends->plane);
    for (int64_t dr = -g->reach; dr <= g->reach; dr++)
        for (int64_t dc = -g->reach; dc <= g->reach; dc++) {
            const double *there = here + dr * sums->columns + dc;
            add_bends(sums, there, fits, g->step * (double)dc, g->step * (double)dr, loss, here, bends);
        }
}

/* The results of `fit_planes`, in its order. */
enum { PLANES, NORMALS, SUPPORT, SQUARES, MIXED, BENDS, PULL, RESULTS };

/* Write the results of a lane, of the node `at`. */
static void write_node(const fits_t *fits, const bends_t *curved, int64_t l, int64_t at, double *const out[RESULTS])
{
    static const int entry[9] = {XX, XY, XZ, XY, YY, YZ, XZ, YZ, ZZ};
    out[SUPPORT][at] = fits->sum[TERM_SEEN][l];
    /* At the minimum b'm = m'N m. */
    double square = fits->sum[TERM_C][l];
    for (int64_t k = 0; k < 3; k++) {
        out[PLANES][3 * at + k] = fits->plane[k][l];
        out[PULL][3 * at + k] = curved->pull[k][l];
        for (int64_t n = 0; n < 3; n++)
            out[PULL][3 * at + k] -= curved->mixed[3 * n + k][l] * (fits->plane[n][l] - curved->plane[n][l]);
        square -= fits->sum[TERM_B + k][l] * fits->plane[k][l];
    }
    out[SQUARES][at] = square > 0.0 ? square : 0.0;
    for (int64_t k = 0; k < 9; k++) {
        out[NORMALS][9 * at + k] = fits->sum[TERM_N + entry[k]][l];
        out[MIXED][9 * at + k] = curved->mixed[k][l];
        out[BENDS][9 * at + k] = curved->own[entry[k]][l];
    }
}

/* Fill planes, the normal matrices of their fits, the sums of the weights, and the weighted sums of squared distances from the
 * planes, in sigmas, and the sums of `bends_t`; NaN where there is no plane. Return 0 if there is no memory, else 1. */
FOR_EACH_PROCESSOR int64_t fit_planes(
    const plane_grid_t *g, double *planes, double *normals, double *support, double *squares, double *mixed, double *bends,
    double *pull)
{
    const double loss = 1.0 / (3.0 * g->turn * g->turn);
    double *const out[RESULTS] = {planes, normals, support, squares, mixed, bends, pull};
    const int64_t width[RESULTS] = {3, 9, 1, 1, 9, 9, 3};
    for (int64_t n = 0; n < RESULTS; n++)
        for (int64_t k = 0; k < width[n] * g->rows * g->columns; k++)
            out[n][k] = NAN;
    sums_t sums;
    if (!make_sums(g, &sums))
        return 0;
    for (int64_t row = 0; row < g->rows; row++) {
        for (int64_t start = 0; start < g->columns; start += LANES) {
            const double *here = sums.terms + (row + g->reach) * sums.columns + start + g->reach;
            fits_t fits;
            double seen = 0.0;
            for (int64_t l = 0; l < LANES; l++)
                seen += here[TERM_SEEN * sums.size + l];
            if (!(seen > 0.0))
                continue;
            for (int64_t k = 0; k < TERMS; k++)
                memcpy(fits.sum[k], here + k * sums.size, sizeof fits.sum[k]);
            memcpy(fits.own, fits.sum, sizeof fits.own);
            solve_planes(&fits);
            bends_t curved;
            for (int64_t round = 0; round < g->rounds; round++) {
                memset(fits.sum, 0, sizeof fits.sum);
                for (int64_t dr = -g->reach; dr <= g->reach; dr++)
                    for (int64_t dc = -g->reach; dc <= g->reach; dc++) {
                        const double *there = here + dr * sums.columns + dc;
                        if (round == 0)
                            add_neighbours(&sums, there, 1, loss, &fits);
                        else
                            add_neighbours(&sums, there, 0, loss, &fits);
                    }
                if (round == g->rounds - 1)
                    add_all_bends(g, &sums, here, &fits, loss, &curved);
                solve_planes(&fits);
            }
            for (int64_t l = 0; l < LANES && start + l < g->columns; l++) {
                const int64_t at = row * g->columns + start + l;
                if (!(here[TERM_SEEN * sums.size + l] > 0.0 && isfinite(fits.plane[0][l])))
                    continue;
                write_node(&fits, &curved, l, at, out);
            }
        }
    }
    free(sums.terms);
    return 1;
}
