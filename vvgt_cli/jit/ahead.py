"""Kernels that commands will need, slowest to compile first; a test holds the lists to what the commands call."""

from __future__ import annotations

RENDER, RENDER_LIT = "vvgt_cli.dvr.march:render_tiles", "vvgt_cli.dvr.march:render_lit_tiles"
BLOCK_RANGES = "vvgt_cli.dvr.bricks:block_ranges"
SHADE = ("vvgt_cli.closed_form.lit:_shade", "vvgt_cli.closed_form.lit:point_normals")
PATHS = ("vvgt_cli.dvr.paths:gather", "vvgt_cli.dvr.paths:first_scatterings")
MARCH, ADD_CELLS = "vvgt_cli.closed_form.visibility:march", "vvgt_cli.closed_form.visibility:add_cells"
BLOCK_MOMENTS, COMPACT = "vvgt_cli.closed_form.quadrature:block_moments", "vvgt_cli.closed_form.quadrature:compact"
VOXEL_MOMENTS = "vvgt_cli.closed_form.voxelwise:voxel_moments"  # of cells wider than voxels
MORTON, MIX = "vvgt_cli.closed_form.cell_kernels:morton_codes", "vvgt_cli.closed_form.sharpen:mix_neighbours"
AXES_STEPS = "vvgt_cli.refine.steps:own_axes"
REGRESS = tuple(f"vvgt_cli.refine.steps:{name}" for name in ("adam_sizes", "adam_directions", "regress"))
PAIR_SUMS, EXACT_AXES = "vvgt_cli.splat.backward:pair_sums", "vvgt_cli.splat.backward:exact_axes"
VIEW_SLOPES, VIEW_COLORS = "vvgt_cli.splat.harmonics:view_slopes", "vvgt_cli.splat.harmonics:view_colors"
FIELD_STEPS = "vvgt_cli.refine.steps:adam"  # harmonics take them even where all else steps along own axes

RAYCAST_REST = (BLOCK_RANGES, "vvgt_cli.dvr.contrast:_contrast")
RAYCAST = (RENDER, *RAYCAST_REST)
GRID = {
    RENDER: "vvgt_cli.dvr.march:render_grid_tiles",
    RENDER_LIT: "vvgt_cli.dvr.march:render_lit_grid_tiles",
    BLOCK_MOMENTS: "vvgt_cli.closed_form.quadrature:grid_moments",
    PATHS[0]: "vvgt_cli.dvr.paths:gather_grid",
}
MIXED = {
    **GRID,
    RENDER: "vvgt_cli.dvr.march:render_mixed_tiles",
    RENDER_LIT: "vvgt_cli.dvr.march:render_lit_mixed_tiles",
}
DRAW = (
    *(f"vvgt_cli.splat.kernel:{name}" for name in ("count_pairs", "sum_pairs", "file_pairs")),
    "vvgt_cli.splat.tiles:blend",
    "vvgt_cli.splat.kernel:project",
    "vvgt_cli.splat.kernel:stable_order",
)
GREY = (*(name for name in DRAW if not name.endswith(":blend")), "vvgt_cli.splat.grey:accumulate")
GREATEST = ("vvgt_cli.dvr.march:greatest",)
CELLS = (
    MARCH,
    ADD_CELLS,
    BLOCK_MOMENTS,
    COMPACT,
    "vvgt_cli.closed_form.cell_kernels:look_up",
    MORTON,
    "vvgt_cli.closed_form.cell_kernels:take_base",
    "vvgt_cli.closed_form.cell_kernels:sum_children",
    "vvgt_cli.closed_form.cell_kernels:score_splits",
    "vvgt_cli.closed_form.cell_kernels:principal_axes",
    MIX,
)
CLOSED_FORM = (*CELLS, *(f"vvgt_cli.closed_form.surface_offset:{name}" for name in ("_shift", "_blur", "_flatten")))
DESCENT = (
    PAIR_SUMS,
    "vvgt_cli.splat.backward:own_axes",
    "vvgt_cli.splat.kernel:project_factors",
    *(f"vvgt_cli.refine.loss:{name}" for name in ("loss_gradient", "blur", "part_planes", "weigh", "add_fine")),
)
REFINE = (AXES_STEPS, *DESCENT)
SHARED = (*REGRESS, MIX, MORTON)  # of runs of more than a few Gaussians
DEPOSITS = ("vvgt_cli.splat.harmonics:deposit_squares", "vvgt_cli.splat.harmonics:deposit")
BACK_PROJECT = ("vvgt_cli.splat.tiles:gather", "vvgt_cli.splat.tiles:reduce_pairs")

