/* Departures of a lens from its model: displacements of its image, and the sums of their products with the derivatives by poses
 * and parameters. The definition in numpy is in tests/kernels/reference/departures.py. */
#include "kernels.h"

/* Write the displacements at (x, y), relative to the centre of the image in units of half its diagonal. */
INLINE void displace(double x, double y, double u[DISPLACEMENTS], double v[DISPLACEMENTS])
{
    const double xx = x * x, xy = x * y, yy = y * y, square = xx + yy;
    u[0] = square * x;
    v[0] = square * y;
    for (int64_t j = 1; j < RADIAL_POWERS; j++) {
        u[j] = square * u[j - 1];
        v[j] = square * v[j - 1];
    }
    /* Decentring (tangential distortion) and thin prism (Weng, Cohen and Herniou, "Camera calibration with distortion models and
     * accuracy evaluation", 1992), thin prism times the squared radius, aspect ratio, shear. */
    const double others_u[] = {square + 2.0 * xx, 2.0 * xy, square, 0.0, square * square, 0.0, x, y};
    const double others_v[] = {2.0 * xy, square + 2.0 * yy, 0.0, square, 0.0, square * square, -y, x};
    for (int64_t j = RADIAL_POWERS; j < DISPLACEMENTS; j++) {
        u[j] = others_u[j - RADIAL_POWERS];
        v[j] = others_v[j - RADIAL_POWERS];
    }
}

EXPORT FOR_EACH_PROCESSOR void displace_pixels(
    const double *u, const double *v, int64_t count, int64_t width, int64_t height, double *out)
{
    const double scale = 2.0 / sqrt((double)(width * width + height * height));
    for (int64_t n = 0; n < count; n++) {
        double row_u[DISPLACEMENTS], row_v[DISPLACEMENTS];
        displace(scale * (u[n] - 0.5 * (double)(width - 1)), scale * (v[n] - 0.5 * (double)(height - 1)), row_u, row_v);
        for (int64_t j = 0; j < DISPLACEMENTS; j++) {
            out[j * count + n] = row_u[j];
            out[(DISPLACEMENTS + j) * count + n] = row_v[j];
        }
    }
}

EXPORT FOR_EACH_PROCESSOR void displace_by(
    const double *u, const double *v, int64_t count, int64_t width, int64_t height, const double *amounts, double *out)
{
    const double scale = 2.0 / sqrt((double)(width * width + height * height));
    for (int64_t n = 0; n < count; n++) {
        double x = scale * (u[n] - 0.5 * (double)(width - 1)), y = scale * (v[n] - 0.5 * (double)(height - 1));
        const double square = x * x + y * y, inside = square > 1.0 ? 1.0 / sqrt(square) : 1.0;
        double row_u[DISPLACEMENTS], row_v[DISPLACEMENTS], du = 0.0, dv = 0.0;
        displace(inside * x, inside * y, row_u, row_v);
        for (int64_t j = 0; j < DISPLACEMENTS; j++) {
            du += amounts[j] * row_u[j];
            dv += amounts[j] * row_v[j];
        }
        out[n] = du;
        out[count + n] = dv;
    }
}

/* Write both rows of a corner: derivatives by the pose (rotation, translation) and the parameters, displacements, residual. */
INLINE void write_rows(const lens_corners_t *c, double scale, int64_t n, int64_t across, double *row)
{
    const int64_t N = c->count, P = c->parameters;
    double *rows[2] = {row, row + across};
    const double q[3] = {c->lever[n], c->lever[N + n], c->lever[2 * N + n]};
    for (int64_t i = 0; i < 2; i++) {
        const double *J = c->d_pixels_d_point + 3 * N * i + n, *by = c->d_pixels_d_parameters + P * N * i + n;
        const double j0 = J[0], j1 = J[N], j2 = J[2 * N];
        double *to = rows[i];
        to[0] = q[1] * j2 - q[2] * j1;
        to[1] = q[2] * j0 - q[0] * j2;
        to[2] = q[0] * j1 - q[1] * j0;
        to[3] = j0;
        to[4] = j1;
        to[5] = j2;
        for (int64_t k = 0; k < P; k++)
            to[POSE + k] = c->sigmas[k] * by[k * N];
        to[POSE + P + DISPLACEMENTS] = c->residuals[2 * n + i];
    }
    const double x = scale * (c->u[n] - 0.5 * (double)(c->width - 1)), y = scale * (c->v[n] - 0.5 * (double)(c->height - 1));
    displace(x, y, rows[0] + POSE + P, rows[1] + POSE + P);
}

