/* The normal equations of views of boards: weighted rows of derivatives of every corner, and the sums of their products. The
 * definition in numpy is in tests/kernels/reference/linearise.py. */
#include "kernels.h"

EXPORT FOR_EACH_PROCESSOR void place_corners(const board_views_t *seen, int64_t first, int64_t count, double *lever, double *points)
{
    const int64_t C = seen->corners;
    for (int64_t view = first, n = 0; n < count; view++) {
        const double *R = seen->rotation + 9 * view, *t = seen->translation + 3 * view;
        const int64_t *point = seen->point + C * view;
        for (int64_t c = 0; c < C; c++, n++) {
            const double *X = seen->table + 3 * point[c];
            for (int64_t k = 0; k < 3; k++) {
                const double q = R[3 * k] * X[0] + R[3 * k + 1] * X[1] + R[3 * k + 2] * X[2];
                lever[count * k + n] = q;
                points[count * k + n] = q + t[k];
            }
        }
    }
}

int64_t rows_memory(int64_t across)
{
    return padded(across) * (padded(across) + 2 * CORNERS);
}

/* Add the products of the two rows of a corner with the derivatives `left` by its released point. */
INLINE void add_released(
    const view_sums_t *sums, int64_t view, int64_t place, const double left[2][3], const double *row_u, const double *row_v)
{
    const int64_t K = sums->across, motion = K - 1 - POSE;
    for (int64_t a = 0; a < 3; a++) {
        double *own = sums->own + (3 * place + a) * (K + 3);
        double *pose = sums->poses + ((view * sums->released + place) * 3 + a) * POSE;
        for (int64_t k = 0; k < K; k++)
            own[k] += left[0][a] * row_u[k] + left[1][a] * row_v[k];
        for (int64_t b = 0; b < 3; b++)
            own[K + b] += left[0][a] * left[0][b] + left[1][a] * left[1][b];
        for (int64_t k = 0; k < POSE; k++)
            pose[k] = left[0][a] * row_u[motion + k] + left[1][a] * row_v[motion + k];
    }
}

/* Set the row of one coordinate of a corner from the derivatives of its pixel by the point in the camera frame, weighted (`j`), and
 * by the parameters (`by`, `stride` apart); `q` is the lever arm. Set `left` to the derivatives by the board's point. */
INLINE void fill_row(
    const board_views_t *seen, const double *R, const double *q, int64_t point, double weight, const double j[3], const double *by,
    int64_t stride, int64_t parameters, double off, double left[3], double *row)
{
    const int64_t B = seen->warps;
    const double *warp = seen->warp + 3 * B * point;
    double *motion = row + parameters + B;
    for (int64_t k = 0; k < parameters; k++)
        row[k] = weight * by[k * stride];
    for (int64_t k = 0; k < 3; k++)
        left[k] = j[0] * R[k] + j[1] * R[3 + k] + j[2] * R[6 + k];
    for (int64_t b = 0; b < B; b++)
        row[parameters + b] = left[0] * warp[b] + left[1] * warp[B + b] + left[2] * warp[2 * B + b];
    motion[0] = q[1] * j[2] - q[2] * j[1];
    motion[1] = q[2] * j[0] - q[0] * j[2];
    motion[2] = q[0] * j[1] - q[1] * j[0];
    for (int64_t k = 0; k < 3; k++)
        motion[3 + k] = j[k];
    motion[POSE] = weight * off;
}

/* Return the robust cost of a corner (Cauchy's loss), and multiply `weight` by the square root of the loss's weight. */
INLINE double robust_cost(const double away[2], double loss, double *weight)
{
    const double squared = (away[0] * away[0] + away[1] * away[1]) * *weight * *weight;
    if (!(loss > 0.0))
        return squared;
    const double relative = squared / (loss * loss);
    *weight /= sqrt(1.0 + relative);
    return loss * loss * log1p(relative);
}

/* Set the parts of `sums` that belong to the views of `count` corners from the view `first` on. */
EXPORT FOR_EACH_PROCESSOR void add_views(
    const board_views_t *seen, int64_t first, int64_t count, int64_t parameters, const double *d_pixels_d_point,
    const double *d_pixels_d_parameters, const double *u, const double *v, const uint8_t *projects, const double *lever,
    double *memory, const view_sums_t *sums)
{
    const int64_t C = seen->corners, all = seen->views * C, K = sums->across, across = padded(K);
    double *total = memory, *rows = memory + across * across;
    memset(rows, 0, (size_t)(2 * CORNERS * across) * sizeof(double));
    for (int64_t view = first, n = 0; n < count; view++) {
        const double *R = seen->rotation + 9 * view;
        double cost = 0.0;
        int64_t used = 0;
        memset(total, 0, (size_t)(across * across) * sizeof(double));
        for (int64_t c = 0; c < C; c++, n++) {
            const int64_t m = view * C + c, point = seen->point[m];
            const double away[2] = {
                projects[n] ? seen->pixels[2 * m] - u[n] : seen->lost_px,
                projects[n] ? seen->pixels[2 * m + 1] - v[n] : seen->lost_px};
            sums->residuals[m] = away[0];
            sums->residuals[all + m] = away[1];
            sums->valid[m] = projects[n];
            double weight = seen->weight[m];
            cost += robust_cost(away, seen->loss_px, &weight);
            /* A corner outside the model's field of view has no derivatives: it adds to the cost only. */
            if (!projects[n] || weight == 0.0)
                continue;
            const double q[3] = {lever[n], lever[count + n], lever[2 * count + n]};
            double left[2][3];
            double *both = rows + 2 * across * used++;
            for (int64_t i = 0; i < 2; i++) {
                const double *J = d_pixels_d_point + 3 * count * i + n;
                const double j[3] = {weight * J[0], weight * J[count], weight * J[2 * count]};
                fill_row(
                    seen, R, q, point, weight, j, d_pixels_d_parameters + parameters * count * i + n, count, parameters, away[i],
                    left[i], both + across * i);
            }
            if (seen->released && seen->place[point] >= 0)
                add_released(sums, view, seen->place[point], left, both, both + across);
            if (used == CORNERS) {
                add_products(rows, 2 * used, across, total);
                used = 0;
            }
        }
        add_products(rows, 2 * used, across, total);
        sums->costs[view] = cost;
        double *own = sums->products + K * K * view;
        for (int64_t i = 0; i < K; i++)
            for (int64_t j = i; j < K; j++)
                own[i * K + j] = own[j * K + i] = total[i * across + j];
    }
}
