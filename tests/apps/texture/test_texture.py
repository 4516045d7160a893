"""Textures of a scene whose colours are known everywhere."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from needs import needs, needs_native
from PIL import Image
from town import BOX, HALF, HEIGHT, HIDDEN, WIDTH, YELLOW, is_clear, is_seen, on_box, sheet, surface, town, truth

from surfkit.apps.texture import candidates, find_candidates, pieces
from surfkit.apps.texture import seam_levelling as leveling
from surfkit.apps.texture import texture_mesh as make
from surfkit.apps.texture.candidates import NO_PHOTO, Candidates
from surfkit.apps.texture.choose import choose_views
from surfkit.apps.texture.fill import paint
from surfkit.apps.texture.pieces import MeshClusters
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos
from surfkit.apps.texture.regions import divide, middles
from surfkit.apps.texture.texture_atlas import make_atlas, packed, texels_of
from surfkit.apps.texture.texture_mesh import (
    MeshWithPhotos,
    TextureSettings,
    lay_out,
    local_mesh,
    look_at_all,
    make_texture,
    textured,
)
from surfkit.apps.texture.topology import neighbours, with_short_edges
from surfkit.apps.texture.triangle_visibility import look, look_in_numpy, project, sight
from surfkit.core.check import BadInput
from surfkit.core.events import PhotoSkipped, Warned
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.io.glb import read_glb
from surfkit.mesh.base import Mesh
from surfkit.mesh.shade import draw_faces
from surfkit.scene.camera import Camera
from surfkit.scene.earth import to_ecef
from surfkit.scene.one_light import OneLight
from surfkit.scene.scene import Frame, Mask
from surfkit.scene.track_light import fit_light

needs("fast_simplification")

PNG = TextureSettings(triangles=100_000, pictures="png", size=1024)
"""Keeps all the triangles of the scene, and loses nothing in pictures."""


def one_light(views):
    """Of photographs that stay as they are."""
    zero = np.zeros(views)
    return OneLight(np.zeros((views, 3)), np.zeros((views, 2, 3)), zero, zero.astype(np.int64), np.zeros((1, 8)))


def made(scene, out, settings=PNG):
    return make_texture(MeshWithPhotos(scene.surface, scene.frame, scene.views), settings, out, 10**8)


def read_pieces(path):
    """(F, 3, 3) corners, (F, 3, 2) uv and (F,) pages of a file, and the pages, by trimesh; not turned to y up."""
    trimesh = needs("trimesh")
    scene = trimesh.load(path, process=False, force="scene")
    corners, uv, page, images = [], [], [], []
    for piece in scene.geometry.values():
        corners.append(piece.vertices[piece.faces])
        uv.append(piece.visual.uv[piece.faces])
        page.append(np.full(len(piece.faces), len(images)))
        material = piece.visual.material
        image = getattr(material, "baseColorTexture", None) or material.image
        images.append(np.asarray(image.convert("RGB")))
    return np.concatenate(corners), np.concatenate(uv), np.concatenate(page), images


def points_on(pieces, count=8, margin=0.02):
    """Random places on the triangles, (n, 3), and the colours there, (n, 3) from 0 to 255, between texels."""
    corners, uv, page, images = pieces
    draw = np.random.default_rng(0)
    shares = draw.dirichlet([1, 1, 1], (len(corners), count)) * (1 - 3 * margin) + margin
    places = np.einsum("fnk,fki->fni", shares, corners).reshape(-1, 3)
    at = np.einsum("fnk,fki->fni", shares, uv).reshape(-1, 2)
    colors = np.zeros((len(at), 3))
    for number, image in enumerate(images):
        rows = np.repeat(page, count) == number
        size = np.array(image.shape[1::-1])
        spot = np.stack([at[rows, 0], 1 - at[rows, 1]], axis=1) * size - 0.5
        low = np.floor(spot).astype(int)
        p, q = (spot - low).T[:, :, None]

        def texel(i, j, image=image, low=low, size=size):
            x, y = (low + (i, j)).clip(0, size - 1).T
            return image[y, x].astype(float)

        colors[rows] = (1 - q) * ((1 - p) * texel(0, 0) + p * texel(1, 0))
        colors[rows] += q * ((1 - p) * texel(0, 1) + p * texel(1, 1))
    return places, colors


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The scene with a car in one of the photographs that look down, and its textured mesh."""
    folder = tmp_path_factory.mktemp("town")
    scene = town(folder, car=3)
    return scene, folder / "out", made(scene, folder / "out")


