/* Links between corners that are neighbours along an edge of a square. The definitions in numpy are in
 * tests/kernels/reference/links.py, the numbers in rigkit.detection.lattice.links. */
#include "kernels.h"

/* A possible neighbour along an arm: squared distance, the arm, the neighbour, and its arm that points back. */
typedef struct {
    float square;
    int64_t arm, end, back;
} candidate_t;

/* Corners that are processed together; all lists have memory for so many more. */
enum { TOGETHER = 8 };

/* The corners in the order of the grid of squares, so that those of a row of squares are contiguous: position, the unit vectors of
 * both lines, contrast. */
enum { A_U, A_V, B_U, B_V, CONTRAST, COLUMNS };
typedef struct {
    double *u, *v;
    float *columns[COLUMNS];
} places_t;

/* The corners near a corner: squared distance, infinite if the contrast is out of bounds; index in `places_t`; whether both point
 * arms at each other, of different lines. */
typedef struct {
    float *square;
    int32_t *place, *meets;
} near_t;

/* The corner whose neighbours are searched, and the bounds of their contrast. */
typedef struct {
    double u, v;
    float lines[4], contrast, min_contrast, max_contrast, ratio, square_of_cosine;
} home_t;

/* Append the places `from` to `to` - 1 to the `count` near corners; return the new number. */
INLINE int64_t append_near(const places_t *places, int64_t from, int64_t to, const home_t *home, const near_t *near, int64_t count)
{
    const float mine_a_u = home->lines[0], mine_a_v = home->lines[1];
    const float mine_b_u = home->lines[2], mine_b_v = home->lines[3];
    const float contrast = home->contrast, ratio = home->ratio, cosine = home->square_of_cosine;
    for (int64_t first = from; first < to; first += TOGETHER) {
        const double *us = places->u + first, *vs = places->v + first;
        const float *a_u = places->columns[A_U] + first, *a_v = places->columns[A_V] + first;
        const float *b_u = places->columns[B_U] + first, *b_v = places->columns[B_V] + first;
        const float *theirs = places->columns[CONTRAST] + first;
        float *restrict square = near->square + count + first - from;
        int32_t *restrict place = near->place + count + first - from;
        int32_t *restrict meets = near->meets + count + first - from;
        for (int32_t k = 0; k < TOGETHER; k++) {
            const float u = (float)(us[k] - home->u), v = (float)(vs[k] - home->v), here = u * u + v * v;
            const float a = u * mine_a_u + v * mine_a_v, b = u * mine_b_u + v * mine_b_v;
            const float home_a = u * a_u[k] + v * a_v[k], home_b = u * b_u[k] + v * b_v[k];
            const float along = a * a > b * b ? a * a : b * b;
            const float back = home_a * home_a > home_b * home_b ? home_a * home_a : home_b * home_b;
            const int32_t alike = (theirs[k] > home->min_contrast) & (theirs[k] < home->max_contrast);
            square[k] = alike ? here : INFINITY;
            place[k] = (int32_t)first + k;
            meets[k] = alike & (along > cosine * here) & (back > cosine * here)
                & ((b * b > a * a) != (home_b * home_b > home_a * home_a)) & (contrast > ratio * theirs[k])
                & (theirs[k] > ratio * contrast);
        }
    }
    return count + to - from;
}

/* Return the number of the `count` near corners whose squared distance is below `most`. */
INLINE int32_t count_nearer(const near_t *near, int64_t count, float most)
{
    const float *restrict square = near->square;
    int32_t nearer = 0;
    for (int64_t k = 0; k < count; k++)
        nearer += square[k] < most;
    return nearer;
}

/* Set `near` to corners around `home`, square by square, among them the `wanted` nearest with a contrast in bounds; return their
 * number. */
