"""For primitives that draw themselves: views whose way back is torch's autograd.

`AutogradRender` is a view drawn by differentiable torch code. `DerivedRender` is a view of other splats, which are made
of the given ones for one camera, such as Gaussians from anchors with a network, or a level of detail.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.raster.api import STANDARD, Derived, Gradients, Maps, Render, Splats
from surfkit.scene.camera import Camera


def _leaves(splats: Splats) -> dict[str, Tensor]:
    return {name: value.detach().requires_grad_() for name, value in splats.named().items()}


def _signal(means: Tensor, gradient: Tensor, camera: Camera) -> Tensor:
    """(N, 2) the gradient by where a splat lies on the screen, NDC units, from that by its (N, 3) position."""
    pose = camera.world_to_camera.to(means)
    depth = (means @ pose[2, :3] + pose[2, 3]).clamp_min(1e-6)
    along = gradient @ pose[:2, :3].T * depth[:, None]
    half = means.new_tensor([camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)])
    return along * half


class AutogradRender(Render):
    """A view that a function of the splats draws with torch.

    The densification signal is the gradient by the positions, seen from the camera. Absolute pixel gradients (AbsGS)
    cannot be had from it: a primitive that draws itself so sets `has_absolute_gradients` to False.
    """

    def __init__(
        self, splats: Splats, camera: Camera, draw: Callable[[Splats], Maps], seen: Tensor, radii: Tensor
    ) -> None:
        """Draw.

        Args:
            splats: What to draw; an autograd graph of theirs is not used.
            camera: Of the view.
            draw: Gives the maps from splats, with their graph.
            seen: (N,) bool, the splat may touch a pixel.
            radii: (N,) pixels, 0 where not seen.
        """
        self._leaves, self._camera, self._shared = _leaves(splats), camera, set(splats.shared)
        with torch.enable_grad():
            self._drawn = draw(splats.with_named(self._leaves))
        self.maps = Maps(**{name: value.detach() for name, value in self._drawn.present().items()})
        self.seen, self.radii = seen, radii

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        """See `Render.backward`.

        Raises:
            BadInput: Absolute pixel gradients are asked for.
        """
        if absolute:
            raise BadInput(
                "signal: absolute pixel gradients cannot be had from splats that torch draws (AutogradRender); choose "
                "signal:loss-gradient"
            )
        grads = self._pull(total)
        means = self._leaves["means"].detach()
        part = None if chosen is None else _signal(means, self._pull(chosen)["means"], self._camera)[:rows]
        signal = _signal(means, grads["means"], self._camera)[:rows]
        return gathered(grads, signal, part, rows, self._shared)

    def _pull(self, cotangents: Maps) -> dict[str, Tensor]:
        made, given = self._drawn.present(), cotangents.present()
        pairs = [(made[name], value.to(made[name])) for name, value in given.items() if made[name].requires_grad]
        if not pairs:
            return {name: torch.zeros_like(value) for name, value in self._leaves.items()}
        outputs, values = zip(*pairs, strict=True)
        grads = torch.autograd.grad(outputs, list(self._leaves.values()), values, retain_graph=True, allow_unused=True)
        return {
            name: torch.zeros_like(leaf) if grad is None else grad
            for (name, leaf), grad in zip(self._leaves.items(), grads, strict=True)
        }


class DerivedRender(Render):
    """A view of splats that are made of others: drawn by a rasterizer, and taken back through what made them."""

    def __init__(
        self,
        splats: Splats,
        camera: Camera,
        derive: Callable[[Splats], tuple[Splats, Tensor]],
        draw: Callable[[Splats], Render],
    ) -> None:
        """Draw.

        Args:
            splats: N of them.
            camera: Of the view.
            derive: Makes M splats of a kind that `draw` knows, with their graph, and tells (M,) int64 which of the N
                each comes from.
            draw: Draws the M, such as `rasterizer.render` with all its other arguments.
        """
        self._leaves, self._shared = _leaves(splats), set(splats.shared)
        with torch.enable_grad():
            self._made, self._owner = derive(splats.with_named(self._leaves))
        self._inner = draw(self._made.detached())
        self._count, self._owner = len(splats), self._owner.to(torch.int64)
        self.seen = self._inner.seen.new_zeros(len(splats))
        self.seen[self._owner[self._inner.seen]] = True
        radii = self._inner.radii
        self.radii = radii.new_zeros(len(splats)).scatter_reduce(0, self._owner, radii, "amax")

    @property
    def maps(self) -> Maps:  # type: ignore[override]  # drawn when it is asked for
        """See `Render`."""
        return self._inner.maps

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        """See `Render.backward`; the signal of one is the sum over what was made of it."""
        inner = self._inner.backward(total, chosen, absolute)
        made, back = self._made.named(), inner.named()
        names = [name for name, value in made.items() if value.requires_grad and name in back]
        grads = torch.autograd.grad(
            [made[name] for name in names],
            list(self._leaves.values()),
            [back[name] for name in names],
            retain_graph=True,
            allow_unused=True,
        )
        found = {
            name: torch.zeros_like(leaf) if grad is None else grad
            for (name, leaf), grad in zip(self._leaves.items(), grads, strict=True)
        }
        part = None if inner.chosen is None else self._summed(inner.chosen)[:rows]
        derived = Derived(self._made.detached(), self._owner, self._inner.seen, inner.signal, inner.chosen).first(rows)
        gradients = gathered(found, self._summed(inner.signal)[:rows], part, rows, self._shared)
        return replace(gradients, derived=derived)

    def _summed(self, signal: Tensor) -> Tensor:
        return summed_by_owner(signal, self._owner, self._count)


def summed_by_owner(values: Tensor, owner: Tensor, count: int) -> Tensor:
    """(count, ...) sums of (M, ...) values by their (M,) owners, in the same order each time.

    On a GPU `index_add` adds in any order and `index_put` sorts first; on a CPU it is the other way round.
    """
    zeros = values.new_zeros(count, *values.shape[1:])
    return zeros.index_put((owner,), values, accumulate=True) if values.is_cuda else zeros.index_add(0, owner, values)


def gathered(
    grads: dict[str, Tensor], signal: Tensor, chosen: Tensor | None, rows: int | None, shared: set[str]
) -> Gradients:
    """Gradients by name, (N, ...), with (N, 2) signals as `Gradients`, of the first `rows` splats; of what is shared,
    all."""
    first = {name: value if name in shared else value[:rows] for name, value in grads.items()}
    extra = {name: value for name, value in first.items() if name not in STANDARD}
    standard: dict[str, Any] = {name: first[name] for name in STANDARD}
    return Gradients(**standard, signal=signal, chosen=chosen, extra=extra)
