/* Scores of clusters of images without their leverage, (I - M)^-1/2 z, by Chebyshev series (calibration.solving.clustered). */
#include "kernels.h"

/* Set `out` to (2 M / bound - 1) z for a symmetric M, as a sum of its rows, which is vectorised. */
INLINE void centred(const double *restrict M, const double *restrict z, int64_t n, double bound, double *restrict out)
{
    for (int64_t i = 0; i < n; i++)
        out[i] = -z[i];
    for (int64_t j = 0; j < n; j++) {
        const double scale = 2.0 / bound * z[j];
        for (int64_t i = 0; i < n; i++)
            out[i] += scale * M[j * n + i];
    }
}

/* Set `out` to the Chebyshev series of the leverage matrices M, with eigenvalues from 0 to `bound`, times their `columns` scores z
 * each (`pull`). */
EXPORT FOR_EACH_PROCESSOR void sum_series(
    const double *leverage, const double *pull, int64_t clusters, int64_t columns, int64_t n, double bound, const double *series,
    int64_t terms, double *memory, double *out)
{
    for (int64_t c = 0; c < clusters * columns; c++) {
        const double *M = leverage + c / columns * n * n;
        double *before = memory, *term = memory + n, *next = memory + 2 * n, *sum = out + c * n;
        memcpy(before, pull + c * n, (size_t)n * sizeof(double));
        centred(M, before, n, bound, term);
        for (int64_t i = 0; i < n; i++)
            sum[i] = series[0] * before[i] + series[1] * term[i];
        for (int64_t k = 2; k < terms; k++) {
            centred(M, term, n, bound, next);
            for (int64_t i = 0; i < n; i++) {
                next[i] = 2.0 * next[i] - before[i];
                sum[i] += series[k] * next[i];
            }
            double *last = before;
            before = term;
            term = next;
            next = last;
        }
    }
}