VIEWS = (*RAYCAST, *CELLS, VOXEL_MOMENTS)  # and points to start from, of cells of voxels or wider ones
INIT = (*CLOSED_FORM, BLOCK_RANGES)
MERGE = (*(name for name in CLOSED_FORM if name not in (BLOCK_MOMENTS, COMPACT)), *DRAW)
COUNT_WHOLE = ("vvgt_cli.volume.count_kernel:count_values",)  # of types of which every number is counted
COUNT_REAL = ("vvgt_cli.volume.count_kernel:range_values", "vvgt_cli.volume.count_kernel:bin_values")  # of others
SEGMENTS = {
    RENDER: "vvgt_cli.dvr.march:cast_segments",
    RENDER_LIT: "vvgt_cli.dvr.march:cast_lit_segments",
    GRID[RENDER]: "vvgt_cli.dvr.march:cast_grid_segments",
    GRID[RENDER_LIT]: "vvgt_cli.dvr.march:cast_lit_grid_segments",
    MIXED[RENDER]: "vvgt_cli.dvr.march:cast_mixed_segments",
    MIXED[RENDER_LIT]: "vvgt_cli.dvr.march:cast_lit_mixed_segments",
}
CONVERT = (RENDER, AXES_STEPS, *CLOSED_FORM, *DRAW, *DESCENT, *REGRESS, *RAYCAST_REST, *BACK_PROJECT)
LIVE = ("vvgt_cli.closed_form.gaussian_samples:sample_points",)
VOXELIZE = ("vvgt_cli.closed_form.values_back:deposit", "vvgt_cli.closed_form.values_back:sample")
OPTIMIZE = (*REFINE, *DRAW, "vvgt_cli.closed_form.cell_kernels:principal_axes", *SHARED)
EVALUATE = (*RAYCAST, *DRAW)
INFER = (*DRAW, PAIR_SUMS, EXACT_AXES, *BACK_PROJECT)
ALL = (
    *CONVERT,
    *GREATEST,
    GREY[-1],
    RENDER_LIT,
    *SHADE,
    *PATHS,
    *GRID.values(),
    MIXED[RENDER],
    MIXED[RENDER_LIT],
    "vvgt_cli.dvr.place:place",
    EXACT_AXES,
    VIEW_SLOPES,
    VIEW_COLORS,
    FIELD_STEPS,
    *DEPOSITS,
    *SEGMENTS.values(),
    *LIVE,
    *VOXELIZE,
    VOXEL_MOMENTS,
    *COUNT_WHOLE,
    *COUNT_REAL,
    "vvgt_cli.volume.plain.run_lengths:decode_runs",
    "vvgt_cli.gaussians.formats.codebook_kernels:cut_clusters",
    "vvgt_cli.gaussians.formats.codebook_kernels:divide",
)


def for_light(names: tuple[str, ...], sky: bool) -> tuple[str, ...]:
    """Return the kernels of a command whose scene is lit, by a ``sky`` or else."""
    rays = tuple(RENDER_LIT if name == RENDER else name for name in names)
    return (*rays, *(SHADE if MARCH in names else ()), *(PATHS if sky else ()))


def for_degree(names: tuple[str, ...], degree: int) -> tuple[str, ...]:
    """Return the kernels of a command for Gaussians with harmonics of ``degree``: above 0 it needs more."""
    if not degree:
        return names
    slopes = [VIEW_SLOPES] if PAIR_SUMS in names else []
    return (*names, *slopes, VIEW_COLORS, *([FIELD_STEPS] if AXES_STEPS in names else []))


def for_grid(names: tuple[str, ...], mixed: bool) -> tuple[str, ...]:
    """Return the kernels of a command whose scene is an optics grid, ``mixed`` with layers of scalars or not."""
    return tuple((MIXED if mixed else GRID).get(name, name) for name in names)


def for_blocks(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the kernels of a command that reads its volume in blocks."""
    return (*(SEGMENTS.get(name, name) for name in names), BLOCK_RANGES)
