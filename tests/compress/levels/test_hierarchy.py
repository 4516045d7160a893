"""The tree of splats: its moments, its cuts, what lies between a node and its parent, and what optimisation brings."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.compress.levels import Hierarchy, hierarchy
from surfkit.compress.levels.cut import cut
from surfkit.compress.levels.hierarchy import InnerNodes, merged_tree
from surfkit.compress.levels.moments import Shapes
from surfkit.compress.levels.splat_tree import AXIS_TURNS, TURNED_AXES, Cut, leaf_ends, level_sizes, turned
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import ALPHA_MAX, CUTOFF
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints
from surfkit.testing.inputs import lod_input

CPU = select("cpu")[0]


def scattered(count, opacity=0.3, primitive=None, seed=0, size=0.05):
    """Splats of random places, shapes and colours in the unit cube."""
    draw, primitive = torch.Generator().manual_seed(seed), primitive or Gaussian3D(sh_degree=1)
    xyz = torch.rand(count, 3, generator=draw)
    params = primitive.init(SparsePoints(xyz, torch.full((count, 3), 128, dtype=torch.uint8)), draw)
    spread = {name: torch.randn(params[name].shape, generator=draw) for name in ("quats", "sh0", "sh_rest")}
    scales = np.log(size) + 0.5 * torch.randn(params["scales"].shape, generator=draw)
    params = params | spread | {"scales": scales}
    return SplatModel(primitive, primitive.with_opacities(params, torch.full((count,), opacity)), 1, 0.01)


def looking(distance, size=48, side=(0.4, 0.3)):
    """A camera on the z axis of the unit cube, so far before its middle, that looks at it."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-side[0], -side[1], distance - 0.5])
    return Camera(pose, 60.0, 60.0, size / 2, size / 2, size, size)


def cameras(count):
    """Cameras around and within the cube, of any direction."""
    draw, found = np.random.default_rng(3), []
    for _ in range(count):
        turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ (0.5 + draw.normal(size=3) * draw.choice([0.3, 1, 5]))
        found.append(Camera(torch.from_numpy(pose), 60.0, 50.0, 24, 24, 48, 48))
    return found