def test_up_is_what_the_cameras_or_the_user_tell(plain, tmp_path):
    _, out, record = plain
    turn = np.array(read_glb(out / "textured.glb").root["nodes"][0]["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(turn @ [0, 0, 1, 1], [0, 1, 0, 1], atol=1e-12)
    root = json.loads((out / "tiles3d" / "tileset.json").read_text())["root"]
    assert "transform" not in root and record["crs"] is None
    made(town(tmp_path), tmp_path / "out", replace(PNG, up="x", formats=("glb", "tiles3d")))
    turn = np.array(read_glb(tmp_path / "out" / "textured.glb").root["nodes"][0]["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(turn @ [1, 0, 0, 1], [0, 1, 0, 1], atol=1e-12)
    root = json.loads((tmp_path / "out" / "tiles3d" / "tileset.json").read_text())["root"]
    np.testing.assert_allclose(np.array(root["transform"]).reshape(4, 4).T @ [1, 0, 0, 1], [0, 0, 1, 1], atol=1e-12)


@pytest.mark.parametrize("name", ["textured.glb", "textured.obj"])
def test_colors_are_those_of_the_surface(plain, name):
    places, colors = points_on(read_pieces(plain[1] / name))
    exact = 255 * truth(places, on_box(places))
    whole = is_seen(places).reshape(12, -1, 8).all(2).any(0).repeat(8)
    clear = whole & is_clear(places)
    away = np.abs(colors - exact).max(1)[clear]
    assert clear.mean() > 0.6
    assert np.percentile(away, 99) < 12 and away.max() < 40, np.percentile(away, [50, 90, 99, 100])


def test_no_color_of_what_is_in_front_or_has_moved(plain):
    places, colors = points_on(read_pieces(plain[1] / "textured.glb"))
    ground = (places[:, 2] < 1e-3) & (BOX.distance(places) > 0.3)
    assert colors[ground, 0].max() < 90, "red of the box on the ground"
    assert (np.abs(colors - 255 * YELLOW).max(1) > 60).all(), "the car"
    shown = np.abs(places[:, :2] - [3.5, 2.6]).max(1) < 0.5
    assert (colors[shown & (places[:, 2] < 1e-3)][:, 1] > 150).all(), "the ground below the car is green"


@pytest.mark.parametrize("behind", [1e-9, 0.0, -2.0])
def test_what_passes_the_camera_hides_what_lies_behind_it(behind):
    """A wall beside a street: one corner of a triangle is beside the camera, or further back."""
    camera = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 48.0, 36.0, 96, 72)
    wall = np.array([[-3, -8, 2], [-3, 8, 2], [6, 0, behind]], np.float32)
    far = np.array([[-0.5, -0.5, 9], [0.5, -0.5, 9], [0, 0.5, 9]], np.float32)
    photo = np.zeros((3, 72, 96), np.uint8)
    alone = sight(Mesh(far, np.array([[0, 1, 2]], np.int32)), camera, photo)
    both = sight(Mesh(np.concatenate([wall, far]), np.arange(6, dtype=np.int32).reshape(2, 3)), camera, photo)
    assert alone.faces.tolist() == [0] and not len(both.faces)


def test_a_car_in_every_photograph_would_be_there(tmp_path):
    """The tests above can fail: without the refusal of outliers, the photograph with the car is chosen somewhere."""
    scene = town(tmp_path, car=3)
    mesh = local_mesh(scene.surface, scene.frame)
    photos = PrefetchedPhotos(scene.views, 10**8)
    found = Candidates(len(mesh.faces))
    for number, view in enumerate(scene.views):
        found.offer(number, sight(mesh, view.camera, photos(number)))
    yellow = (np.abs(found.color - 255 * YELLOW).max(2) < 40) & (found.view != NO_PHOTO)
    assert yellow.sum() > 4 and (found.view[yellow] == 3).all()
    before = yellow & (found.quality == found.quality.max(1, keepdims=True))
    assert before.any(), "it is the best photograph of some triangles"
    found.refuse_outliers(one_light(len(scene.views)))
    assert not (found.view[yellow] == 3).any()
    assert (found.view != NO_PHOTO).any(1).mean() > 0.85, "others are left"


def test_what_no_photograph_shows_has_the_colors_of_the_vertices(plain):
    places, colors = points_on(read_pieces(plain[1] / "textured.glb"))
    inside = (places[:, 2] < 1e-3) & (np.abs(places[:, :2] - [-0.5, 0.0]) < [1.0, 1.0]).all(1)
    assert inside.sum() > 50 and not is_seen(places[inside]).any()
    assert np.abs(colors[inside] - HIDDEN).max() <= 1


def test_sight_is_what_rays_see(tmp_path):
    scene = town(tmp_path)
    mesh = local_mesh(scene.surface, scene.frame)
    shares = np.random.default_rng(1).dirichlet([1, 1, 1], 60) * 0.9 + 0.1 / 3
    places = np.einsum("nk,fki->fni", shares, scene.surface.vertices(scene.surface.faces.ravel()).reshape(-1, 3, 3))
    for number in (0, 5, 9):
        view = scene.views[number]
        found = sight(mesh, view.camera, PrefetchedPhotos(scene.views, 10**8)(number))
        share = is_seen(places.reshape(-1, 3), [number])[number].reshape(-1, 60).mean(1)
        told = np.zeros(len(share), bool)
        told[found.faces] = True
        corners = project(mesh.vertices, view.camera)[mesh.faces].astype(float)
        pixels = texels_of(np.zeros(len(corners)), corners[:, :, :2]) / 1.5
        assert ((1 - share) * pixels)[told].max() < 2.5, "of what is told to be whole, hardly a pixel is hidden"
        assert told[share == 1].mean() > 0.95
        exact = [255 * truth(places[f], on_box(places[f])).mean(0) for f in found.faces]
        good = found.quality > 5
        assert np.percentile(np.abs(found.color - exact).max(1)[good], 90) < 8


def test_what_lies_beside_an_outline_counts_less():
    """A plate over the ground, seen from above: what it hides is not seen, and next to it the quality is a tenth."""
    ground, faces = sheet((-4, -4, 0), np.array([8.0, 0, 0]), np.array([0, 8.0, 0]), 0.25)
    plate, above = sheet((-1, -1, 1.5), np.array([2.0, 0, 0]), np.array([0, 2.0, 0]), 2.0)
    both = Mesh(np.concatenate([ground, plate]).astype(np.float32), np.concatenate([faces, above + len(ground)]))
    both = replace(both, faces=both.faces.astype(np.int32))
    pose = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 8], [0, 0, 0, 1]], dtype=torch.float64)
    camera = Camera(pose, 150.0, 150.0, 100.0, 100.0, 200, 200)
    photo = np.zeros((3, 200, 200), np.uint8)
    plain = sight(replace(both, faces=faces.astype(np.int32)), camera, photo)
    found = sight(both, camera, photo)
    rows = np.flatnonzero(np.isin(plain.faces, found.faces))
    ours = np.isin(found.faces, plain.faces)
    ratio = found.quality[ours] / plain.quality[rows]
    assert np.isclose(ratio, 1).sum() + np.isclose(ratio, 0.1).sum() == len(ratio)
    hidden = np.setdiff1d(plain.faces, found.faces)
    half = 8 / 6.5  # the shadow of the plate, as the camera sees it
    away = np.abs(ground[faces][..., :2]).max(2) - half
    pixel = 8 / 150
    assert (away[hidden].min(1) < 0.5 * pixel).all() and (away[found.faces[ours]].max(1) > -0.5 * pixel).all()
    near = away[found.faces[ours]].min(1) < 1.5 * pixel
    assert near.sum() > 20 and np.isclose(ratio[near], 0.1).all()
    assert np.isclose(ratio[away[found.faces[ours]].min(1) > 3.5 * pixel], 1).all()


