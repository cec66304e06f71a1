/* What Python calls: every function, structure and constant that both sides know is declared here and in the headers that
 * this one includes, and nowhere else. The compiler checks the kernels against them, and rigkit.kernels.declarations reads
 * them to make the calls, so they are plain: no conditions, and of the preprocessor only the macros below.
 *
 * ARRAY(type, name, sizes...) is a pointer to the first value of a C-contiguous array; its sizes are what the caller's
 * array must have, in terms of the other arguments or members. A number that is a size of such an array by itself, as
 * `count` is of ARRAY(const double, pixels, count, 2), is read from it: Python passes no sizes.
 * RESULT(...) is an array that the call makes and returns, SCRATCH(...) one that it makes and forgets.
 * IMAGE(name) is a grey image, of bytes or else of float. */
#ifndef RIGKIT_KERNELS_API_H
#define RIGKIT_KERNELS_API_H

#include <stdint.h>

#define ARRAY(type, name, ...) type *name
#define RESULT(type, name, ...) type *name
#define SCRATCH(type, name, ...) type *name
#define IMAGE(name) const void *name, int64_t bytes, int64_t width, int64_t height

/* Of results that are zero or one. */
typedef uint8_t truth_t;

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* library.c */

/* The instruction set that hot functions are run with on this processor. */
EXPORT const char *instruction_set(void);

#include "api_lattice.h"
#include "api_fits.h"
#include "api_calibration.h"
#include "api_pairs.h"
#include "api_painting.h"

#endif
