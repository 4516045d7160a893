"""The network against one of torch's modules in float64, and trainings on photographs whose light differs."""

from dataclasses import replace
from pathlib import Path

import pytest
import surfkit_decoupled
import torch
from surfkit_decoupled.appearance import Decoupled
from surfkit_decoupled.layers import doubled
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from surfkit.core.codec import dump, load
from surfkit.core.registry import plugins
from surfkit.io.datasets.data import Data
from surfkit.partition import QuantileGrid
from surfkit.plugin import L1, SSIM, Appearance, BadInput, Camera, Points, Recipe, SparsePoints, Stage, View, components
from surfkit.primitives import Surfel2D
from surfkit.raster.select import select
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import load_run, run
from surfkit.runs.run_stage import Intervals
from surfkit.testing import check
from surfkit.testing.simulated_gpu import OnSimulatedGpu, is_there, simulated_gpu
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.checkpoint import load as load_state
from surfkit.train.checkpoint import save as save_state
from surfkit.train.trainer import Trainer

SMALL = Decoupled(length=8, widths=(16, 8), rate=5e-3)
"""For pictures of some pixels: squares of 4 x 4."""
WIDTH, HEIGHT = 28, 22


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = Decoupled in components(Appearance).values()
    if not there:
        plugins().register(surfkit_decoupled, "decoupled of this test")
    yield
    if not there:
        plugins().unregister(surfkit_decoupled)


def camera(x=0.0, y=0.0) -> Camera:
    """At (x, y, 1), looking along -z."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, y, 1.0], dtype=torch.float64)
    return Camera(pose, 30.0, 30.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def some_numbers(model: Decoupled, seed=0) -> torch.Tensor:
    """(E + S,) float64, such that the map is not 1."""
    draw = torch.Generator().manual_seed(seed)
    shared = model.begin_shared().double()
    shared += 0.05 * torch.randn(shared.shape, generator=draw, dtype=torch.float64)
    return torch.cat([model.begin(1)[0].double(), shared])


def of_modules(model: Decoupled, numbers: torch.Tensor, color: torch.Tensor) -> torch.Tensor:
    """The map by torch's modules, and a loop over squares."""
    side, (height, width) = 2 ** len(model.widths), color.shape[1:]
    small = torch.stack(
        [
            torch.stack([color[:, y : y + side, x : x + side].mean((1, 2)) for x in range(0, width, side)], 1)
            for y in range(0, height, side)
        ],
        1,
    )
    embedding = numbers[: model.length, None, None].expand(-1, *small.shape[1:])
    layers = [nn.Conv2d(3 + model.length, model.widths[0], 3, padding=1), nn.ReLU()]
    for taken, made in zip(model.widths, model.widths[1:], strict=False):
        layers += [nn.PixelShuffle(2), nn.Conv2d(taken // 4, made, 3, padding=1), nn.ReLU()]
    body = nn.Sequential(*layers, nn.Upsample(scale_factor=2, mode="bilinear")).double()
    last = model.widths[-1]
    head = nn.Sequential(nn.Conv2d(last, last, 3, padding=1), nn.ReLU(), nn.Conv2d(last, 3, 3, padding=1)).double()
    nn.utils.vector_to_parameters(numbers[model.length :], [*body.parameters(), *head.parameters()])
    return 1 + head(body(torch.cat([small, embedding])[None])[..., :height, :width])[0]


@pytest.mark.parametrize("model", [SMALL, Decoupled(length=2, widths=(3,)), Decoupled()], ids=["small", "one", "paper"])
@pytest.mark.parametrize("size", [(22, 28), (33, 70), (1, 5)])
def test_the_map_is_that_of_torchs_modules(model, size):
    color = torch.rand(3, *size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    numbers = some_numbers(model)
    expected = of_modules(model, numbers, color)
    found = model.map_of(numbers, color)
    assert (expected - 1).abs().max() > 0.02
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    assert torch.equal(model(numbers, color, camera()), color * found)


def test_it_has_the_channels_of_the_paper():
    shapes = [tuple(weight.shape[:2]) for weight, _ in Decoupled()._layers(Decoupled().begin_shared())]
    assert shapes == [(256, 67), (128, 64), (64, 32), (32, 16), (16, 8), (16, 16), (3, 16)]


def test_gradients_are_those_of_differences():
    model = Decoupled(length=2, widths=(4, 2))
    numbers = some_numbers(model, 3).requires_grad_()
    color = torch.rand(3, 5, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda *given: model(*given, camera()), (numbers, color), eps=1e-7, atol=1e-6)
    image = torch.rand(1, 2, 3, 1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(doubled, (image,))


@pytest.mark.parametrize("model", [SMALL, Decoupled()], ids=["small", "paper"])
def test_it_keeps_to_the_contract(model):
    check(model)
    assert load(Decoupled, dump(model)) == model


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"length": 0}, "length is 0; give 1 to 1024"),
        ({"widths": ()}, "widths has 0 entries; give 1 to 8"),
        ({"widths": (8, 0)}, "widths has 0; give 1 to 1024"),
        ({"widths": (6, 4)}, "widths has 6 before its last; give a multiple of 4"),
        ({"rate": 0.0}, "rate is 0; give more than 0"),
        ({"rate": float("nan")}, "rate is nan"),
    ],
)
def test_settings_that_make_no_sense_are_refused(setting, said):
    with pytest.raises(BadInput, match=f"decoupled.{said}"):
        Decoupled(**setting)