def test_corrections_are_linear_between_vertices(tmp_path):
    scene = town(tmp_path)
    made_of = textured(MeshWithPhotos(scene.surface, scene.frame, scene.views), PNG, 10**8)
    mesh, atlas = made_of.paint.mesh, made_of.paint.atlas
    levels = made_of.paint.levels
    value = np.zeros((len(levels.value), 3), np.float32)
    seen = atlas.view != NO_PHOTO
    value[levels.corner[seen].ravel()] = mesh.vertices[mesh.faces[seen].ravel()][:, :1] / 3
    page = np.flatnonzero(atlas.page[atlas.chart] == 0)
    before, after = (
        paint(replace(made_of.paint, levels=replace(levels, value=each)), atlas.pages[0], page).astype(float)
        for each in (np.zeros_like(value), value)
    )
    shares = np.random.default_rng(6).dirichlet([1, 1, 1], len(page))
    x, y = np.floor((atlas.texels(page) * shares[:, :, None]).sum(1)).astype(int).T
    wanted = 255 * (mesh.vertices[mesh.faces[page]][:, :, 0] * shares).sum(1) / 3
    told = (after - before)[y, x]
    usable = seen[page, None] & (after[y, x] > 0) & (after[y, x] < 255)
    usable &= (before[y, x] > 13) & (before[y, x] < 204)  # nearer to black and white, less is added
    wanted = np.broadcast_to(wanted[:, None], told.shape)
    assert usable.mean() > 0.6 and wanted[usable].std() > 10
    assert np.percentile(np.abs(told - wanted)[usable], 95) < 2.5


