"""Textured meshes in OpenUSD, read by OpenUSD itself, against the GLB file of the same command, read by trimesh."""

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from needs import needs
from PIL import Image
from town import town

from surfkit.apps.texture.texture_mesh import MeshWithPhotos, TextureSettings, make_texture
from surfkit.cli import main
from surfkit.core.events import Warned
from surfkit.io.glb import read_glb

needs("fast_simplification")
trimesh = needs("trimesh")
Usd, UsdGeom, UsdShade, UsdValidation = (
    needs(f"pxr.{part}") for part in ("Usd", "UsdGeom", "UsdShade", "UsdValidation")
)

SETTINGS = TextureSettings(formats=("glb", "usdz"), triangles=800, texel=0.1, size=128, pictures="png")


def made(scene, out, settings=SETTINGS):
    return make_texture(MeshWithPhotos(scene.surface, scene.frame, scene.views), settings, out, 10**8)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("usd")
    record = made(town(folder), folder / "out")
    return folder / "out", record


def pages(stage):
    """The mesh of each page."""
    return [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


def test_the_mesh_is_that_of_the_glb(files):
    out, record = files
    assert record["files"] == ["textured.glb", "textured.usdz"]
    stage = Usd.Stage.Open(str(out / "textured.usdz"))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert not [error.GetMessage() for error in context.Validate(stage)]
    scene = trimesh.load(out / "textured.glb", process=False, force="scene")
    assert len(pages(stage)) == len(scene.geometry) == len(record["pages"]) > 1
    for page, known in zip(pages(stage), scene.geometry.values(), strict=True):
        assert np.array_equal(page.GetPointsAttr().Get(), known.vertices.astype(np.float32))
        assert np.array_equal(page.GetFaceVertexIndicesAttr().Get(), known.faces.ravel())
        assert set(page.GetFaceVertexCountsAttr().Get()) == {3}
        st = UsdGeom.PrimvarsAPI(page).GetPrimvar("st")
        assert st.GetInterpolation() == "vertex" and np.allclose(st.Get(), known.visual.uv, atol=1e-6)
        assert page.GetSubdivisionSchemeAttr().Get() == "none" and page.GetDoubleSidedAttr().Get()


def test_bounds_and_up(files):
    stage = Usd.Stage.Open(str(files[0] / "textured.usdz"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    box = cache.ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange()
    (low, high) = trimesh.load(files[0] / "textured.glb", force="scene").bounds  # y up
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    ends = np.sort([turn @ low, turn @ high], axis=0)
    assert np.allclose([box.GetMin(), box.GetMax()], ends, atol=1e-4)


def test_each_page_shows_its_picture(files):
    stage = Usd.Stage.Open(str(files[0] / "textured.usdz"))
    archive = zipfile.ZipFile(files[0] / "textured.usdz")
    scene = trimesh.load(files[0] / "textured.glb", process=False, force="scene")
    assert archive.namelist()[0] == "scene.usdc" and {each.compress_type for each in archive.infolist()} == {0}
    names = []
    for page, known in zip(pages(stage), scene.geometry.values(), strict=True):
        material, _ = UsdShade.MaterialBindingAPI(page).ComputeBoundMaterial()
        names.append((material.GetPrim().GetName(), known.visual.material.name))
        surface, _, _ = material.ComputeSurfaceSource()
        (source,), _ = surface.GetInput("diffuseColor").GetConnectedSources()
        image = UsdShade.Shader(source.source)
        assert surface.GetIdAttr().Get() == "UsdPreviewSurface" and image.GetIdAttr().Get() == "UsdUVTexture"
        asset = image.GetInput("file").Get()
        assert asset.resolvedPath.endswith(f"[{asset.path}]"), "it is found in the archive"
        picture = Image.open(io.BytesIO(archive.read(asset.path)))
        assert np.array_equal(picture.convert("RGB"), known.visual.material.baseColorTexture.convert("RGB"))
    assert names == [(f"texture_{at}", f"texture {at}") for at in range(len(names))] and len(names) > 1
    root = read_glb(files[0] / "textured.glb").root
    assert {root[kind][0]["name"] for kind in ("nodes", "meshes")} == {"textured surface"}
    assert [image["name"] for image in root["images"]] == [f"texture {at}" for at in range(len(names))]


def test_too_large_for_an_archive(tmp_path, monkeypatch):
    monkeypatch.setattr("surfkit.io.usdz.MAX_ARCHIVE_BYTES", 1000)
    said = []
    monkeypatch.setattr("surfkit.apps.texture.texture_export.emit", lambda event: said.append(event))
    record = made(town(tmp_path), tmp_path / "out", replace(SETTINGS, size=512))
    assert record["files"] == ["textured.glb"]
    (warning,) = [event for event in said if isinstance(event, Warned)]
    assert "textured.usdz is left out: more than 4 GiB" in str(warning)


def test_out_is_a_folder(tmp_path, capsys):
    assert main(["texture", str(tmp_path), "--out", str(tmp_path / "mine.usdz")]) == 2
    assert capsys.readouterr().err.endswith("mine.usdz: give a folder, and --formats usdz\n")
