"""kornia, and weights of its networks: from a file, or from where kornia downloads them."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.optional import needed


def load_kornia(what: str) -> Any:
    """The module kornia.feature.

    Args:
        what: It is needed for, such as features:disk.

    Raises:
        BadInput: kornia is missing, cannot be loaded, or is too old.
    """
    with needed("kornia", what):
        import kornia
        import kornia.feature
    if not hasattr(kornia.feature, "convert_sift_descriptor_layout"):
        raise BadInput(f"{what} needs kornia 0.9 or newer, this is {kornia.__version__}: pip install -U kornia")
    return kornia.feature


def network_of(
    what: str, option: str, weights: Path | None, download: Callable[[], Any], build: Callable[[], Any], source: str
) -> Any:
    """A network in evaluation mode.

    Args:
        what: Its name, for messages, such as features:disk.
        option: That gives the file of weights.
        weights: The file; None downloads them, once.
        download: The network with weights that kornia downloads and keeps.
        build: The network without.
        source: Where the weights can be had, for messages.

    Raises:
        BadInput: Weights cannot be downloaded, or the file holds others.
    """
    if weights is None:
        try:
            return download().eval()
        except Exception as error:  # of urllib, http, torch, or of kornia itself
            said = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            raise BadInput(
                f"{what}: its weights cannot be downloaded: get {source} on a machine with a network, and give "
                f"the file with {option} FILE ({said})"
            ) from error
    network = build()
    state = _renamed(_read(what, option, weights))
    known = network.state_dict()
    own = {name for name, _ in network.named_parameters()} | {name for name in known if "running_" in name}
    kept = {name: value for name, value in state.items() if name in known}
    wrong = [name for name in sorted(own) if name not in kept or kept[name].shape != known[name].shape]
    if wrong:
        raise BadInput(
            f"{option} {weights}: not the weights of {what}: {len(wrong)} of {len(own)} tensors are missing or of "
            f"another shape, such as {wrong[0]}; give {source}"
        )
    network.load_state_dict(kept, strict=False)
    return network.eval()


def _read(what: str, option: str, path: Path) -> Mapping[str, Any]:
    """What torch finds in a file of weights."""
    if not path.is_file():
        raise BadInput(f"{option} {path}: no such file; name one with the weights of {what}, as torch saves them")
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        said = " ".join(str(error).split())[:100]
        raise BadInput(f"{option} {path}: torch cannot read weights from it ({said}); download it again") from error
    if not isinstance(found, dict):
        raise BadInput(f"{option} {path}: holds {type(found).__name__}, not a dict of tensors; give another file")
    return found


def _renamed(found: Mapping[str, Any]) -> dict[str, Tensor]:
    """Tensors by the names of kornia: published files of DISK have them in a dict of their own, and those of LightGlue
    number self-attention and cross-attention apart."""
    inner = found.get("extractor", found)
    renamed = {}
    for name, value in inner.items():
        first, _, rest = name.removeprefix("matcher.").partition(".")
        number, _, last = rest.partition(".")
        name = f"transformers.{number}.{first}.{last}" if first in ("self_attn", "cross_attn") else f"{first}.{rest}"
        if isinstance(value, Tensor):
            renamed[name.rstrip(".")] = value
    return renamed