INLINE int64_t gather(const squares_t *squares, const places_t *places, const home_t *home, int64_t wanted, const near_t *near)
{
    /* Squares to each side that usually contain enough. */
    enum { AT_ONCE = 3 };
    const double u = home->u, v = home->v, side = squares->side;
    const int64_t column = square_at(u, squares->left, side, squares->columns);
    const int64_t row = square_at(v, squares->top, side, squares->rows);
    const double in_u = u - squares->left - (double)column * side, in_v = v - squares->top - (double)row * side;
    double inner = in_u < in_v ? in_u : in_v;
    inner = side - in_u < inner ? side - in_u : inner;
    inner = side - in_v < inner ? side - in_v : inner;
    int64_t count = 0;
    for (int64_t ring = AT_ONCE;; ring++) {
        const int64_t left = column - ring, right = column + ring, top = row - ring, bottom = row + ring;
        for (int64_t r = top > 0 ? top : 0; r <= bottom && r < squares->rows; r++) {
            const int32_t *first = squares->first + r * squares->columns;
            /* Whole rows above and below, the two ends of the others. */
            const int whole = ring == AT_ONCE || r == top || r == bottom;
            for (int part = 0; part < (whole ? 1 : 2); part++) {
                int64_t from = part == 0 ? left : right, to = whole ? right : from;
                if (to < 0 || from >= squares->columns)
                    continue;
                from = from > 0 ? from : 0;
                to = to < squares->columns ? to : squares->columns - 1;
                count = append_near(places, first[from], first[to + 1], home, near, count);
            }
        }
        if (left <= 0 && top <= 0 && right >= squares->columns - 1 && bottom >= squares->rows - 1)
            return count;
        /* All corners within this squared distance have been appended. */
        const float safe = (float)((inner + (double)ring * side) * (inner + (double)ring * side));
        if (count >= wanted && count_nearer(near, count, safe) >= wanted)
            return count;
    }
}

/* Return the arm (A, B, -A, -B) nearest to the direction of the chord. */
INLINE int64_t arm_along(double a, double b)
{
    return fabs(b) > fabs(a) ? (b < 0.0 ? 3 : 1) : (a < 0.0 ? 2 : 0);
}

/* A place in a level of the pyramid: the pixel (u, v) of the image, and the largest distance from an edge at which it is read. */
typedef struct {
    double u, v, most;
} level_place_t;

INLINE level_place_t place_in_level(const corners_t *corners, double scale, double offset, int64_t i)
{
    return (level_place_t){
        (corners->pixels[2 * i] - offset) / scale, (corners->pixels[2 * i + 1] - offset) / scale, corners->reach[i]};
}

/* Return how far from the edge between two places the image is read. */
INLINE double lateral_of(const link_rules_t *rules, level_place_t from, level_place_t to)
{
    double lateral = rules->lateral * sqrt((to.u - from.u) * (to.u - from.u) + (to.v - from.v) * (to.v - from.v));
    lateral = lateral > rules->min_lateral ? lateral : rules->min_lateral;
    return lateral < from.most ? lateral : from.most;
}

/* Return whether the image has the edge from corner i (reference.links._edge_seen). */
INLINE int link_seen(
    const corners_t *corners, const image_t image, double scale, double offset, const link_rules_t *rules, int64_t i,
    const candidate_t *link)
{
    const level_place_t from = place_in_level(corners, scale, offset, i);
    const level_place_t to = place_in_level(corners, scale, offset, link->end);
    const double there = corners->contrast[link->end], here = corners->contrast[i];
    const double weakest = rules->contrast_ratio * (there < here ? there : here);
    return edge_seen(
        image, rules->along, rules->places, rules->min_places, from.u, from.v, to.u, to.v, link->arm % 2 ? -1.0 : 1.0,
        lateral_of(rules, from, to), weakest);
}

