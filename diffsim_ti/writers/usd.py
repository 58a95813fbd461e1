"""Animated surfaces as OpenUSD, for Omniverse, Isaac Sim, Houdini, Blender."""

from pathlib import Path

import numpy as np

from diffsim_ti.common.origin import middle_far_part
from diffsim_ti.writers.surfaces import SurfacesWriter
from diffsim_ti.writers.writer import View, register


@register
class UsdWriter(SurfacesWriter):
    """Writes /run/body and /run/obstacle_1 ... as meshes whose points are sampled at each frame, when it is closed.

    Units are metres and kilograms; a frame at t [s] is time code t * view.fps, of view.fps codes a second. The up axis
    is z where the scene's gravity acts along z, else y. Points are float32 [m], of what is far from the origin less a
    translation. The body's triangles have one colour, or where `view.colour` names a field one for each vertex and frame.
    Raises ImportError without usd-core (`pip install "diffsim-ti[usd]"`).
    Pixar, OpenUSD: UsdGeomMesh, UsdGeomPrimvarsAPI.
    """

    suffixes = (".usd", ".usda", ".usdc")

    def __init__(self, path: str | Path, view: View | None = None):
        try:
            import pxr  # noqa: F401
        except ImportError:
            raise ImportError('usd: usd-core is missing; pip install "diffsim-ti[usd]"') from None
        super().__init__(path, view)

    def close(self) -> None:
        if not self._places:
            return
        from pxr import Usd, UsdGeom, UsdPhysics

        self.path.unlink(missing_ok=True)
        stage, fps = Usd.Stage.CreateNew(str(self.path)), float(self.view.fps)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if self.setting.up == 2 else UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        codes = [time * fps for time in self._times]
        stage.SetStartTimeCode(codes[0])
        stage.SetEndTimeCode(codes[-1])
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/run").GetPrim())
        for name, triangles, places, colours in self.surfaces():
            mesh = UsdGeom.Mesh.Define(stage, f"/run/{name.replace(' ', '_')}")
            away = middle_far_part(places[0])
            if away.any():
                mesh.AddTranslateOp().Set(tuple(away))
            mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
            mesh.CreateDoubleSidedAttr(True)
            mesh.CreateFaceVertexCountsAttr(np.full(len(triangles), 3, np.int32))
            mesh.CreateFaceVertexIndicesAttr(np.ascontiguousarray(triangles.ravel(), np.int32))
            points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
            kind = UsdGeom.Tokens.vertex if len(colours[0]) > 1 else UsdGeom.Tokens.constant
            shown = mesh.CreateDisplayColorPrimvar(kind)
            for attribute, samples in (
                (points, [x - away for x in places]),
                (extent, [np.stack([x.min(0), x.max(0)]) - away for x in places]),
                (shown, colours),
            ):
                for code, x in zip(codes if len(samples) > 1 else [Usd.TimeCode.Default()], samples):
                    attribute.Set(np.ascontiguousarray(x, np.float32), code)
        stage.Save()
