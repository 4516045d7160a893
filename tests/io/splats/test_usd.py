"""Splats in OpenUSD, read by OpenUSD itself."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs

from surfkit.core.check import BadInput
from surfkit.io.splats.file_axes import turn_between
from surfkit.io.splats.rotate_splats import turned
from surfkit.io.splats.splat_files import format_of
from surfkit.io.splats.usd import USD
from surfkit.io.usdz import write_usdz
from surfkit.scene.scene import Frame
from surfkit.testing.format_checks import check_format, splat_table

Gf, Usd, UsdGeom, UsdValidation, UsdVol, Vt = (
    needs(f"pxr.{part}") for part in ("Gf", "Usd", "UsdGeom", "UsdValidation", "UsdVol", "Vt")
)

SHIFT = (500_000.0, 5_600_000.0, 0.0)
SURVEY = Frame(np.array(SHIFT), 1.0, 2.0, "EPSG:32633", shift=SHIFT)


def faults(stage):
    """What the validators that come with OpenUSD find."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


def test_the_contract_of_formats():
    check_format(USD(), 200)


@pytest.mark.parametrize("degree", [0, 3])
def test_openusd_finds_what_was_written(tmp_path, degree):
    table = splat_table("gaussian", 50, degree)
    USD(up="y").write(tmp_path / "a.usdz", table, replace(SURVEY, crs=None, shift=(0, 0, 0)))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    prim = stage.GetDefaultPrim()
    assert not faults(stage) and prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 2.0
    splats = UsdVol.ParticleField3DGaussianSplat(prim)
    assert np.array_equal(splats.GetPositionsAttr().Get(), table.means.numpy())
    assert np.allclose(splats.GetScalesAttr().Get(), table.log_scales.exp(), rtol=1e-6)
    assert np.allclose(splats.GetOpacitiesAttr().Get(), table.opacity_logits.sigmoid(), rtol=1e-6)
    unit = torch.nn.functional.normalize(table.quats, dim=1)
    first = splats.GetOrientationsAttr().Get()[7]
    assert np.allclose([first.GetReal(), *first.GetImaginary()], unit[7], atol=1e-6)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == degree
    found = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(50, -1, 3)
    assert np.array_equal(found[:, 0], table.sh0) and np.array_equal(found[:, 1:], table.sh_rest)
    low, high = np.array(splats.GetExtentAttr().Get())
    assert (low < table.means.numpy().min(0)).all() and (high > table.means.numpy().max(0)).all()


def test_up_and_places_far_away(tmp_path):
    table = splat_table("gaussian", 20, 1)
    far = replace(table, means=table.means.double() + torch.tensor([500_000.0, 5_600_000.0, 0.0]))
    for axis, frame, known in (
        ("Z", SURVEY, table.means),
        ("Y", None, far.means * torch.tensor([-1, -1, 1])),
    ):
        path = tmp_path / f"{axis}.usdz"
        USD().write(path, far, frame)
        stage = Usd.Stage.Open(str(path))
        assert UsdGeom.GetStageUpAxis(stage) == axis and not faults(stage)
        prim = stage.GetDefaultPrim()
        matrix = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)
        world = np.array(
            [matrix.Transform(Gf.Vec3d(*map(float, place))) for place in prim.GetAttribute("positions").Get()]
        )
        assert np.abs(world - known.numpy()).max() < 1e-5
    assert stage.GetRootLayer().customLayerData["surfkit"]["kind"] == "gaussian"
    assert (USD().read(path).means - far.means).abs().max() < 1e-6


def test_surflets(tmp_path):
    table = splat_table("surfel", 30, 2)
    USD(kernel="surflet").write(tmp_path / "a.usdz", table)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    prim = stage.GetDefaultPrim()
    assert not faults(stage) and prim.GetTypeName() == "ParticleField"
    assert prim.HasAPI(UsdVol.ParticleFieldKernelGaussianSurfletAPI)
    assert not prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI)
    found = USD().read(tmp_path / "a.usdz")
    assert found.kind == "surfel" and torch.allclose(found.log_scales, table.log_scales, atol=1e-6)
    with pytest.raises(BadInput, match="kernel surflet is for surfels"):
        USD(kernel="surflet").write(tmp_path / "b.usdz", splat_table("gaussian", 3, 0))
    assert not (tmp_path / "b.usdz").exists()


def foreign(path, change=lambda prim: None, up="Z"):
    """A file of another program: attributes of 16 bits, and two prims, one of them below a node that moves."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.Xform.Define(stage, "/World").AddTranslateOp().Set(Gf.Vec3d(0, 0, 10))
    for name in ("/World/a", "/b"):
        prim = stage.DefinePrim(name, "ParticleField3DGaussianSplat")
        prim.GetAttribute("positionsh").Set(Vt.Vec3hArray([Gf.Vec3h(1, 2, 3), Gf.Vec3h(4, 5, 6)]))
        prim.GetAttribute("scalesh").Set(Vt.Vec3hArray([Gf.Vec3h(1, 2, 0.5)] * 2))
        prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(0)
        prim.GetAttribute("radiance:sphericalHarmonicsCoefficientsh").Set(Vt.Vec3hArray([Gf.Vec3h(0.5, 1, 0)] * 2))
        change(prim)
    write_usdz(path, stage)
    return path


def test_files_of_other_programs(tmp_path):
    path = foreign(tmp_path / "a.usdz")
    assert isinstance(format_of(path), USD)
    found = turned(USD().read(path), turn_between("rfu").T)
    assert found.axes.name == "rfu" and found.axes.is_told and found.kind == "gaussian"
    assert found.means.tolist() == [[1, 2, 13], [4, 5, 16], [1, 2, 3], [4, 5, 6]]
    assert torch.allclose(found.scales, torch.tensor([1, 2, 0.5]).expand(4, 3)) and (found.opacities > 0.999).all()
    assert found.sh0.tolist() == [[0.5, 1, 0]] * 4

    def ragged(prim):
        prim.GetAttribute("opacities").Set([0.5])

    with pytest.raises(BadInput, match="/World/a.opacities has 1 values, not 2"):
        USD().read(foreign(tmp_path / "b.usdz", ragged))
    with pytest.raises(BadInput, match="degree 4"):
        USD().read(
            foreign(tmp_path / "c.usdz", lambda prim: prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(4))
        )
    stage = Usd.Stage.CreateInMemory()
    stage.DefinePrim("/a", "ParticleField")
    write_usdz(tmp_path / "d.usdz", stage)
    with pytest.raises(BadInput, match="/a has no Gaussian kernel"):
        USD().read(tmp_path / "d.usdz")


def test_damage_anywhere_is_noticed(tmp_path):
    path = tmp_path / "a.usdz"
    USD().write(path, splat_table("gaussian", 100, 1))
    assert zipfile.ZipFile(path).namelist() == ["scene.usdc"]
    whole, draw = path.read_bytes(), np.random.default_rng(0)
    for place in draw.integers(100, len(whole) - 200, 40):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        with pytest.raises(BadInput, match="damaged"):
            USD().read(path)


def test_an_archive_does_not_tell_when_it_was_written(tmp_path):
    """OpenUSD stores the times of files: the same splats would give other bytes two seconds later."""
    USD().write(tmp_path / "a.usdz", splat_table("gaussian", 5, 0))
    assert {info.date_time[0] for info in zipfile.ZipFile(tmp_path / "a.usdz").infolist()} == {1980}
