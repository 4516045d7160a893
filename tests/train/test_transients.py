"""Training on photographs with something else in each."""

from dataclasses import replace

import torch

from surfkit.losses import Robust
from surfkit.primitives.points import Points
from surfkit.train.checkpoint import load, save
from surfkit.train.stage import Stage

STAGE = Stage(steps=120, densify=None, sh_every=1_000)
ROBUST = replace(STAGE, transients=Robust(radius_px=2, start=0))


def passing(photos):
    """Photographs with a box each, where no other has it."""
    found = []
    for at, photo in enumerate(photos):
        changed = photo.clone()
        changed[:, 3 + at : 11 + at, 3 * at + 2 : 3 * at + 12] = torch.tensor([255, 0, 255])[:, None, None].byte()
        found.append(changed)
    return found


def error(tiny, trainer, params):
    """Mean colour error against the photographs without boxes."""
    splats, total = trainer.primitive.activate(params, 0), 0.0
    for view, photo in zip(tiny.views, tiny.photos, strict=True):
        total += float((tiny.rasterizer.render(splats, view.camera, 0.005).maps.color - photo / 255).abs().mean())
    return total / len(tiny.views)


def run(trainer, state):
    """Raw parameters at the end."""
    for _ in trainer.run(state):
        pass
    return state.points.all_params()


def test_a_model_of_the_scene_is_spoilt_less_by_what_passes(tiny, begin):
    params, boxes = run(*begin(replace(STAGE, steps=600))), passing(tiny.photos)
    errors = {}
    for name, stage, photos in (("clean", STAGE, tiny.photos), ("plain", STAGE, boxes), ("robust", ROBUST, boxes)):
        trainer, _ = begin(stage)
        trainer = replace(trainer, photos=photos)
        given = Points.fresh({key: value.clone() for key, value in params.items()})
        errors[name] = error(tiny, trainer, run(trainer, trainer.begin(given, torch.Generator().manual_seed(0))))
    spoilt = {name: errors[name] - errors["clean"] for name in ("plain", "robust")}
    assert spoilt["plain"] > 0.001 and spoilt["robust"] < 0.5 * spoilt["plain"], errors


def test_a_run_that_goes_on_has_the_same_bits_and_the_first_steps_those_of_none(tiny, begin, tmp_path):
    found = {}
    for name, stage in {"plain": STAGE, "late": replace(STAGE, transients=Robust(radius_px=2, start=60))}.items():
        trainer, state = begin(stage)
        trainer = replace(trainer, photos=passing(tiny.photos))
        for done in trainer.run(state):
            if done.index in (60, 80):
                save(tmp_path / f"{name}-{done.index}.safetensors", state)
        found[name] = state.points.params
    again = load(tmp_path / "late-80.safetensors")
    run(trainer, again)
    first, other = (load(tmp_path / f"{name}-60.safetensors").points.params for name in ("plain", "late"))
    for name, value in found["late"].items():
        assert torch.equal(value, again.points.params[name]) and torch.equal(first[name], other[name])
    assert not torch.equal(found["plain"]["means"], found["late"]["means"])