int64_t lens_memory(int64_t parameters)
{
    return rows_memory(POSE + parameters + DISPLACEMENTS + 1);
}

EXPORT FOR_EACH_PROCESSOR void lens_products(const lens_corners_t *c, double *memory, double *products)
{
    const int64_t all = POSE + c->parameters + DISPLACEMENTS + 1, across = padded(all);
    const double scale = 2.0 / sqrt((double)(c->width * c->width + c->height * c->height));
    double *sums = memory, *rows = memory + across * across;
    memset(rows, 0, (size_t)(2 * CORNERS * across) * sizeof(double));
    for (int64_t view = 0, n = 0; view < c->views; view++) {
        const int64_t stop = n + c->counts[view];
        memset(sums, 0, (size_t)(across * across) * sizeof(double));
        while (n < stop) {
            int64_t used = 0;
            for (; n < stop && used < CORNERS; n++)
                if (c->usable[n])
                    write_rows(c, scale, n, across, rows + 2 * across * used++);
            add_products(rows, 2 * used, across, sums);
        }
        double *own = products + all * all * view;
        for (int64_t i = 0; i < all; i++)
            for (int64_t j = i; j < all; j++)
                own[i * all + j] = own[j * all + i] = sums[i * across + j];
    }
}

EXPORT FOR_EACH_PROCESSOR void average_amounts(
    const double *information, const double *score, const double *sizes, int64_t count, double *out, double *average)
{
    enum { N = DISPLACEMENTS };
    double best = -INFINITY, total = 0.0;
    memset(out, 0, N * N * sizeof(double));
    memset(average, 0, N * sizeof(double));
    for (int64_t pair = 0; pair < count * count; pair++) {
        const double along = sizes[pair % count], other = sizes[pair / count];
        /* L L' = 1 + D F D with the information F and the sizes D; E = L^-1 D. */
        double L[N][N], E[N][N] = {{0.0}}, mean[N] = {0.0}, evidence = 0.0;
        for (int64_t i = 0; i < N; i++) {
            const double d = i < RADIAL_POWERS ? along : other;
            for (int64_t j = 0; j <= i; j++) {
                double sum = d * (j < RADIAL_POWERS ? along : other) * information[N * i + j] + (i == j ? 1.0 : 0.0);
                for (int64_t k = 0; k < j; k++)
                    sum -= L[i][k] * L[j][k];
                L[i][j] = i == j ? sqrt(sum) : sum / L[j][j];
            }
            E[i][i] = d;
            for (int64_t k = 0; k < i; k++)
                for (int64_t j = 0; j <= k; j++)
                    E[i][j] -= L[i][k] * E[k][j];
            double part = 0.0;
            for (int64_t j = 0; j <= i; j++) {
                E[i][j] /= L[i][i];
                part += E[i][j] * score[j];
            }
            for (int64_t j = 0; j <= i; j++)
                mean[j] += E[i][j] * part;
            evidence += 0.5 * part * part - log(L[i][i]);
        }
        if (evidence > best) {
            const double less = exp(best - evidence);
            total *= less;
            for (int64_t k = 0; k < N * N; k++)
                out[k] *= less;
            for (int64_t k = 0; k < N; k++)
                average[k] *= less;
            best = evidence;
        }
        const double weight = exp(evidence - best);
        total += weight;
        /* The covariance is E' E. */
        for (int64_t i = 0; i < N; i++) {
            average[i] += weight * mean[i];
            for (int64_t j = 0; j < N; j++)
                out[N * i + j] += weight * mean[i] * mean[j];
        }
        for (int64_t k = 0; k < N; k++)
            for (int64_t i = 0; i <= k; i++)
                for (int64_t j = 0; j <= k; j++)
                    out[N * i + j] += weight * E[k][i] * E[k][j];
    }
    for (int64_t k = 0; k < N * N; k++)
        out[k] /= total;
    for (int64_t k = 0; k < N; k++)
        average[k] /= total;
}