/* Prefetch the pixels that are read first for an edge between two corners, on both sides of its middle. */
INLINE void fetch_edge(
    const corners_t *corners, const image_t image, double scale, double offset, const link_rules_t *rules, int64_t i, int64_t end)
{
    const level_place_t from = place_in_level(corners, scale, offset, i), to = place_in_level(corners, scale, offset, end);
    const double chord_u = to.u - from.u, chord_v = to.v - from.v;
    const double part = lateral_of(rules, from, to) / (sqrt(chord_u * chord_u + chord_v * chord_v) + 1e-9);
    for (int side = -1; side <= 1; side += 2) {
        const double u = 0.5 * (from.u + to.u) - side * part * chord_v, v = 0.5 * (from.v + to.v) + side * part * chord_u;
        if (u >= 0.0 && v >= 0.0 && u < (double)image.width && v < (double)(image.height - 1)) {
            const float *at = image.brightness + (int64_t)v * image.width + (int64_t)u;
            __builtin_prefetch(at);
            __builtin_prefetch(at + image.width);
        }
    }
}

enum { MAX_CANDIDATES = 512 };

/* Set `candidates` to the possible neighbours of the corner at `place`, the nearest first, and prefetch their edges; return their
 * number. */
INLINE int64_t list_candidates(
    const corners_t *corners, const squares_t *squares, const places_t *places, int64_t place, const image_t image, double scale,
    double offset, const link_rules_t *rules, const near_t *near, candidate_t *candidates)
{
    const int64_t i = squares->order[place], wanted = rules->neighbours + 1;
    const home_t home = {
        places->u[place],
        places->v[place],
        {places->columns[A_U][place], places->columns[A_V][place], places->columns[B_U][place], places->columns[B_V][place]},
        places->columns[CONTRAST][place],
        (float)corners->min_contrast[i],
        (float)corners->max_contrast[i],
        (float)rules->contrast_ratio,
        (float)(rules->arm_cosine * rules->arm_cosine)};
    const int64_t count = gather(squares, places, &home, wanted, near);
    int64_t listed = 0;
    for (int64_t first = 0; first < count; first += TOGETHER) {
        int32_t any = 0;
        for (int64_t k = first; k < first + TOGETHER; k++)
            any |= near->meets[k];
        if (!any)
            continue;
        const int64_t end = first + TOGETHER < count ? first + TOGETHER : count;
        for (int64_t k = first; k < end && listed < MAX_CANDIDATES; k++) {
            const float square = near->square[k];
            if (!near->meets[k] || count_nearer(near, count, square) >= wanted)
                continue;
            const int32_t at = near->place[k];
            const float u = (float)(places->u[at] - home.u), v = (float)(places->v[at] - home.v);
            const candidate_t fresh = {
                square, arm_along(u * home.lines[0] + v * home.lines[1], u * home.lines[2] + v * home.lines[3]), squares->order[at],
                arm_along(
                    -(u * places->columns[A_U][at] + v * places->columns[A_V][at]),
                    -(u * places->columns[B_U][at] + v * places->columns[B_V][at]))};
            fetch_edge(corners, image, scale, offset, rules, i, fresh.end);
            int64_t rank = listed++;
            for (; rank > 0 && candidates[rank - 1].square > square; rank--)
                candidates[rank] = candidates[rank - 1];
            candidates[rank] = fresh;
        }
    }
    return listed;
}

/* Set nearest[4 * i + arm] to 4 * corner + its arm for the nearest of the `listed` candidates along each arm of corner i to which
 * there is an edge, and farthest[4 * i + arm] to the squared distance of the last one that was tested, and of all before.
 *
 * An edge that was tested from its other end is not tested again, if the image is read at the same distance. */
INLINE void link_arms(
    const corners_t *corners, const image_t image, double scale, double offset, const link_rules_t *rules, int64_t i,
    const candidate_t *candidates, int64_t listed, int64_t *nearest, float *farthest)
{
    for (int64_t k = 0; k < listed; k++) {
        const candidate_t *link = candidates + k;
        const int64_t mine = 4 * i + link->arm, theirs = 4 * link->end + link->back;
        if (nearest[mine] >= 0)
            continue;
        const int known =
            (nearest[theirs] == mine || link->square < farthest[theirs]) && corners->reach[i] == corners->reach[link->end];
        farthest[mine] = link->square;
        if (known ? nearest[theirs] == mine : link_seen(corners, image, scale, offset, rules, i, link))
            nearest[mine] = theirs;
    }
}

