/* The interface to Python: every function, structure and constant that C and Python share is declared here and in the headers
 * that this one includes, and nowhere else. The compiler checks the kernels against these declarations, and
 * rigkit.kernels.declarations parses them to make the calls. They must stay simple: no conditions, no macros but those below.
 *
 * ARRAY(type, name, sizes...) is a pointer to the first value of a C-contiguous array. Its sizes, in terms of the other
 * arguments or members, are those that the caller's array must have. An argument that is itself such a size, as `count` in
 * ARRAY(const double, pixels, count, 2), is taken from the array: Python does not pass it.
 * RESULT(...) is an array that the call allocates and returns, SCRATCH(...) one that it allocates as working memory.
 * IMAGE(name) is a grey image of bytes or of float. */
#ifndef RIGKIT_KERNELS_API_H
#define RIGKIT_KERNELS_API_H

#include <stdint.h>

#define ARRAY(type, name, ...) type *name
#define RESULT(type, name, ...) type *name
#define SCRATCH(type, name, ...) type *name
#define IMAGE(name) const void *name, int64_t bytes, int64_t width, int64_t height

/* Type of results that are zero or one. */
typedef uint8_t truth_t;

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* library.c */

/* Return the instruction set that hot functions use on this processor. */
EXPORT const char *instruction_set(void);

#include "api_lattice.h"
#include "api_fits.h"
#include "api_calibration.h"
#include "api_pairs.h"
#include "api_painting.h"

#endif
