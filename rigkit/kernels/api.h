/* What Python calls: every function, structure and constant that both sides know is declared here and in the headers that
 * this one includes, and nowhere else. The compiler checks the kernels against them, and rigkit.kernels.declarations reads
 * them to make the calls, so they are plain: no conditions, and of the preprocessor only the two macros below.
 *
 * ARRAY(type, name, sizes...) is a pointer to the first value of a C-contiguous array; its sizes are what the caller's
 * array must have, in terms of the other arguments or members. */
#ifndef RIGKIT_KERNELS_API_H
#define RIGKIT_KERNELS_API_H

#include <stdint.h>

#define ARRAY(type, name, ...) type *name

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