@needs_native
def test_the_kernel_counts_as_numpy_does(tmp_path):
    scene = town(tmp_path, cell=0.13)
    mesh, view = local_mesh(scene.surface, scene.frame), scene.views[6]
    places, photo = project(mesh.vertices, view.camera), PrefetchedPhotos(scene.views, 10**8)(6)
    depth, _ = draw_faces(places, mesh.faces, view.camera.width, view.camera.height)
    depth[:40] = 0  # a mask
    ours = look(places, mesh.faces, photo, depth, 0.01)
    count = len(mesh.faces)
    theirs = np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros((count, 3), np.float32)
    look_in_numpy(places, mesh.faces, photo, depth, 0.01, theirs)
    assert (ours[0] > 0).sum() > 1000 and (ours[1] > 0).sum() > 100
    for one, other in zip(ours, theirs, strict=True):
        assert (one != other).mean() < 1e-3  # the sums of a product differ in the last bit on an edge


def test_exposures_are_found_and_seams_levelled(tmp_path):
    exposures = np.random.default_rng(2).uniform(0.75, 1.15, 12)
    scene = town(tmp_path, exposures=exposures)
    mesh, photos = local_mesh(scene.surface, scene.frame), PrefetchedPhotos(scene.views, 10**8)
    found, light, _ = look_at_all(mesh, photos, 1000)
    wanted = np.exp(np.log(exposures).mean()) / exposures
    assert np.abs(2.0**-light.stops / wanted[:, None] - 1).max() < 0.04
    beyond, edge = neighbours(mesh.faces)
    atlas, _ = lay_out(mesh, scene.views, choose_views(found, light, beyond, edge), beyond, 1024)
    steps = {}
    solved = leveling._solved

    def kept(pairs, inner, color, count):
        value = solved(pairs, inner, color, count)
        one, other = pairs.T
        steps["before"] = np.abs(color[one] - color[other]).mean()
        steps["after"] = np.abs(color[one] + value[one] - color[other] - value[other]).mean()
        return value

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(leveling, "_solved", kept)
        arguments = mesh.faces, atlas.view, atlas.places, beyond, photos
        leveling.level(*arguments, light)
        fitted = dict(steps)
        small = replace(light, stops=light.stops / 4)  # what levelling alone can do, where they are wrong
        leveling.level(*arguments, small)
    assert fitted["before"] < 0.5 * steps["before"]
    assert fitted["after"] <= fitted["before"] and steps["after"] < 0.6 * steps["before"]
    record = made(scene, tmp_path / "out")
    places, colors = points_on(read_pieces(tmp_path / "out" / "textured.glb"))
    ground = (places[:, 2] < 1e-3) & (BOX.distance(places) > 0.5) & (np.abs(places[:, :2]).max(1) < 5)
    ratio = colors[ground, 1] / (255 * truth(places[ground], False)[:, 1])
    assert ratio.std() < 0.03 < exposures.std() and record["gains"][1] > 1.1


