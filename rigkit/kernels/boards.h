/* Shared by boards.c and board_places.c. */
#ifndef RIGKIT_BOARDS_H
#define RIGKIT_BOARDS_H

#include <math.h>
#include <stdint.h>

/* Return the index of the line, 0 to `lines` - 1, that is nearest to a place. */
static inline double nearest_line(double place, int64_t lines)
{
    const double last = (double)(lines - 1);
    return rint(place < 0.0 ? 0.0 : place > last ? last : place);
}

#endif
