/* Declarations of api.h: rendering of boards. */
#ifndef RIGKIT_API_PAINTING_H
#define RIGKIT_API_PAINTING_H

/* painting.c */

/* Interpolation nodes of a tile's rays along each axis; how much of a tile a rectangle covers. */
enum { TILE_NODES = 9, NOT_COVERED = 0, COVERED_PARTLY = 1, COVERED_WHOLLY = 2 };

/* The sub-samples of a tile, `per_pixel` along each axis of a pixel: the interpolation weights of the nodes in each row and
 * column, and the rays at the nodes. At the rim of the lens the ray of every sub-sample is given (`ray_rows` is `rows`, else
 * 0). */
typedef struct {
    ARRAY(const double, weights_v, rows, TILE_NODES);
    ARRAY(const double, weights_u, TILE_NODES, columns);
    ARRAY(const double, nodes, TILE_NODES, TILE_NODES, 3);
    ARRAY(const double, rays, ray_rows, columns, 3);
    int64_t rows, columns, per_pixel, ray_rows;
} tile_t;

/* A rectangle in space (rigkit.synthetic.raycast.Surface): its lower and upper ends in squares, the numbers of inner corners
 * (0 without squares), black rectangles in squares, discs in mm, and the lower and upper ends of the ground of white discs. */
typedef struct {
    ARRAY(const double, plane_from_ray, 3, 3);
    ARRAY(const double, ends, 2, 2);
    ARRAY(const double, marks, mark_count, 4);
    ARRAY(const double, discs, disc_count, 3);
    ARRAY(const double, ground, grounds, 2, 2);
    int64_t columns, rows, first_black, mark_count, disc_count, grounds;
    double white, black, width_mm, height_mm;
} surface_t;

EXPORT int64_t tile_cover(const tile_t *tile, const surface_t *surface);
EXPORT int64_t paint_surface(ARRAY(float, fine, tile.rows, tile.columns), const tile_t *tile, const surface_t *surface);
EXPORT void reduce_tile(
    ARRAY(const float, fine, rows, columns), int64_t rows, int64_t columns, ARRAY(const float, kernel, length),
    int64_t length, int64_t per_pixel, SCRATCH(float, memory, columns), RESULT(float, out, height, width), int64_t height,
    int64_t width);

#endif