def test_tiles_have_each_triangle_once_and_boxes_hold_them(tmp_path):
    move = (500_000.0, 5_800_000.0, 0.0)
    scene = town(tmp_path, crs="EPSG:32633", move=move)
    settings = replace(PNG, formats=("tiles3d", "obj"), size=128)
    record = made(scene, tmp_path / "out", settings)
    tileset = json.loads((tmp_path / "out" / "tiles3d" / "tileset.json").read_text())
    assert record["tiles"] > 3 and tileset["asset"]["version"] == "1.1"
    matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    corners, count = [], []

    def visit(tile, outer):
        box = np.array(tile["boundingVolume"]["box"])
        low, high = box[:3] - np.diag(box[3:].reshape(3, 3)), box[:3] + np.diag(box[3:].reshape(3, 3))
        assert (low >= outer[0] - 1e-6).all() and (high <= outer[1] + 1e-6).all()
        found = read_pieces(tmp_path / "out" / "tiles3d" / tile["content"]["uri"])[0]
        assert (found >= low - 1e-6).all() and (found <= high + 1e-6).all()
        if not (children := tile.get("children", [])):
            assert tile["geometricError"] == 0
            corners.append(found)
            return len(found)
        for child in children:
            assert child["geometricError"] <= tile["geometricError"] / 2
        below = sum(visit(child, (low, high)) for child in children)
        count.append((len(found), below, len(children)))
        return below

    visit(tileset["root"], (np.full(3, -np.inf), np.full(3, np.inf)))
    assert len(corners) == record["tiles"] and len(count) > 1
    assert all(few < 0.7 * many and 2 <= parts <= 4 for few, many, parts in count), "coarser tiles have fewer triangles"
    assert tileset["root"]["geometricError"] > 16 * 2 * record["texel"]
    earth = np.concatenate(corners) @ matrix[:3, :3].T + matrix[:3, 3]
    exact = scene.surface.vertices(scene.surface.faces.ravel())
    exact = to_ecef("EPSG:32633", exact).reshape(-1, 3, 3)
    assert len(earth) == len(exact) == record["triangles"]
    ours, theirs = (np.round(each.mean(1) - matrix[:3, 3], 2) for each in (earth, exact))
    assert (np.sort(ours, axis=0) == np.sort(theirs, axis=0)).mean() > 0.9
    assert np.abs(np.sort(ours, axis=0) - np.sort(theirs, axis=0)).max() < 0.02
    text = (tmp_path / "out" / "textured.obj").read_text()
    assert "# offset: 500000 5800000 0 (add it to x y z to get EPSG:32633)\n" in text
    first = np.array(next(line for line in text.splitlines() if line.startswith("v ")).split()[1:], float)
    assert np.allclose(first, [-HALF, -HALF, 0], atol=1e-4)


def test_edges_are_halved_without_cracks():
    places, faces = sheet((0, 0, 0), np.array([9.0, 0, 0]), np.array([0, 3.0, 1.0]), 3.0)
    mesh = Mesh(places.astype(np.float32), faces.astype(np.int32), np.zeros((len(places), 3), np.uint8))
    fine = with_short_edges(mesh, 0.7)
    sides = fine.vertices[fine.faces] - fine.vertices[np.roll(fine.faces, 1, axis=1)]
    assert np.linalg.norm(sides, axis=2).max() <= 0.7
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2
    assert area == pytest.approx(9 * 10**0.5, rel=1e-5) and len(fine.colors) == len(fine.vertices)
    beyond, edge = neighbours(fine.faces)
    rim = np.isin(fine.faces, np.flatnonzero(_on_rim(fine.vertices)))
    alone = beyond == -1
    assert (rim & np.roll(rim, -1, axis=1))[alone].all(), "only the rim of the sheet is open"
    face, side = np.nonzero(~alone)
    back = beyond[beyond[face, side], edge[face, side]]
    assert (back == face).all()


def _on_rim(vertices):
    x, y, _ = vertices.T
    return (x < 1e-5) | (x > 9 - 1e-5) | (y < 1e-5) | (y > 3 - 1e-5)


def test_three_triangles_at_an_edge_are_no_neighbours():
    beyond, _ = neighbours(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 2, 5]]))
    assert beyond[:, 0].tolist() == [-1, -1, -1, 0] and beyond[0].tolist() == [-1, 3, -1]


def test_rectangles_do_not_overlap():
    size = np.random.default_rng(3).integers(3, 90, (400, 2))
    for side, least in ((256, 2), (2048, 1)):
        page, corner, pages = packed(size, side)
        assert len(pages) >= least and max(max(shape) for shape in pages) <= side
        taken = [np.zeros((height, width), int) for width, height in pages]
        for number, (x, y), (w, h) in zip(page, corner, size, strict=True):
            taken[number][y : y + h, x : x + w] += 1
        assert max(each.max() for each in taken) == 1
        assert sum(each.sum() for each in taken) == size.prod(1).sum()


