"""Save Selected Layers as Gaussian splats in napari: image and labels layers, in their colours and places.

Image layers have the opacity of their colour map; where it has none, of their intensity within the contrast limits,
with gamma, as napari's views by maximum or sum have no other. Several layers are drawn together, and a first axis of
four is time.

Tried: napari 0.9.2
Enable:
    Install vvgt beside napari: File > Save Selected Layers offers Gaussian splats (.html, .splats.ply, ...).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from napari import current_viewer
from napari.layers import Layer
from napari.utils.notifications import show_warning

from vvgt_cli.commands.session import read_volume
from vvgt_cli.conversion.clouds import Cloud, Clouds
from vvgt_cli.errors import UsageError
from vvgt_cli.field.layered import OpenedFile
from vvgt_cli.integrations.layers import together
from vvgt_cli.library.inputs import Look

NODES = 256  # of a colour map, which may have steps
STEP = 0.8  # voxels between samples of napari's translucent rendering
BY_DEPTH = ("translucent", "translucent_no_depth", "opaque")


def write(path: str, layers: Sequence[tuple[Any, dict[str, Any], str]]) -> list[str]:
    """Write the visible layers among ``layers`` (data, attributes, kind) to a page or file; return its path.

    Warnings name what is drawn otherwise, in the window where there is one.

    Raises:
        UsageError: none is visible, or one has no three axes in space; napari passes over a ValueError.
        VvgtError: see `vvgt_cli.convert`.
    """
    shown = [layer for layer in (Layer.create(*one) for one in layers) if layer.visible]
    if not shown:
        raise UsageError("no visible layer; show one of those that are saved")
    timed = {(len(v), x.scale[0], x.translate[0]) for x in shown if (v := _values(x)).ndim == 4 and len(v) > 1}
    if len(timed) > 1:
        raise UsageError("layers whose time axes differ; expected the same steps of all, or save them one by one")
    lost = [f"{layer.name}: {', '.join(notes)}" for layer in shown if (notes := _lost(layer, len(shown) > 1))]
    said = [f"not taken from the layers: {'; '.join(lost)}"] if lost else []
    window = current_viewer()
    if window is not None and window.dims.ndisplay == 3 and str(window.camera.handedness) == "right":
        said.append("napari's 3D view is a mirror image of x, y, z (its depth points to you); the file is not mirrored")
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        results = [_converted(shown, step) for step in range(max((n for n, *_ in timed), default=1))]
    for text in dict.fromkeys([*said, *(str(one.message) for one in heard if one.category is UserWarning)]):
        if window is None:
            warnings.warn(text, stacklevel=2)
        else:  # its dialog keeps Python's warnings to itself
            show_warning(text)
    if len(results) == 1:
        results[0].save(path)
        return [path]
    clouds = [
        Cloud(one.gaussians, one.report, one.ply, f"{k}", f"{k:04d}", {"frame": k}, one.normals())
        for k, one in enumerate(results)
    ]
    suffix = Path(path).suffix
    pattern = path if suffix == ".html" else f"{path.removesuffix(suffix)}_{{:04d}}{suffix}"
    Clouds("frames", shown[0].name, clouds).save(pattern)
    return list(dict.fromkeys(pattern.format(k) for k in range(len(results))))


def _converted(layers: Sequence[Any], step: int) -> Any:
    """Convert a time step of all layers, unlit: napari's views of images have no light."""
    volumes = [_volume(layer, step) for layer in layers]
    return together([(OpenedFile((v,)), _look(layer, v)) for layer, v in zip(layers, volumes, strict=True)], "none")


