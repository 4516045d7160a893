#!/usr/bin/env bash
# OpenUSD's boxes of a stage leave Gaussian splats out, without a warning, unless their extent is written.
#
# usd-core 26.11. The attribute `extent` may be left out: of points, `UsdGeom.BBoxCache` then works the box out, from places
# and widths. Of a `ParticleField3DGaussianSplat`, which is a boundable as well and has places and scales, it does not: its
# box is empty, and that of a stage of splats over 100 m and a marker of 2 m is the marker's, as far as what frames, culls or
# tiles by boxes is concerned. `UsdGeom.Boundable.ComputeExtent` gives None. None of the validators that come with usd-core
# says anything, and nothing is written to standard error. With `extent` written the box is right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet usd-core==26.11
"$folder/venv/bin/python" - 2>"$folder/errors" <<'PYTHON'
from pxr import Gf, Usd, UsdGeom, UsdValidation, UsdVol, Vt

PLACES = Vt.Vec3fArray([(0, 0, 0), (100, 50, 10)])


def box(prim):
    """The box of a prim in the world as ((x, y, z), (x, y, z)), None where it is empty."""
    found = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(prim).ComputeAlignedRange()
    return None if found.IsEmpty() else (tuple(found.GetMin()), tuple(found.GetMax()))


stage = Usd.Stage.CreateInMemory()
UsdGeom.SetStageMetersPerUnit(stage, 1)
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
stage.SetDefaultPrim(world)
UsdGeom.Cube.Define(stage, "/World/Marker")
splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/Splats").GetPrim()
values = {
    "positions": PLACES,
    "scales": Vt.Vec3fArray([(0.5, 0.5, 0.5)] * 2),
    "orientations": Vt.QuatfArray([Gf.Quatf(1)] * 2),
    "opacities": Vt.FloatArray([1, 1]),
    "radiance:sphericalHarmonicsDegree": 0,
    "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray([(0, 0, 0)] * 2),
}
for name, value in values.items():
    assert splats.GetAttribute(name).Set(value)
validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
said = [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)]
found = box(splats), box(world), UsdGeom.Boundable(splats).ComputeExtent(Usd.TimeCode.Default())
print("OpenUSD", Usd.GetVersion(), f"- {len(validators)} validators say {said}")
print("splats:", found[0], "- stage of splats and marker:", found[1], "- ComputeExtent:", found[2])
UsdGeom.Boundable(splats).CreateExtentAttr([PLACES[0] - Gf.Vec3f(1.5), PLACES[1] + Gf.Vec3f(1.5)])
written = box(world)
print("with extent written, stage:", written)
other = Usd.Stage.CreateInMemory()
points = UsdGeom.Points.Define(other, "/Points")
points.CreatePointsAttr(PLACES)
points.CreateWidthsAttr([1, 1])
print("points:", box(points.GetPrim()))
assert box(points.GetPrim()) == ((-0.5, -0.5, -0.5), (100.5, 50.5, 10.5))
assert written == ((-1.5, -1.5, -1.5), (101.5, 51.5, 11.5))
assert len(validators) > 0 and said == [], "the behaviour has changed"
assert found == (None, ((-1, -1, -1), (1, 1, 1)), None), "the behaviour has changed"
PYTHON
cat "$folder/errors"
test ! -s "$folder/errors"