def test_the_largest_triangles_that_are_taken_fit_on_a_page(tmp_path):
    """A strip in one photograph, whose triangles reach as far to both sides of one cell of charts as they may."""
    side = 128
    longest = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            make, "look_at_all", lambda mesh, photos, most, *_: longest.append(most) or look_at_all(mesh, photos, 1)
        )
        made(town(tmp_path), tmp_path / "out", replace(PNG, formats=("glb",), size=side))
    wide = longest[0]
    x = np.array([30 - 2 * wide / 3, 30 + wide / 3, 30 + wide / 3, 2 - wide / 3, 2 - wide / 3, 2 + 2 * wide / 3])
    corners = np.stack([x, [0, 0, 4, 4, 8, 8]], axis=1)
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    places = corners[faces].astype(np.float32)
    middle = np.floor(places.mean(1)[[0, 1, 3]] / (side // 4))
    assert (middle == middle[0]).all(), "of one chart"
    atlas = make_atlas(np.zeros(4, np.int32), places, np.zeros(4, np.int32), neighbours(faces)[0], side)
    texels = atlas.texels(np.arange(4))
    assert (texels >= 0).all() and (texels <= [atlas.pages[0].width, atlas.pages[0].height]).all()


def test_neighbours_get_the_same_photograph():
    """A strip of triangles that two photographs show about as well, in turns: one of the two is chosen for all."""
    places, faces = sheet((0, 0, 0), np.array([40.0, 0, 0]), np.array([0, 1.0, 0]), 1.0)
    found = Candidates(len(faces))
    draw, light = np.random.default_rng(4).uniform(0.9, 1.0, (len(faces), 2)), one_light(8)
    found.color[:] = 120
    found.color[:, 1] = 190
    found.view[:, :2], found.quality[:, :2] = [5, 7], draw
    beyond, edge = neighbours(faces)
    assert len(np.unique(choose_views(found, light, beyond, edge))) == 1
    left = places[faces].mean(1)[:, 0] < 20
    found.quality[:, 0] = np.where(left, 1.0, 0.05)
    found.quality[:, 1] = np.where(left, 0.05, 1.0)
    assert (choose_views(found, light, beyond, edge) == np.where(left, 5, 7)).all()
    x = places[faces].mean(1)[:, 0]
    found.quality[:, :2] = np.where(x[:, None] > 28, [0.01, 1.0], [1.0, 0.9])
    found.color[(x > 23) & (x < 25), 1] = 120
    order = np.argsort(x)
    cut = x[order][np.flatnonzero(np.diff(choose_views(found, light, beyond, edge)[order]))]
    assert ((cut > 23) & (cut < 25)).all() and len(cut), "where both have the same colour"
    found.view[3] = NO_PHOTO
    found.quality[3] = 0
    assert np.flatnonzero(choose_views(found, light, beyond, edge) == NO_PHOTO).tolist() == [3]


def test_only_pieces_in_view_are_looked_at(tmp_path, monkeypatch):
    """Small pieces give what one large one does; of a flight over a long strip, each photograph shows few of them."""
    scene = town(tmp_path, cell=0.25)
    mesh, photos = local_mesh(scene.surface, scene.frame), PrefetchedPhotos(scene.views, 10**8)
    whole = look_at_all(mesh, photos, 1000)
    monkeypatch.setattr(pieces, "MAX_PIECE_TRIANGLES", 50)
    parts = look_at_all(mesh, photos, 1000)
    assert (whole[0].view == parts[0].view).all() and (whole[0].quality == parts[0].quality).all()
    assert (whole[0].color == parts[0].color).all() and (whole[1].stops == parts[1].stops).all()
    strip, faces = sheet((-100, -1, 0), np.array([200.0, 0, 0]), np.array([0, 2.0, 0]), 0.5)
    divided = MeshClusters(Mesh(strip.astype(np.float32), faces.astype(np.int32)))
    for x in (-150.0, -99.0, 0.0, 60.0):
        pose = torch.tensor([[1.0, 0, 0, -x], [0, -1, 0, 0], [0, 0, -1, 8], [0, 0, 0, 1]], dtype=torch.float64)
        part, rows = divided.in_view(Camera(pose, 150.0, 150.0, 100.0, 100.0, 200, 200))
        assert np.array_equal(part.vertices[part.faces], strip[faces[rows]].astype(np.float32))
        shown = np.abs(strip[faces][..., 0] - x).min(1) < 8 * 100 / 150
        assert np.isin(np.flatnonzero(shown), rows).all() and len(rows) < shown.sum() + 200
        assert len(rows) == 0 if x == -150 else len(rows) > 0


def test_a_part_of_the_triangles_is_enough_for_gains(tmp_path, monkeypatch):
    exposures = np.random.default_rng(2).uniform(0.75, 1.15, 12)
    scene = town(tmp_path, exposures=exposures, cell=0.25)
    found, light, _ = look_at_all(local_mesh(scene.surface, scene.frame), PrefetchedPhotos(scene.views, 10**8), 1000)
    all_of_it = len(found.shared(12).photo)
    monkeypatch.setattr(candidates, "SIGHTS_PER_PHOTO", all_of_it // 36)
    some = found.shared(12)
    assert 0.2 < len(some.photo) / all_of_it < 0.4
    assert np.abs(OneLight.of(scene.views, some).stops - light.stops).max() < 0.05


def test_photographs_of_one_level_at_a_time_are_in_memory(tmp_path, monkeypatch):
    kept, most = [], []

    class Watched(PrefetchedPhotos):
        def __init__(self, views, budget):
            most.append(sum(each.cache.bytes for each in kept))
            super().__init__(views, budget)
            kept.append(self)

    monkeypatch.setattr(make, "PrefetchedPhotos", Watched)
    made(town(tmp_path), tmp_path / "out", replace(PNG, formats=("tiles3d",), size=128))
    assert len(most) > 2 and most == [0] * len(most)


def test_gains_of_photographs_that_share_nothing_stay_one():
    found = Candidates(100)
    found.view[:50, 0], found.view[50:, 0], found.color[:] = 0, 1, 128
    assert not fit_light(found.shared(3), np.zeros(3, np.int64), np.zeros((3, 3, 2))).stops.any()


def test_regions_weigh_no_more_than_asked():
    mesh = local_mesh(surface(0.4), Frame(np.zeros(3), 0.05))
    weight = np.random.default_rng(5).uniform(0, 2, len(mesh.faces))
    where = middles(mesh)
    region = divide(where, weight, 100.0)
    number = region.of(where)
    sums = np.bincount(number, weight)
    assert len(sums) == len(list(region.leaves())) and sums.max() <= 100 and sums.min() > 20


def test_coarser_texels_and_fewer_triangles(tmp_path):
    scene = town(tmp_path)
    settings = TextureSettings(formats=("glb",), triangles=600, texel=0.4)
    record = made(scene, tmp_path / "out", settings)
    fine = made(scene, tmp_path / "fine", replace(settings, texel="auto"))
    assert record["texel"] == 0.4 and record["triangles"] < 1000 < len(scene.surface.faces)
    taken = [sum(width * height for width, height in each["pages"]) for each in (record, fine)]
    assert taken[0] < taken[1]
    places, colors = points_on(read_pieces(tmp_path / "out" / "textured.glb"))
    ground = (places[:, 2] < 0.01) & (BOX.distance(places) > 0.8) & (np.abs(places[:, :2]).max(1) < 5)
    assert np.abs(colors - 255 * truth(places, False))[ground].mean() < 10
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["texture.json", "textured.glb"]


def test_texels_are_no_finer_than_pixels(tmp_path, monkeypatch):
    scene, told = town(tmp_path), []
    monkeypatch.setattr("surfkit.apps.texture.texture_mesh.emit", told.append)
    records = {}
    for texel in ("auto", 1e-3, 1e9):
        settings = TextureSettings(formats=("glb",), texel=texel, pictures="png")
        records[texel] = {**made(scene, tmp_path / "out", settings), "seconds": 0}
    assert records[1e-3] == records["auto"] and records[1e9]["texel"] == 1e9
    said = [event.text for event in told if isinstance(event, Warned)]
    assert said == ["texels of 0.001 are finer than pixels, 0.077 on the surface: these are taken"]


def test_a_glb_file_that_would_be_too_large_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr("surfkit.io.glb.MAX_GLB_BYTES", 20_000)
    told = []
    monkeypatch.setattr("surfkit.apps.texture.texture_export.emit", told.append)
    record = made(town(tmp_path), tmp_path / "out", replace(PNG, formats=("glb", "obj")))
    assert "textured.glb" not in record["files"] and "textured.obj" in record["files"]
    said = [event.text for event in told if isinstance(event, Warned)]
    assert len(said) == 1 and said[0].startswith("textured.glb is left out: ") and str(tmp_path) not in said[0]
    with pytest.raises(BadInput, match="use the format tiles3d"):  # or nothing would be left, not even the one before
        made(town(tmp_path), tmp_path / "out", replace(PNG, formats=("glb",)))
    assert (tmp_path / "out" / "textured.obj").is_file()


def test_masks_hide(tmp_path):
    """With all of a photograph masked it is not used; with all of all of them, the vertices are what is left."""
    scene = town(tmp_path)
    masks = []
    for at, black in enumerate((True, False)):
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:, : WIDTH if black else 0] = 0
        masks.append(tmp_path / f"mask-{at}.png")
        Image.fromarray(mask).save(masks[-1])
    some = [replace(view, mask=Mask(masks[at % 2])) for at, view in enumerate(scene.views)]
    found, _, _ = look_at_all(local_mesh(scene.surface, scene.frame), PrefetchedPhotos(some, 10**8), 1000)
    assert set(np.unique(found.view)) == {NO_PHOTO, 1, 3, 5, 7, 9, 11}
    hidden = replace(scene, views=tuple(replace(view, mask=Mask(masks[0])) for view in scene.views))
    record = made(hidden, tmp_path / "out", replace(PNG, formats=("glb",)))
    assert record["seen"] == 0 and record["photographs"] == 0
    _, colors = points_on(read_pieces(tmp_path / "out" / "textured.glb"))
    assert np.abs(colors - HIDDEN).max() <= 1


def test_vertices_that_are_not_finite_are_left_out(tmp_path):
    """As `read_surface` leaves them: no face names them, but they are still there."""
    scene = town(tmp_path)
    rows = np.concatenate([scene.surface.rows[:1], scene.surface.rows])
    rows["x"][0] = np.nan
    odd = replace(scene, surface=SurfaceFile("mesh.ply", rows, scene.surface.faces + 1))
    settings = replace(PNG, formats=("obj",), triangles=200)
    for each, out in ((scene, "plain"), (odd, "odd")):
        made(each, tmp_path / out, settings)
    plain, ours = ((tmp_path / out / "textured.obj").read_bytes() for out in ("plain", "odd"))
    assert plain == ours


def test_what_no_photograph_shows_fits_on_small_pages(tmp_path):
    scene = town(tmp_path)
    few = replace(scene, views=scene.views[:1])
    record = made(few, tmp_path / "out", replace(PNG, formats=("glb",), size=128))
    assert record["seen"] < 0.9 and set(map(tuple, record["pages"])) <= {(64, 64), (128, 64), (128, 128)}
    corners, uv, page, images = read_pieces(tmp_path / "out" / "textured.glb")
    middle, size = uv.mean(1), np.array([images[at].shape[1::-1] for at in page])
    x, y = np.floor(middle * size * [1, -1] + size * [0, 1]).astype(int).T
    shown = np.array([images[at][row, column] for at, row, column in zip(page, y, x, strict=True)])
    under = (corners[..., 2] < 1e-6).all(1) & (np.abs(corners.mean(1)[:, :2] - [-0.5, 0]).max(1) < 1)
    assert under.sum() > 10 and (shown[under] == HIDDEN).all(), "the ground under the box"


def test_what_is_refused(tmp_path):
    scene = town(tmp_path)
    for wrong in ({"size": 100}, {"size": 1000}, {"triangles": 1}, {"texel": -1.0}, {"formats": ()}):
        with pytest.raises(BadInput, match="--"):
            TextureSettings(**wrong)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(OSError, match="name another"):
        made(scene, tmp_path / "mine")
    (tmp_path / "mine" / "texture.json").write_text("{}")
    with pytest.raises(OSError, match="not of a textured mesh: 'notes.txt'"):
        made(scene, tmp_path / "mine")
    with pytest.raises(OSError, match="a file; name a folder"):
        made(scene, tmp_path / "mine" / "notes.txt")
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"
    away = replace(scene, surface=surface(0.5, (0, 0, 500.0)))
    with pytest.raises(BadInput, match="no photograph shows any of it"):
        made(away, tmp_path / "away")
    assert not (tmp_path / "away").exists()
    scene.views[2].path.write_bytes(b"damaged")
    record = made(scene, tmp_path / "out")
    assert record["photographs"] <= 11, "the damaged one is passed over"


def test_the_folder_one_is_in_is_not_replaced(tmp_path, monkeypatch):
    scene = town(tmp_path)
    (tmp_path / "out" / "here").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "out" / "here")
    for out in (".", "..", tmp_path / "out"):
        with pytest.raises(OSError, match="the folder that you are in"):
            made(scene, Path(out))


def test_photographs_that_are_all_damaged_make_a_note(tmp_path, monkeypatch):
    scene, told = town(tmp_path), []
    for view in scene.views:
        view.path.write_bytes(b"damaged")
    for module in (make, find_candidates):
        monkeypatch.setattr(module, "emit", told.append)
    record = made(scene, tmp_path / "out", replace(PNG, formats=("obj",)))
    assert record["seen"] == 0 and sum(isinstance(event, PhotoSkipped) for event in told) == 12
    (warned,) = [event.text for event in told if isinstance(event, Warned)]
    assert "of 12 photographs, none shows a triangle whole" in warned
