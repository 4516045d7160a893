"""The fields with their optimiser, and the file from which an interrupted training goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from surfkit.plugin import BadInput, replacing
from surfkit.train.adam import update
from surfkit_neus.field import BackgroundField, SurfaceField

FORMAT = "surfkit-neus-1"


@dataclass
class State:
    """What training changes.

    Attributes:
        field: In the box.
        background: Beyond it.
        moments: First and second moments of Adam of each parameter, by its name.
        index: Steps made.
    """

    field: SurfaceField
    background: BackgroundField
    moments: dict[str, tuple[Tensor, Tensor]]
    index: int = 0

    @classmethod
    def begin(cls, field: SurfaceField, background: BackgroundField) -> State:
        """Before the first step."""
        state = cls(field, background, {})
        state.moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in state.parameters().items()}
        return state

    def parameters(self) -> dict[str, nn.Parameter]:
        """All parameters by name; those of hash tables end in "table"."""
        parts = {"field": self.field, "background": self.background}
        return {f"{part}.{name}": p for part, module in parts.items() for name, p in module.named_parameters()}

    @torch.no_grad()
    def descend(self, rates: Mapping[str, float], decay: float) -> None:
        """Take step `index` + 1 of Adam with decoupled weight decay, and forget the gradients.

        Args:
            rates: Learning rate of each parameter, by its name.
            decay: The share of the rate by which parameters shrink.
        """
        self.index += 1
        for name, value in self.parameters().items():
            if value.grad is None:
                continue
            value.mul_(1 - rates[name] * decay)
            update(value.data, value.grad.contiguous(), *self.moments[name], rates[name], self.index)
            value.grad = None

    def write(self, path: Path) -> None:
        """Put the state in the place of the one that the file held."""
        tensors = {name: value.detach() for name, value in self.parameters().items()}
        for name, (first, second) in self.moments.items():
            tensors |= {f"first.{name}": first, f"second.{name}": second}
        plain = {name: value.cpu().contiguous() for name, value in tensors.items()}
        with replacing(path) as file:
            file.write(save(plain, {"format": FORMAT, "index": str(self.index)}))

    @torch.no_grad()
    def read(self, path: Path) -> None:
        """Take over the state in a file.

        Raises:
            BadInput: It holds none, or one of other sizes.
        """
        again = f"delete {path.parent}, and the surfkit train command of the run begins again"
        try:
            with safe_open(path, "pt") as file:
                facts = file.metadata() or {}
                found = {name: file.get_tensor(name) for name in file.keys()}
            if facts.get("format") != FORMAT:
                raise BadInput(f"{path}: format {facts.get('format')!r}, not {FORMAT!r}; {again}")
            index = int(facts["index"])
            for name, value in self.parameters().items():
                for key, into in zip(("", "first.", "second."), (value, *self.moments[name]), strict=True):
                    if found[key + name].shape != into.shape:
                        raise BadInput(f"{path}: {key + name} has another shape than the settings say; {again}")
                    into.copy_(found[key + name])
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            if isinstance(error, BadInput):
                raise
            raise BadInput(f"{path}: damaged ({' '.join(str(error).split())}); {again}") from error
        self.index = index
