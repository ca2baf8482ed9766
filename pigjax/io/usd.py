"""OpenUSD (`.usd`, `.usda`, `.usdc`): Gaussians over time as ParticleField3DGaussianSplat, by the package usd-core."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.core.gaussians import Gaussians, Splats
from pigjax.core.harmonics import sh_degree_of
from pigjax.core.placing import as_gaussians
from pigjax.io.files import PathLike, decoding, existing, writing
from pigjax.io.origin import Origin, checked_origin
from pigjax.io.ply import fields_of

SUFFIXES = (".usd", ".usda", ".usdc")
_PLACE = "/Scene/Splats"
_CUT = 3.0  # standard deviations to which the extent reaches
_LEAST_SCALE, _LEAST_OPACITY = 1e-30, 1e-37


@checked
def save_usd(
    path: PathLike,
    frames: Iterable[Gaussians | Splats],
    *,
    fps: float | int = 24,
    up: str = "Z",
    origin: Origin | None = None,
) -> None:
    """Write Gaussians over time as OpenUSD's ParticleField3DGaussianSplat with a time sample for each frame. Host.

    Lengths are in m. What no frame changes is written once. Needs usd-core: `pip install 'pigjax[usd]'`.

    Args:
        path: `.usd` or `.usdc` (binary), or `.usda` (text).
        frames: the scene of each frame, Gaussians or posed splats, all of one count; a generator keeps memory small.
        fps: frames a second.
        up: axis that points up, "Y" or "Z", the two that USD knows.
        origin: offset that `load_gaussians` subtracted [m]; it becomes a translation of the prim.

    Raises:
        InputError: usd-core is missing, the suffix or `up` is another one, there are no frames, their counts differ, or
            the file cannot be written.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown suffix of USD {Path(path).suffix!r}; use .usdc or .usda.")
    if up not in ("Y", "Z"):
        raise InputError(f"{path}: up = {up!r}: USD knows Y and Z; turn the scene by placed first.")
    pxr = _pxr(path)
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, up)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(float(fps))
    stage.SetFramesPerSecond(float(fps))
    stage.SetDefaultPrim(pxr.UsdGeom.Xform.Define(stage, "/Scene").GetPrim())
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, _PLACE)
    if origin is not None:
        field.AddTranslateOp().Set(pxr.Gf.Vec3d(*checked_origin(origin).tolist()))
    field.CreateProjectionModeHintAttr("perspective")
    field.CreateSortingModeHintAttr("cameraDistance")
    before: dict[str, np.ndarray] = {}
    count = 0
    for count, frame in enumerate(frames, 1):
        columns = _columns(as_gaussians(frame), before.get("orientations"))
        if before and any(len(before[name]) != len(values) for name, values in columns.items()):
            raise InputError(f"{path}: frame {count - 1} has another number of splats or coefficients than the first.")
        _sample(pxr, field, columns, before, count - 1)
        before = columns
    if not count:
        raise InputError(f"{path}: no frames were given; give at least one.")
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(float(count - 1))
    with writing(path) as partial:
        try:
            stage.GetRootLayer().Export(str(partial))
        except pxr.Tf.ErrorException as error:
            raise OSError(f"USD: {str(error).splitlines()[0]}") from None


def _columns(gaussians: Gaussians, before: np.ndarray | None) -> dict[str, np.ndarray]:
    means = np.asarray(gaussians.means, np.float32)
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64)).astype(np.float32)
    quats = np.asarray(gaussians.quats, np.float32)
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    if before is not None and len(before) == len(quats):  # the same turn, nearest to the frame before
        quats = np.where((quats * before).sum(1, keepdims=True) < 0, -quats, quats)
    reach = _CUT * scales.max(1, keepdims=True)
    logits = np.asarray(gaussians.logit_opacities, np.float64)
    return {
        "positions": means,
        "scales": scales,
        "orientations": quats,
        "opacities": np.exp(-np.logaddexp(0, -logits)).astype(np.float32),
        "coefficients": np.asarray(gaussians.sh, np.float32).reshape(-1, 3),
        "extent": np.stack([(means - reach).min(0), (means + reach).max(0)]),
        "degree": np.asarray([sh_degree_of(gaussians)]),
    }


