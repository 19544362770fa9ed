"""OpenUSD's `ParticleField3DGaussianSplat` (OpenUSD 26.3 or newer) through usd-core: float32, without quantisation.

The data are those of the `.ply`, in its axes. The root prim is rotated by 180 degrees about z, to the stage's +y up,
and placed in the world in metres, where that is known. Several clouds are prims below it, in groups.
"""

from __future__ import annotations

import io
import struct
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.nodes import ROOT, Node, common_comments, group_names, offset_in, placed, report_off
from vvgt_cli.gaussians.formats.splats import DEGREES, Splats, joined, log_scales_of, opacities_of
from vvgt_cli.gaussians.header import facts_in
from vvgt_cli.gaussians.opacity import logits_of
from vvgt_cli.volume.libraries import library_errors, need

KIND = "ParticleField3DGaussianSplat"
_SINCE = (0, 26, 3)
_SEEN = 3.0  # standard deviations around the centres that the extent includes
_COMMENTS = "vvgtComments"  # in the layer's custom data, one per line
_ZIP_HEADER, _ALIGNED, _PADDING = 30, 64, 0x1986  # bytes of a local header, of a .usdz; its extra field that pads


def library(source: str) -> Any:
    """Return the module `pxr.Usd`; raise DataError if it is not installed, or too old for Gaussians."""
    usd = need("pxr.Usd", "share", source, ".usdc")
    if usd.GetVersion() < _SINCE:
        version = ".".join(map(str, usd.GetVersion()[1:]))
        raise DataError(f"{source}: OpenUSD {version} does not support {KIND}; try: pip install 'usd-core>=26.3'")
    return usd


def usdz(nodes: Sequence[Node], name: str) -> bytes:
    """Encode clouds as a `.usdz`, a zip of the `.usdc`, stored at a multiple of 64 bytes (specification 1.3)."""
    stream, entry = io.BytesIO(), zipfile.ZipInfo("splats.usdc")
    size = -(_ZIP_HEADER + len(entry.filename) + 4) % _ALIGNED
    entry.extra = struct.pack("<2H", _PADDING, size) + bytes(size)
    with zipfile.ZipFile(stream, "w") as package:
        package.writestr(entry, usdc(nodes, name))
    return stream.getvalue()


def usdc(nodes: Sequence[Node], name: str) -> bytes:
    """Encode clouds as a `.usdc` with a prim each, in groups, below /Splats, which is a cloud without a name itself."""
    usd, comments = library(name), common_comments(nodes)
    from pxr import Gf, Sdf, UsdGeom

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.usdc"
        stage = usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.GetRootLayer().customLayerData = {_COMMENTS: "\n".join(comments)}
        kind = KIND if not nodes[0].name else "Xform"
        prims: dict[tuple[str, ...], Any] = {(): stage.DefinePrim(Sdf.Path(f"/{ROOT}"), kind)}
        stage.SetDefaultPrim(prims[()])
        _place(prims[()], comments, name)
        for group, shown in group_names(nodes).items():
            prims[group] = _below(prims[group[:-1]], shown, "Xform")
        for node in nodes:
            prim, splats = prims[()], node.splats
            if node.name:
                prim = _below(prims[node.parents], node.name, KIND)
                centre, splats = node.centred()
                move = UsdGeom.Xformable(prim).AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
                move.Set(Gf.Vec3d(*centre.tolist()))
            _put(prim, splats, comments, name)
            if node.facts:
                prim.SetCustomData({key: _custom(value) for key, value in node.facts.items()})
            if not node.visible:
                UsdGeom.Imageable(prim).MakeInvisible()
        stage.GetRootLayer().Save()
        return path.read_bytes()


def _place(prim: Any, comments: tuple[str, ...], name: str) -> None:
    """Rotate the root by half a turn, and place it in the world, where that is known."""
    from pxr import Gf, UsdGeom

    place, xform = placed(comments, name), UsdGeom.Xformable(prim)
    if place.world is not None:
        xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*place.translation.tolist()))
    xform.AddRotateZOp().Set(180.0)
    if place.world is not None:
        xform.AddScaleOp().Set(Gf.Vec3f(place.scale))
        world = Gf.Matrix4d(*place.world.T.ravel().tolist())  # USD uses row vectors
        prim.SetCustomData({"space": place.space, "unit": place.unit, "worldFromScene": world})