def trainer_of(stage: Stage) -> tuple[Trainer, callable]:
    """Of six photographs of discs on a plane, which a shade darkens from one side or the other; a function that gives
    the state to begin with."""
    draw, count = torch.Generator().manual_seed(3), 40
    means = torch.rand(count, 3, generator=draw) * torch.tensor([1.0, 1.0, 0.05]) - torch.tensor([0.5, 0.5, 0])
    cloud = SparsePoints(means, torch.randint(60, 255, (count, 3), generator=draw, dtype=torch.uint8))
    primitive, rasterizer = Surfel2D(sh_degree=0), select("cpu")[0]
    params = primitive.init(cloud, torch.Generator().manual_seed(0))
    params["opacities"] += 3.0
    truth = primitive.activate(params, 0)
    views, photos, shade = [], [], torch.linspace(0.3, 1, WIDTH)
    for at in range(6):
        views.append(View(f"{at}.png", camera(0.1 * (at % 3) - 0.1, 0.1 * (at // 3)), Path(f"{at}.png")))
        image = rasterizer.render(truth, views[-1].camera, 0.005, geometry=False).maps.color
        photos.append((image.clamp(0, 1) * (shade.flip(0) if at % 2 else shade) * 255).round().to(torch.uint8))

    def begin(stage=stage, where=rasterizer):
        trainer = Trainer(stage, primitive, tuple(views), photos, where)
        generator = torch.Generator().manual_seed(0)
        return trainer, trainer.begin(Points.fresh(primitive.init(cloud, generator)), generator)

    return begin


def test_shades_of_photographs_are_learned_and_a_resumed_run_has_the_same_bits(tmp_path):
    stage = Stage(steps=240, densify=None, sh_every=1_000)
    begin, left, shown = trainer_of(stage), {}, {}
    for name, appearance in (("none", None), ("decoupled", SMALL)):
        trainer, state = begin(replace(stage, appearance=appearance))
        losses = []
        for done in trainer.run(state):
            losses.append(done.losses["l1"])
            if done.index == 100:
                save_state(tmp_path / f"{name}.safetensors", state)
        left[name], shown[name] = sum(losses[-60:]), state
    assert left["decoupled"] < 0.7 * left["none"]
    table = shown["decoupled"].appearances
    for at in (0, 1):
        color = torch.full((3, HEIGHT, WIDTH), 0.5)
        gain = SMALL.map_of(torch.cat([table["value"][at], table["shared"]]), color).mean((0, 1))
        sides = gain[: WIDTH // 3].mean(), gain[-WIDTH // 3 :].mean()
        dark, light = sides if at == 0 else reversed(sides)
        assert dark < 0.8 * light, "as the photograph is"
    again = load_state(tmp_path / "decoupled.safetensors")
    trainer, _ = begin(replace(stage, appearance=SMALL))
    list(trainer.run(again))
    assert again.appearances.keys() == table.keys()
    for name, value in (shown["decoupled"].points.params | table).items():
        assert torch.equal((again.points.params | again.appearances)[name], value), name


def test_a_step_has_the_same_bits_on_any_number_of_threads():
    begin, before, found = trainer_of(Stage(steps=4, densify=None, appearance=Decoupled())), torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            trainer, state = begin()
            list(trainer.run(state))
            found.append(state.points.params | state.appearances)
    finally:
        torch.set_num_threads(before)
    assert found[0]["shared"].any()
    for name, value in found[0].items():
        assert torch.equal(found[1][name], value), name


class Convolutions(TorchDispatchMode):
    """Whether cuDNN was told to sum in a fixed order, for each convolution either way."""

    def __init__(self):
        super().__init__()
        self.found, self.others = {}, set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.partition("::")[2]
        self.others.add(name)
        if name.startswith("convolution"):
            settings = torch.backends.cudnn
            self.found.setdefault(name, set()).add((settings.deterministic, settings.benchmark, settings.allow_tf32))
        return func(*args, **(kwargs or {}))


def test_on_a_gpu_all_is_there_and_sums_have_an_order():
    begin = trainer_of(Stage(steps=3, densify=None, appearance=SMALL))
    with simulated_gpu():
        trainer, state = begin(where=OnSimulatedGpu(select("cpu")[0]))
        with Convolutions() as seen:
            list(trainer.run(state))
        table = state.appearances
        assert all(is_there(value) for name, value in table.items() if name != "shown")
        assert table["shared"].cpu().any() and table["shown"].sum() == 3
    ordered = (True, False, False)
    assert seen.found == {"convolution": {ordered}, "convolution_backward": {ordered}}
    assert not {name for name in seen.others if "upsample" in name or "adaptive" in name or "pad" in name}


def test_a_stage_without_structure_is_refused():
    for losses in ({"l1": L1()}, {"l1": L1(), "ssim": SSIM(weight=0.0)}):
        recipe = Recipe(pretrain=Stage(steps=4, appearance=Decoupled(), losses=losses))
        with pytest.raises(BadInput, match=r"pretrain.appearance: decoupled .*only l1 count; add .*losses.ssim:ssim"):
            recipe.refuse_unfit()


def test_blocks_learn_networks_of_which_nothing_is_left_in_the_whole(tmp_path):
    write_colmap(tmp_path / "scene", photograph(Flight(views=12, width=32, height=24, points=120)))
    stage, out = Stage(steps=8, appearance=SMALL), tmp_path / "run"
    recipe = Recipe(pretrain=stage, partition=QuantileGrid((2, 1)), tune=stage, mesh=None)
    run(recipe, Data(tmp_path / "scene"), out, Compute("cpu"), Intervals(checkpoint=4, pictures=0))
    parts = [load_state(out / "blocks" / name / "tune" / "checkpoint.safetensors") for name in ("000", "001")]
    for part in parts:
        assert part.appearances["shown"].sum() == 8
        assert not torch.equal(part.appearances["shared"], SMALL.begin_shared())
    whole = load_run(out)[1]
    assert torch.equal(whole.appearances["shared"], SMALL.begin_shared())
    assert not whole.appearances["shared_first"].any() and not whole.appearances["shown"].any()
    colors = torch.cat([part.points.params["sh0"] for part in parts])
    assert all((colors == row).all((1, 2)).any() for row in whole.points.params["sh0"]), "as blocks have them"
