"""Kernels that commands will need, slowest to compile first; a test holds the lists to what the commands call."""

from __future__ import annotations

RAYCAST = ("vvgt_cli.dvr.kernel:render_tiles", "vvgt_cli.dvr.bricks:_ranges", "vvgt_cli.dvr.contrast:_contrast")
LIGHT = ("vvgt_cli.dvr.lit:render_lit_tiles", "vvgt_cli.vbm.lit:_shade", "vvgt_cli.vbm.lit:point_normals")
ATTENUATED = ("vvgt_cli.dvr.shadows:mean_transmittance", "vvgt_cli.dvr.shadows:cell_extinction")
GRID = {
    "vvgt_cli.dvr.kernel:render_tiles": "vvgt_cli.dvr.grid:render_grid_tiles",
    "vvgt_cli.dvr.lit:render_lit_tiles": "vvgt_cli.dvr.grid:render_lit_grid_tiles",
    "vvgt_cli.vbm.quadrature:block_moments": "vvgt_cli.vbm.grid:grid_moments",
}
DRAW = (
    "vvgt_cli.splat.kernel:tile_lists",
    "vvgt_cli.splat.tiles:blend",
    "vvgt_cli.splat.kernel:project",
    "vvgt_cli.splat.kernel:stable_order",
)
CLOSED_FORM = (
    "vvgt_cli.vbm.visibility:march",
    "vvgt_cli.vbm.quadrature:block_moments",
    "vvgt_cli.vbm.quadrature:compact",
    "vvgt_cli.vbm.pyramid:look_up",
    "vvgt_cli.vbm.pyramid:morton_codes",
    "vvgt_cli.vbm.pyramid:take_base",
    "vvgt_cli.vbm.pyramid:sum_children",
    "vvgt_cli.vbm.pyramid:score_splits",
    "vvgt_cli.vbm.pyramid:principal_axes",
    "vvgt_cli.vbm.sharpen:mix_neighbours",
    "vvgt_cli.vbm.inset:_shift",
    "vvgt_cli.vbm.inset:_blur",
)
SLOPES = (
    "vvgt_cli.splat.backward:moments",
    "vvgt_cli.splat.backward:own_frame",
    "vvgt_cli.splat.kernel:project_factors",
)
REFINE = (
    "vvgt_cli.descent.steps:own_frame",
    *SLOPES,
    "vvgt_cli.descent.loss:loss_gradient",
    "vvgt_cli.descent.ssim:blur",
)
SHARED = (
    "vvgt_cli.descent.steps:regress",
    "vvgt_cli.vbm.sharpen:mix_neighbours",
    "vvgt_cli.vbm.pyramid:morton_codes",
)  # of runs of more than a few Gaussians
HARMONICS = ("vvgt_cli.splat.harmonics:view_slopes", "vvgt_cli.splat.harmonics:view_colors")
STEPPED = ("vvgt_cli.descent.steps:adam",)  # harmonics, in a run whose other steps are in the own frame
DEPOSITS = ("vvgt_cli.splat.harmonics:deposit_squares", "vvgt_cli.splat.harmonics:deposit")
BACK_PROJECT = ("vvgt_cli.splat.tiles:gather", "vvgt_cli.splat.tiles:reduce_pairs")

VIEWS = (*RAYCAST, *CLOSED_FORM[:-2])  # and points to start from
INIT = (*CLOSED_FORM, "vvgt_cli.dvr.bricks:_ranges")
MERGE = (*(name for name in CLOSED_FORM if "block_moments" not in name and "compact" not in name), *DRAW)
COUNT_WHOLE = ("vvgt_cli.volume.count_kernel:count_values",)  # of types of which every number is counted
COUNT_REAL = ("vvgt_cli.volume.count_kernel:range_values", "vvgt_cli.volume.count_kernel:bin_values")  # of others
SEGMENTS = {
    "vvgt_cli.dvr.kernel:render_tiles": "vvgt_cli.dvr.segments:cast_segments",
    "vvgt_cli.dvr.lit:render_lit_tiles": "vvgt_cli.dvr.segments:cast_lit_segments",
    "vvgt_cli.dvr.grid:render_grid_tiles": "vvgt_cli.dvr.segments:cast_grid_segments",
    "vvgt_cli.dvr.grid:render_lit_grid_tiles": "vvgt_cli.dvr.segments:cast_lit_grid_segments",
}
RANGES = "vvgt_cli.vbm.ranges:block_ranges"  # of blocks of which not all is read
CONVERT = (RAYCAST[0], REFINE[0], *CLOSED_FORM, *DRAW, *REFINE[1:], SHARED[0], *RAYCAST[1:], *BACK_PROJECT)
OPTIMIZE = (*REFINE, *DRAW, "vvgt_cli.vbm.pyramid:principal_axes", *SHARED)
EVALUATE = (*RAYCAST, *DRAW)
INFER = (*DRAW, SLOPES[0], "vvgt_cli.splat.backward:standard", *BACK_PROJECT)
ALL = (
    *CONVERT,
    *LIGHT,
    *ATTENUATED,
    *GRID.values(),
    "vvgt_cli.dvr.place:place",
    "vvgt_cli.splat.backward:standard",
    *HARMONICS,
    *STEPPED,
    *DEPOSITS,
    *SEGMENTS.values(),
    RANGES,
    *COUNT_WHOLE,
    *COUNT_REAL,
    "vvgt_cli.volume.slc_kernel:decode_plane",
)


def for_light(names: tuple[str, ...], attenuated: bool) -> tuple[str, ...]:
    """Kernels of a command whose scene is lit, ``attenuated`` by shadows or occlusion: others follow the rays."""
    rays = tuple(LIGHT[0] if name == RAYCAST[0] else name for name in names)
    shaded = LIGHT[1:] if CLOSED_FORM[0] in names else ()
    return (*rays, *shaded, *(ATTENUATED if attenuated else ()))


def for_degree(names: tuple[str, ...], degree: int) -> tuple[str, ...]:
    """Kernels of a command that meets Gaussians with harmonics of a degree: more, where that is above 0."""
    if not degree:
        return names
    stepped = STEPPED if REFINE[0] in names else ()
    return (*names, *(HARMONICS if SLOPES[0] in names else HARMONICS[1:]), *stepped)


def for_grid(names: tuple[str, ...]) -> tuple[str, ...]:
    """Kernels of a command whose scene is an optics grid."""
    return tuple(GRID.get(name, name) for name in names)


def for_blocks(names: tuple[str, ...]) -> tuple[str, ...]:
    """Kernels of a command whose volume is gone through in blocks."""
    return (*(SEGMENTS.get(name, name) for name in names), RANGES)
