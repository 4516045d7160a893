"""Primitives of a stranger's package: other columns, another activation, a way of their own to draw, a network."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

import surfkit
from surfkit import Activation, Column, Edit, LearningRate, Primitive, hookimpl, standard_columns
from surfkit.cli import main
from surfkit.core import registry
from surfkit.core.check import BadInput
from surfkit.densify.adc import ADC
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.splats.ply import read_splats
from surfkit.losses.photometric import L1
from surfkit.losses.reprojection import Reprojection
from surfkit.losses.surface import NormalConsistency
from surfkit.primitives.base import harmonics
from surfkit.primitives.edit import apply
from surfkit.primitives.init import seeds
from surfkit.primitives.points import Points
from surfkit.raster.api import Maps, Splats
from surfkit.raster.autograd import AutogradRender, DerivedRender
from surfkit.raster.reference import draw
from surfkit.raster.select import select
from surfkit.runs.pipeline import load_run
from surfkit.scene.camera import Camera
from surfkit.scene.photos import photo_cache
from surfkit.scene.scene import SparsePoints
from surfkit.testing import check_primitive
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.stage import Stage
from surfkit.train.trainer import Trainer


@dataclass(frozen=True)
class Balls(Primitive):
    """Balls: no rotations, one radius."""

    sh_degree: int = 1

    def columns(self):
        known = standard_columns(1, self.sh_degree)
        del known["quats"]
        return known

    def init(self, cloud, generator):
        return seeds(self.columns(), cloud)

    def activate(self, params, degree):
        means = params["means"]
        quats = means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4)
        scales = params["scales"].exp().expand(-1, 3)
        colors = params["sh0"], harmonics(params, degree)
        return Splats("gaussian", means, quats, scales, params["opacities"].sigmoid(), *colors)


DENSITY = Activation(lambda raw: 1 - torch.exp(-torch.exp(raw)), lambda value: torch.log(-torch.log1p(-value)))


@dataclass(frozen=True)
class Fog(Primitive):
    """Discs whose opacity is 1 - exp(-exp(x))."""

    sh_degree: int = 1

    def columns(self):
        return standard_columns(2, self.sh_degree) | {"opacities": Column((), LearningRate(0.02), DENSITY)}

    def init(self, cloud, generator):
        return seeds(self.columns(), cloud) | {"quats": torch.randn(len(cloud.xyz), 4, generator=generator)}

    def activate(self, params, degree):
        opacities = DENSITY.value(params["opacities"])
        parts = params["means"], params["quats"], params["scales"].exp(), opacities
        return Splats("surfel", *parts, params["sh0"], harmonics(params, degree))


@dataclass(frozen=True)
class Pairs(Primitive):
    """Points that a network, common to all, moves and colours: two balls each. Drawn by the usual rasterizer."""

    in_ply: ClassVar[bool] = False

    sh_degree: int = 0

    def columns(self):
        known = standard_columns(1, 0)
        keep = {name: known[name] for name in ("means", "scales", "opacities", "sh0")}
        net = Column((4, 6), LearningRate(1e-2), shared=True)
        return keep | {"feature": Column((4,), LearningRate(1e-2)), "net": net}

    def init(self, cloud, generator):
        feature = torch.randn(len(cloud.xyz), 4, generator=generator)
        return seeds(self.columns(), cloud) | {"feature": feature, "net": 0.01 * torch.randn(4, 6, generator=generator)}

    def activate(self, params, degree):
        means = params["means"]
        quats, scales = means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4), params["scales"].exp().expand(-1, 3)
        return Splats(
            "anchor", means, quats, scales, params["opacities"].sigmoid(), params["sh0"],
            extra={"feature": params["feature"]}, shared={"net": params["net"]},
        )  # fmt: skip

    def derive(self, anchors):
        made = anchors.extra["feature"] @ anchors.shared["net"]
        shift = torch.cat([torch.zeros_like(anchors.means), made[:, :3] * anchors.scales])
        twice = [torch.cat([value, value]) for value in anchors.tensors().values()]
        twice[0] = twice[0] + shift
        twice[4] = twice[4] + torch.cat([torch.zeros_like(made[:, None, 3:]), made[:, None, 3:]])
        return Splats("gaussian", *twice), torch.arange(len(anchors)).repeat(2)

    def render(self, splats, camera, rasterizer, near, geometry=True, distortion=True):
        return DerivedRender(
            splats, camera, self.derive, lambda made: rasterizer.render(made, camera, near, geometry, distortion)
        )

    def contribution(self, splats, camera, rasterizer, near, alpha_power, transmittance_power):
        made, owner = self.derive(splats.detached())
        found = rasterizer.contribution(made, camera, near, alpha_power, transmittance_power)
        return tuple(value.new_zeros(len(splats)).index_add(0, owner, value) for value in found)


@dataclass(frozen=True)
class Rigid(Balls):
    """Balls that move all together, as a shared column says."""

    has_free_points: ClassVar[bool] = False

    def columns(self):
        known, fixed = Balls.columns(self), LearningRate(0.0)
        return known | {
            "means": replace(known["means"], rate=fixed),
            "offsets": Column((3,), fixed),
            "moves": Column((None, 3), LearningRate(1e-3), shared=True),
        }

    def init(self, cloud, generator):
        begun = Balls.init(self, cloud, generator)
        return begun | {"offsets": begun["means"].clone(), "moves": torch.zeros(2, 3)}

    def dependent(self, params):
        return {"means": params["offsets"].detach() + params["moves"].sum(0)}

    def activate(self, params, degree):
        return Balls.activate(self, params | self.dependent(params), degree)


@dataclass(frozen=True)
class Late(Rigid):
    """Begins with other positions than it says."""

    def dependent(self, params):
        return {"means": params["offsets"] + 0.1}

    def activate(self, params, degree):
        return Balls().activate(params | {"means": params["offsets"]}, degree)


@dataclass(frozen=True)
class Drawn(Balls):
    """Balls that torch draws."""

    has_absolute_gradients: ClassVar[bool] = False

    def render(self, splats, camera, rasterizer, near, geometry=True, distortion=True):
        true = rasterizer.render(splats, camera, near, False, False)
        return AutogradRender(splats, camera, lambda s: draw(s, camera, near).maps, true.seen, true.radii)


@dataclass(frozen=True)
class Boasting(Drawn):
    """Declares gradients that it does not have."""

    has_absolute_gradients: ClassVar[bool] = True


@dataclass(frozen=True)
class Small(Balls):
    """Draws half a picture."""

    def render(self, splats, camera, rasterizer, near, geometry=True, distortion=True):
        return rasterizer.render(splats, replace(camera, width=camera.width // 2), near, geometry, distortion)


@dataclass(frozen=True)
class Bare(Balls):
    """Draws a few maps, whatever is asked for."""

    maps: tuple[str, ...] = ("color", "alpha")

    def render(self, splats, camera, rasterizer, near, geometry=True, distortion=True):
        render = rasterizer.render(splats, camera, near)
        render.maps = Maps(**{name: getattr(render.maps, name) for name in self.maps})
        return render


class Package:
    @hookimpl
    def surfkit_components(self):
        return {
            "balls": Balls,
            "fog": Fog,
            "pairs": Pairs,
            "drawn": Drawn,
            "small": Small,
            "bare": Bare,
            "rigid": Rigid,
        }


@pytest.fixture(scope="module", autouse=True)
def installed():
    registry.plugins().register(Package(), "stranger")
    yield
    registry.plugins().unregister(name="stranger")


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    write_colmap(folder, photograph(Flight(views=12, width=40, height=30, points=150)))
    return folder


@pytest.mark.parametrize(
    "primitive", [Balls(), Fog(), Pairs(), Drawn(), Rigid()], ids=["balls", "fog", "pairs", "drawn", "rigid"]
)
def test_they_keep_the_contract(primitive):
    check_primitive(primitive)


@pytest.mark.parametrize(
    ("primitive", "fault"),
    [
        (Boasting(), "Boasting.render: set has_absolute_gradients to False: signal: absolute pixel gradients"),
        (Small(), "primitive small: its render gives color of shape"),
        (Late(), "Late.init gives 'means' other values than dependent does"),
    ],
)
def test_a_render_that_is_not_as_declared_is_named(primitive, fault):
    with pytest.raises(AssertionError, match=fault):
        check_primitive(primitive)


def test_columns_that_others_determine_follow_after_each_step(source, tmp_path, capsys):
    assert train(source, tmp_path / "refused", "recipe:3dgs", "primitive:rigid") == 2
    told = "pretrain.densify: the points of primitive rigid can be neither copied nor split; leave it out"
    assert told in capsys.readouterr().err
    words = ("train", "recipe:3dgs", "primitive:rigid", "mesh:none", "pretrain.densify:none", "--data", str(source))
    assert main([*words, "--steps", "7", "--out", str(tmp_path / "run")]) == 0
    params = load_run(tmp_path / "run")[1].points.all_params()
    moved = params["moves"].sum(0)
    assert moved.abs().min() > 1e-4 and torch.equal(params["means"], params["offsets"] + moved)


def test_sizes_that_are_known_with_the_points_only_are_for_shared_columns():
    shared = Column((None, 3), LearningRate(0.0), shared=True)
    assert shared.fits((7, 3), 5) and shared.fits((0, 3), 5)
    assert not shared.fits((7, 2), 5) and not shared.fits((3,), 5)
    assert Column((3,), LearningRate(0.0)).fits((5, 3), 5) and not Column((3,), LearningRate(0.0)).fits((7, 3), 5)
    with pytest.raises(BadInput, match="shared parameter .*None"):
        Column((None, 3), LearningRate(0.0))


def notes(out):
    return json.loads((out / "run.json").read_text())["notes"]


SHORT = ("--steps", "20", "--pretrain.densify.start", "4", "--pretrain.densify.every", "5")


def train(source, out, *words):
    return main(["train", *words, "--data", str(source), "--out", str(out), "mesh:none", *SHORT])


@pytest.mark.parametrize("name", ["balls", "fog", "pairs"])
def test_one_word_swaps_the_primitive(source, tmp_path, name, capsys):
    """Trained, resumed after a stop in the middle to the same bits, and measured."""
    words = ["recipe:2dgs", f"primitive:{name}"] + ["--pretrain.losses.normal.weight", "0"] * (name != "fog")
    assert train(source, tmp_path / "whole", *words) == 0
    metrics = json.loads((tmp_path / "whole" / "metrics.json").read_text())
    assert metrics["images"]["psnr"] > 8 and (tmp_path / "whole" / "point_cloud.ply").exists() == (name != "pairs")
    _, state, _ = load_run(tmp_path / "whole")
    assert set(state.points.all_params()) == set(registry.components(Primitive)[name]().columns())
    if name == "pairs":
        assert state.points.shared["net"].abs().max() > 0.05, "the network learns"
        assert any("no point_cloud.ply" in text and "pairs" in text for text in notes(tmp_path / "whole"))


def test_a_network_goes_on_as_if_nothing_had_happened(source, tmp_path):
    """Half of the steps, saved and read again, then the rest: the same bits as all at once."""
    scene = read(Data(source))
    trainer = Trainer(Stage(steps=12), Pairs(), scene.train, photo_cache(scene.train), select("cpu")[0])

    def begin():
        draw = torch.Generator().manual_seed(0)
        return trainer.begin(Points.fresh(Pairs().init(scene.cloud, draw), ["net"]), draw)

    whole, half = begin(), begin()
    for _ in trainer.run(whole):
        pass
    for _ in range(6):
        trainer.step(half)
    checkpoint.save(tmp_path / "half.safetensors", half)
    again = checkpoint.load(tmp_path / "half.safetensors")
    for _ in trainer.run(again):
        pass
    assert again.index == 12 and whole.points.exp_avg["net"].abs().max() > 0
    for group in ("params", "exp_avg", "exp_avg_sq", "shared"):
        for name, value in getattr(whole.points, group).items():
            assert torch.equal(value, getattr(again.points, group)[name]), (group, name)


def test_the_opacity_drawn_is_the_opacity_written(tmp_path, source):
    assert train(source, tmp_path / "run", "recipe:3dgs", "primitive:fog") == 0
    run, state, _ = load_run(tmp_path / "run")
    drawn = run.last.primitive.activate(state.points.params, 0).opacities
    table = read_splats(tmp_path / "run" / "point_cloud.ply")
    assert torch.allclose(table.opacity_logits.sigmoid(), drawn, atol=1e-6)
    points = Points.fresh(
        Fog().init(SparsePoints(torch.rand(2, 3), torch.zeros(2, 3, dtype=torch.uint8)), torch.Generator())
    )
    points.params["opacities"].zero_()  # drawn as 0.632
    lowered = apply(Fog(), points, Edit(max_opacity=0.3), torch.Generator())
    assert Fog().activate(lowered.params, 0).opacities.tolist() == pytest.approx([0.3, 0.3])


def test_blocks_with_a_network_are_merged_by_the_stated_rule(source, tmp_path):
    words = "recipe:citygs2 primitive:pairs --min-views 4 --partition.blocks 2 1 assign:picture-share --steps 8".split()
    words += ["pretrain.losses.normal:none", "tune.losses.normal:none", "mesh:none", "depth:none"]
    assert main(["train", *words, "--data", str(source), "--out", str(tmp_path)]) == 0
    _, merged, _ = load_run(tmp_path)
    shares = json.loads((tmp_path / "blocks" / "merge.json").read_text())["blocks"]
    folders = [tmp_path / "blocks" / f"{share['index']:03}" / "tune" for share in shares]
    nets = [checkpoint.load(folder / "checkpoint.safetensors").points.shared["net"].numpy() for folder in folders]
    kept = np.array([share["kept"] for share in shares], float)
    assert len(nets) == 2 and not np.allclose(*nets)
    assert np.allclose(merged.points.shared["net"].numpy(), np.average(nets, axis=0, weights=kept), atol=1e-6)


def test_what_does_not_fit_is_refused_before_anything_is_trained(source, tmp_path, capsys):
    assert train(source, tmp_path / "a", "recipe:3dgs", "primitive:pairs", "refine.0:distil") == 2
    assert "refine.0: distil cuts the column sh_rest" in capsys.readouterr().err
    assert not (tmp_path / "a" / "pretrain").exists()
    with pytest.raises(BadInput, match="pretrain.rates.wings: .*surfel2d .*means"):
        recipe = surfkit.Recipe(pretrain=surfkit.Stage(rates={"wings": LearningRate(1.0)}))
        recipe.refuse_unfit()


def test_absolute_gradients_that_torch_does_not_have_are_refused(source, tmp_path, capsys):
    assert train(source, tmp_path / "a", "recipe:absgs", "primitive:drawn") == 2
    told = capsys.readouterr().err
    assert "pretrain.signal: abs-gradient wants" in told
    assert "choose pretrain.signal:loss-gradient" in told and not (tmp_path / "a" / "pretrain").exists()
    words = "recipe:absgs", "primitive:drawn", "pretrain.signal:loss-gradient"
    assert train(source, tmp_path / "b", *words) == 2
    assert "adc needs absolute pixel gradients, and signal loss-gradient" in capsys.readouterr().err
    words = *words, "--pretrain.densify.split-threshold", "None"
    assert train(source, tmp_path / "b", *words, "--pretrain.steps", "2") == 0


def test_unknown_kinds_are_refused_not_drawn_as_gaussians():
    splats = Pairs().activate(
        Pairs().init(
            SparsePoints(torch.rand(5, 3), torch.zeros(5, 3, dtype=torch.uint8)), torch.Generator().manual_seed(0)
        ),
        0,
    )
    camera = Camera(torch.eye(4, dtype=torch.float64), 20.0, 20.0, 8.0, 8.0, 16, 16)
    for name in ("native", "reference"):
        with pytest.raises(BadInput, match="'anchor': .*surfels and gaussians"):
            select(name)[0].render(splats, camera, 0.01)


def test_a_view_that_torch_draws_has_the_gradients_of_the_reference():
    """`AutogradRender` around the reference's own drawing, against the reference's way back."""
    params = Balls().init(
        SparsePoints(torch.rand(12, 3) - 0.5, torch.full((12, 3), 90, dtype=torch.uint8)), torch.Generator()
    )
    params["scales"] -= 1
    splats = Balls().activate(params, 0).detached()
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 2
    camera = Camera(pose, 20.0, 20.0, 8.0, 8.0, 16, 16)
    true = select("reference")[0].render(splats, camera, 0.01)
    own = AutogradRender(splats, camera, lambda s: draw(s, camera, 0.01).maps, true.seen, true.radii)
    cotangent = type(true.maps)(color=torch.randn(3, 16, 16))
    a, b = true.backward(cotangent, cotangent), own.backward(cotangent, cotangent)
    with pytest.raises(BadInput, match="absolute .*signal:loss-gradient"):
        own.backward(cotangent, cotangent, absolute=True)
    for name, value in a.tensors().items():
        assert torch.allclose(value, b.tensors()[name], atol=1e-6), name
    seen = a.signal.norm(dim=1) > 1e-4
    ratio = b.signal.norm(dim=1)[seen] / a.signal.norm(dim=1)[seen]
    assert seen.any() and float(ratio.median()) == pytest.approx(1, abs=0.15), "the signal is that of the screen"


def test_policies_are_told_what_was_drawn_in_place_of_the_points(source):
    """The two balls of each anchor, their owners and their signals, whose sum is that of the anchor."""
    told = []

    class Watching(ADC):
        def watch(self, points, step):
            told.append(step)

    scene = read(Data(source))
    stage = Stage(steps=1, densify=Watching())
    trainer = Trainer(stage, Pairs(), scene.train, photo_cache(scene.train), select("cpu")[0])
    draw = torch.Generator().manual_seed(0)
    params = Pairs().init(scene.cloud, draw)
    far = {name: value if name == "net" else value[:7].clone() for name, value in params.items()}
    del far["net"]
    trainer.step(trainer.begin(Points.fresh(params, ["net"]), draw, far))
    step, count = told[0], len(scene.cloud.xyz)
    derived = step.derived
    assert derived.owner.tolist() == list(range(count)) * 2, "none of frozen points"
    assert derived.splats.kind == "gaussian" and len(derived.splats) == len(derived.seen) == 2 * count
    assert torch.equal(derived.grad_norm, derived.signal.norm(dim=1)) and derived.grad_norm.any()
    total = derived.signal[:count] + derived.signal[count:]
    assert torch.allclose(total.norm(dim=1), step.grad_norm, rtol=1e-4, atol=1e-12)
    assert torch.equal(derived.seen[:count] | derived.seen[count:], step.seen)
    told.clear()
    trainer = Trainer(stage, Balls(), scene.train, photo_cache(scene.train), select("cpu")[0])
    trainer.step(trainer.begin(Points.fresh(Balls().init(scene.cloud, draw)), draw))
    assert told[0].derived is None


def begun(stage, primitive, scene):
    trainer = Trainer(stage, primitive, scene.train, photo_cache(scene.train), select("reference")[0])
    draw = torch.Generator().manual_seed(0)
    return trainer, trainer.begin(Points.fresh(primitive.init(scene.cloud, draw)), draw)


def test_pictures_of_another_size_are_refused_in_one_line(source):
    trainer, state = begun(Stage(steps=2), Small(), read(Data(source)))
    with pytest.raises(BadInput, match=r"small: .*color of shape \(3, 30, 20\)"):
        trainer.step(state)


@pytest.mark.parametrize(
    ("maps", "loss", "lacking"),
    [
        (("color",), L1(), "alpha, which every view needs"),
        (("alpha",), L1(), "color, which every view needs"),
        (("color", "alpha", "depth", "median"), NormalConsistency(start=2), "normal, which losses.late reads"),
        (
            ("color", "alpha", "depth"),
            Reprojection(start=2),
            "median, which losses.late reads; leave .* losses.late",
        ),
    ],
)
def test_maps_that_a_render_leaves_out_are_named_in_the_first_step(source, maps, loss, lacking):
    stage = Stage(steps=4, losses={"l1": L1(), "late": loss})
    trainer, state = begun(stage, Bare(maps=maps), read(Data(source)))
    with pytest.raises(BadInput, match=f"bare: .*no {lacking}"):
        trainer.step(state)


def test_maps_that_no_loss_reads_may_be_left_out(source):
    trainer, state = begun(Stage(steps=2, losses={"l1": L1()}), Bare(), read(Data(source)))
    trainer.step(state)
    assert state.index == 1