/* The same for all corners, in the order of the grid: neighbours read the same corners and pixels. The edges of a corner are read
 * after those of the next one were prefetched. */
INLINE void link_each(
    const corners_t *corners, const squares_t *squares, const places_t *places, const image_t image, double scale, double offset,
    const link_rules_t *rules, const near_t *near, int64_t *nearest, float *farthest)
{
    const int64_t count = corners->count;
    candidate_t candidates[2][MAX_CANDIDATES];
    int64_t listed[2] = {0, 0};
    for (int64_t k = 0; k <= count; k++) {
        if (k < count)
            listed[k % 2] = list_candidates(corners, squares, places, k, image, scale, offset, rules, near, candidates[k % 2]);
        if (k > 0)
            link_arms(
                corners, image, scale, offset, rules, squares->order[k - 1], candidates[(k - 1) % 2], listed[(k - 1) % 2], nearest,
                farthest);
    }
}

static double link_length(const double *pixels, int64_t i, int64_t to)
{
    const double du = pixels[2 * (to / 4)] - pixels[2 * i], dv = pixels[2 * (to / 4) + 1] - pixels[2 * i + 1];
    return sqrt(du * du + dv * dv);
}

/* Set both[4 * i + arm] to 4 * neighbour + its arm for mutual links, -1 for none (reference.links.links). `nearest` (count, 4) is
 * scratch. Return 0 if there is no memory. */
FOR_EACH_PROCESSOR int64_t find_links(
    const corners_t *corners, image_t image, double scale, double offset, const link_rules_t *rules, int64_t *nearest,
    int64_t *both)
{
    const int64_t count = corners->count, room = count + TOGETHER;
    squares_t squares;
    double *memory = calloc((size_t)room, 2 * sizeof(double) + (COLUMNS + 5) * sizeof(float) + 2 * sizeof(int32_t));
    int32_t *scratch = malloc((size_t)SQUARES_MEMORY(count) * sizeof(int32_t));
    if (!memory || !scratch) {
        free(memory);
        free(scratch);
        return 0;
    }
    fill_squares(corners->pixels, count, 1.0, scratch, &squares);
    places_t places = {memory, memory + room, {NULL}};
    for (int k = 0; k < COLUMNS; k++)
        places.columns[k] = (float *)(memory + 2 * room) + k * room;
    const near_t near = {
        places.columns[COLUMNS - 1] + room, (int32_t *)(places.columns[COLUMNS - 1] + 2 * room),
        (int32_t *)(places.columns[COLUMNS - 1] + 3 * room)};
    for (int64_t k = 0; k < count; k++) {
        const int32_t i = squares.order[k];
        places.u[k] = corners->pixels[2 * i];
        places.v[k] = corners->pixels[2 * i + 1];
        for (int part = 0; part < 4; part++)
            places.columns[A_U + part][k] = (float)corners->lines[4 * i + part];
        places.columns[CONTRAST][k] = (float)corners->contrast[i];
    }
    float *farthest = (float *)(near.meets + room);
    for (int64_t k = 0; k < 4 * count; k++)
        nearest[k] = both[k] = -1;
    link_each(corners, &squares, &places, image, scale, offset, rules, &near, nearest, farthest);
    free(memory);
    free(scratch);
    for (int64_t k = 0; k < 4 * count; k++)
        if (nearest[k] >= 0 && nearest[nearest[k]] == k)
            both[k] = nearest[k];
    /* Both directions of a link are removed, so all links are tested before any is removed. */
    for (int64_t k = 0; k < 4 * count; k++) {
        const int64_t opposite = k / 4 * 4 + (k + 2) % 4;
        nearest[k] = both[k] >= 0 && both[opposite] >= 0
            && link_length(corners->pixels, k / 4, both[k])
                > rules->length_ratio * link_length(corners->pixels, k / 4, both[opposite]);
    }
    for (int64_t k = 0; k < 4 * count; k++)
        if (nearest[k] && both[k] >= 0) {
            both[both[k]] = -1;
            both[k] = -1;
        }
    return 1;
}