def ancestors(tree):
    """(levels, N) the row in `joined` of each leaf and of all above it, found from the bounds alone."""
    rows = [np.arange(len(tree.levels[0]))]
    rows.append(np.searchsorted(leaf_ends(len(rows[0])), rows[0], side="right") - 1)
    for _ in tree.levels[2:]:
        rows.append(rows[-1] // 2)
    return np.stack([each + start for each, start in zip(rows, tree.starts, strict=False)])


def drawn(splats, camera):
    return CPU.render(splats, camera, 0.01, False, False).maps.color


def psnr(one, other):
    return float(-10 * (one - other).square().mean().clamp_min(1e-12).log10())


@pytest.mark.parametrize("count", [1, 2, 3, 5, 17, 64, 100, 129])
def test_every_level_has_half_of_the_one_below(count):
    tree = merged_tree(scattered(count), 8)
    sizes = [len(level) for level in tree.levels]
    assert sizes == level_sizes(count) and sizes[-1] == 1
    assert set(np.diff(leaf_ends(count))) <= {1, 2} and leaf_ends(count)[-1] == count
    found = ancestors(tree)
    for below, above in zip(found[:-1], found[1:], strict=True):
        assert (tree.parents.numpy()[below] == above).all()
    assert tree.parents[-1] == len(tree.parents) - 1


def test_the_cut_in_one_sort_is_that_of_each_part_by_itself():
    means = np.random.default_rng(0).normal(size=(203, 3)).round(1)  # with equal coordinates
    order, bounds = cut(means, 5)
    rows = [np.arange(203)]
    for _ in range(5):
        halves = []
        for part in rows:
            axis = np.argmax(np.ptp(means[part], axis=0))
            part = part[np.argsort(means[part, axis], kind="stable")]
            halves += [part[: (len(part) + 1) // 2], part[(len(part) + 1) // 2 :]]
        rows = halves
    assert np.array_equal(order, np.concatenate(rows)) and np.diff(bounds[-1]).tolist() == list(map(len, rows))


def test_two_equal_splats_make_one_of_the_same_moments_and_twice_the_opacity():
    one = scattered(1, opacity=0.3)
    twice = replace(one, params={name: value.repeat(2, *[1] * (value.dim() - 1)) for name, value in one.params.items()})
    root, leaf = merged_tree(twice, 8).levels[-1].splats, one.splats
    assert len(root) == 1 and torch.allclose(root.means, leaf.means) and torch.allclose(root.sh, leaf.sh)
    assert np.allclose(Shapes.of(root).covariances, Shapes.of(leaf).covariances, rtol=1e-4)
    assert float(root.opacities) == pytest.approx(0.6, rel=1e-5), "sum of w / S, with S that of either"


def test_an_opacity_above_one_is_no_opacity_but_area():
    one = scattered(1, opacity=0.9)
    twice = replace(one, params={name: value.repeat(2, *[1] * (value.dim() - 1)) for name, value in one.params.items()})
    root = merged_tree(twice, 8).levels[-1].splats
    assert float(root.opacities) == pytest.approx(ALPHA_MAX, abs=1e-5)
    assert Shapes.of(root).areas / Shapes.of(one.splats).areas == pytest.approx((1.8 / ALPHA_MAX) ** 0.5, rel=1e-4)


def test_nodes_keep_the_moments_of_their_children():
    """Against float64 sums over the children, with w = opacity x (s1 s2 + s1 s3 + s2 s3)."""
    tree = merged_tree(scattered(100, opacity=0.02), 8)
    kept = 0
    for level in range(1, len(tree.levels)):
        below, above = (tree.levels[at].splats for at in (level - 1, level))
        parents = tree.parents.numpy()[tree.starts[level - 1] : tree.starts[level]] - tree.starts[level]
        s, mean = below.scales.double().numpy(), below.means.double().numpy()
        weight = below.opacities.double().numpy() * (s[:, 0] * s[:, 1] + s[:, 0] * s[:, 2] + s[:, 1] * s[:, 2])
        second = Shapes.of(below).covariances + mean[:, :, None] * mean[:, None]
        found, sh = Shapes.of(above), above.sh.double().numpy()
        for node in range(len(above)):
            if above.opacities[node] > 0.98:
                continue  # the excess is area
            rows = (parents == node).nonzero()[0]
            w = weight[rows] / weight[rows].sum()
            outer = found.covariances[node] + np.outer(found.means[node], found.means[node])
            assert np.allclose(found.means[node], w @ mean[rows], atol=1e-6)
            assert np.allclose(outer, np.einsum("n,nij->ij", w, second[rows]), atol=1e-6)
            assert np.allclose(sh[node], np.einsum("n,nkc->kc", w, below.sh.double().numpy()[rows]), atol=1e-5)
            assert found.opacities[node] * found.areas[node] == pytest.approx(weight[rows].sum(), rel=1e-4)
            kept += 1
    assert kept > 100


def test_each_leaf_is_drawn_exactly_once_from_every_camera():
    tree = merged_tree(scattered(203), 16)
    lines = ancestors(tree)
    for camera in cameras(40):
        sizes = np.concatenate([box.granularity(np.arange(len(box.reach)), camera) for box in tree.boxes])
        for pixels in (0.0, 3.0, 12.0, 50.0, 1e3, np.inf):
            found = tree.cut(camera, pixels)
            drawn_rows = np.zeros(len(tree.parents), bool)
            drawn_rows[found.nodes] = True
            assert drawn_rows.sum() == len(found), "no node twice"
            assert (drawn_rows[lines].sum(0) == 1).all(), "no hole, and nothing twice"
            inner, below = found.nodes >= 203, found.nodes != len(tree.parents) - 1
            assert (sizes[found.nodes[inner]] <= pixels).all()
            assert (sizes[found.parents[below]] > pixels).all()
        assert (sizes[tree.parents] >= sizes).all()


def test_what_is_left_out_is_not_in_the_picture():
    tree = merged_tree(scattered(400, opacity=0.8), 16)
    left_out = 0
    for camera in cameras(30):
        for pixels in (0.0, 8.0):
            everything = tree.cut(camera, pixels)
            node, parent = (tree.joined.take(rows) for rows in (everything.nodes, everything.parents))
            whole, seen = tree.between(everything, node, parent), tree.seen(camera, pixels)
            left_out += len(whole) - len(seen)
            assert torch.allclose(drawn(whole, camera), drawn(seen, camera), atol=2e-6)
    assert left_out > 1000


@pytest.mark.parametrize("primitive", [Gaussian3D(sh_degree=1), Surfel2D(sh_degree=1)])
def test_between_ends_at_the_parent_and_at_the_node(primitive):
    tree = merged_tree(scattered(60, primitive=primitive), 8)
    rows = torch.arange(len(tree.parents))
    node, parent = tree.joined, tree.joined.take(tree.parents)
    for share, wanted in ((1.0, node), (0.0, parent)):
        made = tree.between(Cut(rows, tree.parents, torch.full((len(rows),), share)), node, parent)
        assert torch.allclose(made.means, wanted.means) and torch.allclose(made.sh, wanted.sh)
        assert np.allclose(Shapes.of(made).covariances, Shapes.of(wanted).covariances, atol=1e-7)
        heirs = tree.heirs if share == 0 else torch.ones_like(tree.heirs)
        assert torch.allclose(made.opacities, wanted.opacities * heirs)
    first = torch.zeros(len(rows)).index_add(0, tree.parents, tree.heirs.float())
    assert (first[60:-1] == 1).all(), "one of the children of each node has its opacity"


def test_axes_are_turned_to_the_nearest_ones():
    assert len(AXIS_TURNS) == 24 == len(np.unique(AXIS_TURNS.numpy().round(6), axis=0))
    assert TURNED_AXES[0].tolist() == [0, 1, 2]
    splats = scattered(24).splats
    quats, scales = turned(splats, torch.arange(24))
    other = splats.with_named(splats.named() | {"quats": quats, "scales": scales})
    assert np.allclose(Shapes.of(other).covariances, Shapes.of(splats).covariances, atol=1e-7)
    tree = merged_tree(scattered(60), 8)
    quats, _ = turned(tree.joined.take(tree.parents), tree.turns)
    own = torch.nn.functional.normalize(tree.joined.quats, dim=1)
    apart = 2 * torch.rad2deg(torch.acos((own * quats).sum(1).abs().clamp(max=1)))
    assert float(apart.max()) < 62.8, "the farthest that a rotation can be from all turns of a cube"


def test_a_picture_does_not_jump_where_a_node_takes_over():
    tree = merged_tree(scattered(200, opacity=0.6), 16)
    camera = looking(2.0)
    sizes = np.concatenate([box.granularity(np.arange(len(box.reach)), camera) for box in tree.boxes[1:]])
    jumps, hard = [], []
    for size in np.unique(sizes)[::7]:
        below, above = size * (1 - 1e-6), size * (1 + 1e-6)
        jumps.append(
            float((drawn(tree.seen(camera, below), camera) - drawn(tree.seen(camera, above), camera)).abs().max())
        )
        cuts = [tree.joined.take(tree.cut(camera, pixels).nodes) for pixels in (below, above)]
        hard.append(float((drawn(cuts[0], camera) - drawn(cuts[1], camera)).abs().max()))
    assert max(jumps) < 6e-3, "some alpha falls below 1/255, and no more"
    assert np.median(hard) > 10 * np.median(jumps) and max(hard) > 0.1


def test_a_camera_that_moves_away_sees_no_jump():
    """Between neighbouring frames the picture changes as that of the full model does, and not by whole nodes."""
    tree = merged_tree(scattered(200, opacity=0.6), 16)
    path = [looking(distance) for distance in np.linspace(2.0, 2.1, 41)]
    shown = [drawn(tree.seen(camera, 35.0), camera) for camera in path]
    hard = [drawn(tree.joined.take(tree.cut(camera, 35.0).nodes), camera) for camera in path]
    smooth, popping = ([psnr(a, b) for a, b in zip(f[:-1], f[1:], strict=True)] for f in (shown, hard))
    assert min(smooth) > min(popping) + 12
    assert len({len(tree.cut(camera, 35.0)) for camera in path}) > 3, "nodes take over on the way"


def test_blocks_that_are_joined_lose_no_leaf():
    parts = [scattered(37, seed=1), scattered(90, seed=2)]
    trees = [merged_tree(part, 8) for part in parts]
    joined = replace(parts[0], params={n: torch.cat([part.params[n] for part in parts]) for n in parts[0].params})
    tree = merged_tree(joined, 8)
    assert np.array_equal(np.sort(tree.order), np.arange(127))
    leaves = [{tuple(row) for row in each.levels[0].params["means"].tolist()} for each in (*trees, tree)]
    assert leaves[0] | leaves[1] == leaves[2] and len(leaves[2]) == 127
    camera = looking(3.0)
    assert torch.allclose(drawn(tree.seen(camera, 0.0), camera), drawn(joined.splats, camera), atol=1e-6)


def test_optimisation_lowers_the_loss_at_every_granularity_and_leaves_the_leaves(tmp_path):
    given = replace(lod_input(count=300), folder=tmp_path)
    lod = Hierarchy(tile_points=50, steps=300, finest=0.05, coarsest=0.8)
    plain, taught = (replace(lod, steps=steps).build(given) for steps in (0, 300))
    for name, value in plain.levels[0].params.items():
        assert torch.equal(value, taught.levels[0].params[name]), "leaves are anchors"
    for name in ("means", "quats"):
        assert all(
            torch.equal(a.params[name], b.params[name]) for a, b in zip(plain.levels, taught.levels, strict=True)
        )
    for at in range(len(taught.blocks)):
        level, rows = taught.levels[taught.blocks.level[at]], slice(taught.blocks.first[at], taught.blocks.last[at])
        assert CUTOFF * float(level.take(rows).splats.scales.max()) <= taught.blocks.reach[at] * (1 + 1e-6)
    wanted = [drawn(given.model.splats, view.camera) for view in given.views]
    for granularity in (0.2, 0.3, 0.4, 0.6, 0.8):
        loss = []
        for tree in (plain, taught):
            made = (tree.seen(view.camera, granularity * view.camera.fx) for view in given.views)
            pairs = zip(made, given.views, wanted, strict=True)
            loss.append(sum(float((drawn(splats, v.camera) - full).abs().mean()) for splats, v, full in pairs))
        assert loss[1] < 0.97 * loss[0], granularity


def test_an_interrupted_optimisation_goes_on_with_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setattr(hierarchy, "KEPT_EVERY", 10)
    given, lod = replace(lod_input(count=300), folder=tmp_path), Hierarchy(tile_points=50, steps=40, finest=0.05)
    whole = replace(given, folder=tmp_path / "whole")
    whole.folder.mkdir()
    expected = lod.build(whole)
    step, taken = InnerNodes.step, []

    def interrupted(self, *args):
        taken.append(args[-1])
        if len(taken) == 25:
            raise KeyboardInterrupt
        return step(self, *args)

    monkeypatch.setattr(InnerNodes, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        lod.build(given)
    found = lod.build(given)
    assert taken == [*range(1, 26), *range(21, 41)], "from step 20, the last that is kept"
    for one, other in zip(expected.levels, found.levels, strict=True):
        assert all(torch.equal(value, other.params[name]) for name, value in one.params.items())


def test_a_state_of_other_points_is_not_gone_on_from(tmp_path, monkeypatch):
    monkeypatch.setattr(hierarchy, "KEPT_EVERY", 2)
    lod = Hierarchy(tile_points=50, steps=3)
    lod.build(replace(lod_input(count=200), folder=tmp_path))
    kept = tmp_path / "hierarchy.safetensors"
    assert hierarchy.kept_state(kept, InnerNodes.of(merged_tree(lod_input(count=200).model, 50)).points).index == 2
    assert hierarchy.kept_state(kept, InnerNodes.of(merged_tree(lod_input(count=300).model, 50)).points) is None
    kept.write_bytes(b"no state")
    assert hierarchy.kept_state(kept, InnerNodes.of(merged_tree(lod_input(count=200).model, 50)).points) is None


def test_nodes_that_a_cut_does_not_show_rest():
    given = lod_input(count=300)
    tree = merged_tree(given.model, 50)
    inner, view = InnerNodes.of(tree), given.views[0]
    before = {name: value.clone() for name, value in inner.points.params.items()}
    shown = tree.cut(view.camera, 0.3 * view.camera.fx, given.model.near)
    inner.step(given, view, torch.zeros(3, view.camera.height, view.camera.width, dtype=torch.uint8), 0.3, 1)
    rows = torch.unique(torch.cat([shown.nodes, shown.parents]))
    moved = (inner.points.params["opacities"] != before["opacities"]).nonzero()[:, 0] + 300
    assert 0 < len(moved) and torch.isin(moved, rows).all()


@pytest.mark.parametrize(
    ("settings", "text"),
    [({"finest": 0.0}, "lod.finest is 0"), ({"finest": 0.2}, "lod.coarsest"), ({"steps": -1}, "lod.steps is -1")],
)
def test_wrong_settings_are_one_line(settings, text):
    from surfkit.core.check import BadInput

    with pytest.raises(BadInput, match=text):
        Hierarchy(**settings)