def _below(parent: Any, name: str, kind: str) -> Any:
    """Define a prim below another, with ``name`` as the name that is displayed."""
    from pxr import Tf

    identifier = Tf.MakeValidIdentifier(name)
    while parent.GetChild(identifier):
        identifier += "_"
    prim = parent.GetStage().DefinePrim(parent.GetPath().AppendChild(identifier), kind)
    prim.SetDisplayName(name)
    return prim


def _custom(value: Any) -> Any:
    """Return a value as USD keeps it in custom data: three numbers as a vector, several such as an array."""
    from pxr import Gf, Vt

    if isinstance(value, Mapping):
        return {key: _custom(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return Vt.Vec3dArray([Gf.Vec3d(*row) for row in value]) if np.ndim(value) == 2 else Gf.Vec3d(*value)
    return value


def _put(prim: Any, splats: Splats, comments: tuple[str, ...], name: str) -> None:
    """Set the attributes of a prim of Gaussians, sorted and projected as by the rule that ``comments`` record."""
    from pxr import Gf, Usd, Vt

    scales = np.exp(splats.log_scales.astype(np.float64)).astype(np.float32)
    harmonics = np.concatenate([splats.f_dc[:, None], splats.f_rest], axis=1)
    reach = _SEEN * scales.max(axis=1, keepdims=True)
    corners = np.stack([(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)])
    values = {  # USD stores quaternions with w last
        "positions": Vt.Vec3fArray.FromNumpy(_plain(splats.means)),
        "orientations": Vt.QuatfArray.FromNumpy(_plain(splats.quaternions[:, [1, 2, 3, 0]])),
        "scales": Vt.Vec3fArray.FromNumpy(_plain(scales)),
        "opacities": Vt.FloatArray.FromNumpy(_plain(opacities_of(splats.logits))),
        "radiance:sphericalHarmonicsDegree": DEGREES[splats.f_rest.shape[1]],
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(_plain(harmonics.reshape(-1, 3))),
        "extent": Vt.Vec3fArray.FromNumpy(_plain(corners)),
        "sortingModeHint": "cameraDistance" if facts_in(list(comments), name).get("rule") == "spark" else "zDepth",
        "projectionModeHint": "perspective",
    }
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)  # blended as stored
    for attribute, value in values.items():
        if not prim.GetAttribute(attribute).Set(value):
            raise DataError(f"{name}: OpenUSD does not accept {attribute} of a {KIND}")


def _plain(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)


def read_usd(content: bytes, name: str) -> Splats:
    """Read the columns of a `.usdc` or `.usdz` as `usdc` writes, all prims together, or raise DataError."""
    usd = library(name)
    from pxr import UsdGeom

    with library_errors(name, f"a {KIND}"), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("in.usdz" if content.startswith(b"PK") else "in.usdc")
        path.write_bytes(content)
        stage = usd.Stage.Open(str(path))
        comments = tuple(str(stage.GetRootLayer().customLayerData.get(_COMMENTS, "")).splitlines())
        prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == KIND]
        if not prims:
            raise DataError(f"{name}: no prim of type {KIND}; expected one or more")
        invisible = [prim for prim in prims if UsdGeom.Imageable(prim).ComputeVisibility() == UsdGeom.Tokens.invisible]
        report_off(name, [prim.GetDisplayName() or prim.GetName() for prim in invisible])
        return joined([_columns(prim, comments, name) for prim in prims])


def _columns(prim: Any, comments: tuple[str, ...], name: str) -> Splats:
    """Return the Gaussians of a prim."""
    from pxr import UsdGeom

    root = prim.GetStage().GetPrimAtPath(prim.GetPath().GetPrefixes()[0])
    above, place = (np.array(UsdGeom.Xformable(one).ComputeLocalToWorldTransform(0.0)).T for one in (root, prim))
    offset = offset_in(above, place, comments, name)

    def values(attribute: str) -> np.ndarray:
        return np.array(prim.GetAttribute(attribute).Get(), np.float32)

    means = values("positions")
    harmonics = values("radiance:sphericalHarmonicsCoefficients").reshape(len(means), -1, 3)
    return Splats(
        means,
        log_scales_of(values("scales")),
        values("orientations")[:, [3, 0, 1, 2]],
        logits_of(values("opacities")),
        np.ascontiguousarray(harmonics[:, 0]),
        np.ascontiguousarray(harmonics[:, 1:]),
        comments,
    ).moved(offset)
