"""OpenUSD's `ParticleField3DGaussianSplat` (OpenUSD 26.3 or newer) through usd-core: float32, without quantisation.

The data are those of the `.ply`, in its axes. The prim is rotated by 180 degrees about z, to the stage's +y up, and
placed in the world in metres, where that is known.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.metres import placed, same_place
from vvgt_cli.gaussians.formats.splats import DEGREES, Splats, logits_of, opacities_of
from vvgt_cli.volume.libraries import library_errors, need

KIND = "ParticleField3DGaussianSplat"
_SINCE = (0, 26, 3)
_SEEN = 3.0  # standard deviations around the centres that the extent includes
_COMMENTS = "vvgtComments"  # in the layer's custom data, one per line


def library(source: str) -> Any:
    """Return the module `pxr.Usd`.

    Raises:
        DataError: the module is not installed, or too old for Gaussians.
    """
    usd = need("pxr.Usd", "share", source, ".usdc")
    if usd.GetVersion() < _SINCE:
        version = ".".join(map(str, usd.GetVersion()[1:]))
        raise DataError(f"{source}: OpenUSD {version} does not support {KIND}; try: pip install 'usd-core>=26.3'")
    return usd


def usdc(splats: Splats, name: str) -> bytes:
    """Encode columns as a `.usdc` with one prim, /Splats."""
    usd = library(name)
    from pxr import Gf, Sdf, UsdGeom, UsdVol, Vt

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.usdc"
        stage = usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, Sdf.Path("/Splats"))
        prim = field.GetPrim()
        stage.SetDefaultPrim(prim)
        stage.GetRootLayer().customLayerData = {_COMMENTS: "\n".join(splats.comments)}
        place, xform = placed(splats.comments, name), UsdGeom.Xformable(prim)
        if place.world is not None:
            xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*place.translation.tolist()))
        xform.AddRotateZOp().Set(180.0)
        if place.world is not None:
            xform.AddScaleOp().Set(Gf.Vec3f(place.scale))
            world = Gf.Matrix4d(*place.world.T.ravel().tolist())  # USD uses row vectors
            prim.SetCustomData({"space": place.space, "unit": place.unit, "worldFromScene": world})
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
        }
        for attribute, value in values.items():
            if not prim.GetAttribute(attribute).Set(value):
                raise DataError(f"{name}: OpenUSD does not accept {attribute} of a {KIND}")
        stage.GetRootLayer().Save()
        return path.read_bytes()


def _plain(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)


def read_usdc(content: bytes, name: str) -> Splats:
    """Read the columns of a `.usdc` as written by `usdc`.

    Raises:
        DataError: the file is not such a stage, or OpenUSD is not installed.
    """
    usd = library(name)
    with library_errors(name, f"a {KIND}"), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "in.usdc"
        path.write_bytes(content)
        return _read(usd.Stage.Open(str(path)), name)


def _read(stage: Any, name: str) -> Splats:
    from pxr import UsdGeom

    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == KIND]
    if len(prims) != 1:
        raise DataError(f"{name}: {len(prims)} prims of type {KIND}; expected one")
    (prim,) = prims
    comments = tuple(str(stage.GetRootLayer().customLayerData.get(_COMMENTS, "")).splitlines())
    same_place(np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0)).T, comments, name)

    def values(attribute: str) -> np.ndarray:
        return np.array(prim.GetAttribute(attribute).Get(), np.float32)

    means, scales = values("positions"), values("scales")
    harmonics = values("radiance:sphericalHarmonicsCoefficients").reshape(len(means), -1, 3)
    with np.errstate(divide="ignore"):
        log_scales = np.maximum(np.log(scales.astype(np.float64)), -80)
    return Splats(
        means,
        log_scales.astype(np.float32),
        values("orientations")[:, [3, 0, 1, 2]],
        logits_of(values("opacities")),
        np.ascontiguousarray(harmonics[:, 0]),
        np.ascontiguousarray(harmonics[:, 1:]),
        comments,
    )