def _sample(pxr: Any, field: Any, columns: dict[str, np.ndarray], before: dict[str, np.ndarray], frame: int) -> None:
    """Add a time sample of what changed; a change after frames without one needs a sample just before it, too."""
    vt = pxr.Vt
    makers = {
        "positions": (field.GetPositionsAttr(), vt.Vec3fArray.FromNumpy),
        "scales": (field.GetScalesAttr(), vt.Vec3fArray.FromNumpy),
        # memory of quaternions: imaginary part first
        "orientations": (field.GetOrientationsAttr(), lambda quats: _quats(pxr, quats)),
        "opacities": (field.GetOpacitiesAttr(), vt.FloatArray.FromNumpy),
        "coefficients": (field.GetRadianceSphericalHarmonicsCoefficientsAttr(), vt.Vec3fArray.FromNumpy),
        "extent": (field.GetExtentAttr(), vt.Vec3fArray.FromNumpy),
    }
    if not before:
        field.GetRadianceSphericalHarmonicsDegreeAttr().Set(int(columns["degree"][0]))
        for name, (attribute, made) in makers.items():
            attribute.Set(made(np.ascontiguousarray(columns[name])))
        return
    for name, (attribute, made) in makers.items():
        if np.array_equal(columns[name], before[name]):
            continue
        times = attribute.GetTimeSamples()
        if not times:
            attribute.Set(attribute.Get(), 0.0)
        if frame - 1 > (times[-1] if times else 0):
            attribute.Set(made(np.ascontiguousarray(before[name])), float(frame - 1))
        attribute.Set(made(np.ascontiguousarray(columns[name])), float(frame))


def _quats(pxr: Any, quats: np.ndarray) -> Any:
    return pxr.Vt.QuatfArray.FromNumpy(np.ascontiguousarray(quats[:, [1, 2, 3, 0]]))


def read_usd(path: PathLike, *, frame: float | int | None = None) -> dict[str, np.ndarray]:
    """Columns of each field of the first ParticleField3DGaussianSplat of a USD file.

    Args:
        path: the file.
        frame: time code; None: the first.

    Raises:
        MissingFileError: there is no such file.
        InputError: usd-core is missing, the file is damaged or draws on other files, holds no such field, or its arrays
            do not fit.
    """
    path = existing(path, "file of Gaussians")
    pxr = _pxr(path)
    with decoding(path, "USD file", remedy="export it again"):
        layer = pxr.Sdf.Layer.FindOrOpen(str(path))
        if layer is None:
            raise ValueError("it is no layer")
        if others := layer.GetCompositionAssetDependencies():
            raise InputError(f"{path}: draws on other files ({others[0]}), which are not read; flatten it (usdcat -f).")
        stage = pxr.Usd.Stage.Open(layer)
        prim = next((p for p in stage.Traverse() if p.GetTypeName() == "ParticleField3DGaussianSplat"), None)
        if prim is None:
            raise InputError(f"{path}: holds no ParticleField3DGaussianSplat; give a USD file of Gaussians.")
        at = pxr.Usd.TimeCode(stage.GetStartTimeCode() if frame is None else float(frame))
        field = pxr.UsdVol.ParticleField3DGaussianSplat(prim)
        degree = int(field.GetRadianceSphericalHarmonicsDegreeAttr().Get(at))
        means = np.asarray(field.GetPositionsAttr().Get(at), np.float32)
        scales = np.asarray(field.GetScalesAttr().Get(at), np.float64)
        opacities = np.asarray(field.GetOpacitiesAttr().Get(at), np.float64)
        quats = np.asarray(field.GetOrientationsAttr().Get(at), np.float32)
        sh = np.asarray(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(at), np.float32)
        count, bands = len(means), (degree + 1) ** 2
        sh = sh.reshape(count, bands, 3)
        if not len(scales) == len(opacities) == len(quats) == count or (scales < 0).any():
            raise ValueError("its arrays differ in length, or a scale is negative")
        with np.errstate(divide="ignore"):
            logits = np.log(np.maximum(opacities, _LEAST_OPACITY)) - np.log1p(-opacities)
        gaussians = Gaussians(
            means=jnp.asarray(means),
            log_scales=jnp.asarray(np.log(np.maximum(scales, _LEAST_SCALE)), jnp.float32),
            quats=jnp.asarray(quats[:, [3, 0, 1, 2]]),
            logit_opacities=jnp.asarray(logits, jnp.float32),
            sh=jnp.asarray(sh),
        )
        world = np.asarray(pxr.UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(at)).T  # there rows are columns
        return fields_of([(gaussians, world)])


def _pxr(path: PathLike) -> Any:
    try:
        import pxr.Gf
        import pxr.Sdf
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.UsdVol
        import pxr.Vt
    except ImportError:
        raise InputError(f"{path}: USD needs usd-core: pip install 'pigjax[usd]'.") from None
    if not hasattr(pxr.UsdVol, "ParticleField3DGaussianSplat"):
        raise InputError(f"{path}: Gaussians in USD need usd-core 26.3 or newer: pip install -U 'pigjax[usd]'.")
    return pxr
