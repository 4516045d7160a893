from dataclasses import replace

import torch

from surfkit.appearance import Exposure
from surfkit.train.checkpoint import load, save
from surfkit.train.stage import Stage


def test_each_photograph_learns_its_own_exposure(begin, tmp_path):
    gains = torch.tensor([1.0, 0.5, 1.0, 0.5, 1.0, 0.5])
    stage = Stage(steps=240, densify=None, sh_every=1_000)
    plain, learned = {}, {}
    for way, found in ((stage, plain), (replace(stage, appearance=Exposure(5e-2, 5e-3)), learned)):
        trainer, state = begin(way)
        photos = [(photo * gain).byte() for photo, gain in zip(trainer.photos, gains, strict=True)]
        trainer = replace(trainer, photos=photos)
        losses = []
        for done in trainer.run(state):
            losses.append(done.losses["l1"])
            if done.index == 100:
                save(tmp_path / "c.safetensors", state)
        found |= {"loss": sum(losses[-60:]), "state": state, "trainer": trainer}
    assert learned["loss"] < 0.65 * plain["loss"]
    value = learned["state"].appearances["value"]
    grey = torch.tensor([0.4, 0.4, 0.4, 1.0])
    bright, dark = ((value[gains == gain] @ grey).mean() for gain in (1.0, 0.5))
    assert 0.35 < dark / bright < 0.65
    assert learned["state"].appearances["shown"].tolist() == [40] * 6
    again = load(tmp_path / "c.safetensors")
    list(learned["trainer"].run(again))
    assert torch.equal(again.appearances["value"], value)
    assert torch.equal(again.points.params["sh0"], learned["state"].points.params["sh0"])
