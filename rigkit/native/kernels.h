/* Conventions of the kernels: C-contiguous arrays, sizes as int64_t, images row by row as float (0..255), pixel (0, 0) the
 * centre of the top-left pixel. Kernels check nothing: their Python callers own types, shapes and sizes. */
#ifndef RIGKIT_KERNELS_H
#define RIGKIT_KERNELS_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* On a hot function: also compiled for newer processors, chosen when the library is loaded. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__gnu_linux__)
#define FOR_EACH_PROCESSOR __attribute__((target_clones("arch=haswell", "default")))
#else
#define FOR_EACH_PROCESSOR
#endif

/* The source that this library was built from (setup.py). */
const char *rigkit_source(void);
const char *rigkit_source(void) { return RIGKIT_SOURCE; }

#endif