def _lost(layer: Any, layered: bool) -> list[str]:
    """Return notes on how napari draws a layer, one of ``layered`` or not, and its Gaussians do not."""
    own, scale = type(layer).__name__ != "Labels" and _colors(layer)[2], np.abs(layer.scale[-3:])
    lost = {
        f"blending {layer.blending} (mixed by depth instead)": layered and layer.blending not in BY_DEPTH,
        "the layer's opacity of a whole pixel (of each sample instead)": own and layer.opacity < 1,
        "opacity by voxels, which are uneven (by length instead)": own and scale.max() > 1.01 * scale.min(),
        f"rendering {layer.rendering} (translucent instead)": layer.rendering not in ("translucent", "iso_categorical"),
        "nearest-neighbour interpolation (linear instead)": getattr(layer, "interpolation3d", "") == "nearest",
        "one plane (all instead)": layer.depiction != "volume",
        "clipping planes": any(plane.enabled for plane in layer.experimental_clipping_planes),
        "colour of NaN (clear instead)": hasattr(layer.colormap, "nan_color") and bool(layer.colormap.nan_color[3]),
    }
    return [note for note, applies in lost.items() if applies]


def _values(layer: Any) -> Any:
    values = layer.data[0] if layer.multiscale else layer.data
    if values.ndim not in (3, 4) or getattr(layer, "rgb", False):
        what = "an RGB image" if getattr(layer, "rgb", False) else f"{values.ndim} axes"
        raise UsageError(f"{layer.name}: {what}; expected z, y, x, or time before them (split RGB into channels)")
    return values


def _volume(layer: Any, step: int) -> Any:
    """Return the volume of a layer at a time step, placed by its scale, turn, shear, shift and affine."""
    values = _values(layer)
    lead = values.ndim - 3
    place = [np.array(layer.data_to_world([0] * lead + row)) for row in [[0, 0, 0], *np.eye(3, dtype=int).tolist()]]
    units = layer.units[lead:]
    lengths = [float((1 * unit).to(units[-1]).magnitude) for unit in units]  # axes may have different ones
    affine = np.eye(4)
    affine[:3, 3] = (place[0][lead:] * lengths)[::-1]
    affine[:3, :3] = (np.array([(p - place[0])[lead:] * lengths for p in place[1:]])[::-1, ::-1]).T
    unit = f"{units[-1]:~}".replace("µ", "u").replace("px", "").replace("pixel", "")
    data = values[min(step, len(values) - 1)] if lead else values
    return replace(read_volume(data, affine=affine), unit=unit, name=layer.name)


def _look(layer: Any, volume: Any) -> Look:
    """Return the colours and opacity of a layer, that of its colour map a sample where it has any."""
    if type(layer).__name__ == "Labels":
        names = (
            dict(zip(layer.features["index"], layer.features["name"], strict=True)) if "name" in layer.features else {}
        )
        table = {}
        for number in np.unique(_values(layer)):
            if number and (color := layer.get_color(number)) is not None:
                name, alpha = str(names.get(number, number)), float(color[3] * layer.opacity)
                table[int(number)] = {"name": name, "color": color[:3].tolist(), "opacity": alpha}
        return Look(labels=table)
    low, high = layer.contrast_limits
    share, colors, own = _colors(layer)
    opacity = colors[:, 3] * layer.opacity * (1 if own else share**layer.gamma)
    columns = low + share * (high - low), colors[:, :3].tolist(), opacity
    points = [{"x": x, "rgb": rgb, "opacity": float(a)} for x, rgb, a in zip(*columns, strict=True)]
    coarse = layer.downsample_factors[-1][-3:][::-1] if layer.multiscale else 1  # in 3D napari shows the coarsest level
    unit = {"opacity_unit_distance": STEP * float(np.mean(np.multiply(volume.spacing, coarse)))} if own else {}
    return Look({"name": layer.name, "points": points, **unit})


def _colors(layer: Any) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return shares (n,) of the contrast limits, RGBA (n, 4) there, and whether opacity is the colour map's."""
    share = np.array([0, *np.linspace(1e-6, 1 - 1e-6, NODES), 1])  # at the ends a map may have colours of their own
    colors = layer.colormap.map(share**layer.gamma)
    inner = colors if layer.rendering == "translucent" else colors[1:-1]  # elsewhere a clear end hides nothing else
    return share, colors, bool((inner[:, 3] < 1).any())
