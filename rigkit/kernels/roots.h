/* Real roots of a polynomial of degree ten (roots.c). */
#ifndef RIGKIT_ROOTS_H
#define RIGKIT_ROOTS_H

#include "kernels.h"

enum { DEGREE = 10 };

/* Set `roots` to the real roots of the polynomial p, the lowest coefficient first; return their number. */
int real_roots(const double p[DEGREE + 1], double roots[MAX_ROOTS]);

#endif
