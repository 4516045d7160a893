"""A map by which the render of each photograph is multiplied, from a network that sees the render and an embedding."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pixel_shuffle, relu

from surfkit.plugin import Appearance, BadInput, Camera, Columns
from surfkit_decoupled.layers import convolved, doubled

SEED = 2024
"""Of the numbers to begin with, which are the same in every stage, block and run."""
MOST_LENGTH, MOST_WIDTHS, MOST_WIDTH = 1024, 8, 1024
"""What settings can be: numbers of an embedding, doublings, channels."""


@dataclass(frozen=True)
class Decoupled(Appearance):
    """A transformation map for each photograph, made by a network of which nothing is left after training.

    For photographs between which light changes from place to place, such as by clouds, or by exposure of the camera.

    The render I^r, (3, H, W), is averaged over squares of 32 x 32 pixels, and the embedding of the photograph is
    appended to every pixel of that. A network makes the map M of it, (3, H, W): a convolution; four times a pixel
    shuffle, which doubles the size, and a convolution; then bilinear doubling and two convolutions at full size. All
    are 3 x 3, with a ReLU but after the last. The photograph is compared with I^a = M * I^r (VastGaussian, sec. 4.2).

    M is 1 + what the last convolution gives, whose weights begin as zeros: at first nothing changes. Embeddings, and
    the other weights as He et al. (2015) have it, begin as fixed random numbers.

    Losses of structure, such as `ssim`, see I^r, all others I^a. So D-SSIM holds structure and colours of the scene,
    and L1 tells what is left. A stage without any loss of structure is refused.
    """

    spares_structure: ClassVar[bool] = True

    length: int = 64
    """Numbers in the embedding of a photograph."""

    widths: tuple[int, ...] = (256, 128, 64, 32, 16)
    """Channels after each convolution but the last two, which have those of the last of these and 3. Each entry doubles
    the size once: five make squares of 2^5 pixels. Multiples of 4, but for the last, as a pixel shuffle makes one
    channel of 4."""

    rate: float = 1e-3
    """Learning rate of embeddings and weights."""

    def __post_init__(self) -> None:
        if not 1 <= self.length <= MOST_LENGTH:
            raise BadInput(f"decoupled.length is {self.length}; give 1 to {MOST_LENGTH} numbers")
        if not 1 <= len(self.widths) <= MOST_WIDTHS:
            raise BadInput(f"decoupled.widths has {len(self.widths)} entries; give 1 to {MOST_WIDTHS}")
        if wrong := [width for width in self.widths if not 1 <= width <= MOST_WIDTH]:
            raise BadInput(f"decoupled.widths has {wrong[0]}; give 1 to {MOST_WIDTH} channels")
        if wrong := [width for width in self.widths[:-1] if width % 4]:
            raise BadInput(f"decoupled.widths has {wrong[0]} before its last; give a multiple of 4, such as 4 or 64")
        if not 0 < self.rate <= 1:
            raise BadInput(f"decoupled.rate is {self.rate:g}; give more than 0 and at most 1")

    def begin(self, count: int) -> Tensor:
        """(V, E) embeddings, from a normal distribution: the network can tell photographs apart from the start."""
        return torch.randn(count, self.length, generator=torch.Generator().manual_seed(SEED))

    def begin_shared(self) -> Tensor:
        """(S,) weights and biases of the network, one convolution after the other."""
        draw, parts = torch.Generator().manual_seed(SEED + 1), []
        *inner, last = self._shapes()
        for made, taken in inner:
            spread = math.sqrt(2 / (9 * taken))
            parts += [spread * torch.randn(9 * made * taken, generator=draw), torch.zeros(made)]
        return torch.cat([*parts, torch.zeros((9 * last[1] + 1) * last[0])])

    def rate_at(self, index: int, steps: int) -> float:
        """The same throughout."""
        return self.rate

    def __call__(self, numbers: Tensor, color: Tensor, camera: Camera) -> Tensor:
        """See `Appearance.__call__`; `numbers` are (E + S,)."""
        return color * self.map_of(numbers, color)

    def map_of(self, numbers: Tensor, color: Tensor) -> Tensor:
        """(3, H, W) what the colours (3, H, W) are multiplied by; differentiable in both."""
        height, width = color.shape[1:]
        layers = self._layers(numbers[self.length :])
        small = avg_pool2d(color[None], 2 ** len(self.widths), ceil_mode=True)
        embedding = numbers[: self.length].view(1, -1, 1, 1).expand(-1, -1, *small.shape[2:])
        image = relu(convolved(torch.cat([small, embedding], 1), *layers[0]))
        for layer in layers[1:-2]:
            image = relu(convolved(pixel_shuffle(image, 2), *layer))
        image = doubled(image)[..., :height, :width]  # squares at the right and lower edge may go beyond it
        image = relu(convolved(image, *layers[-2]))
        return 1 + convolved(image, *layers[-1])[0]

    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """The parameters as they are, as in the paper: embeddings and network are dropped.

        The scene then has the colours that losses of structure have given it, of D-SSIM those of the photographs in
        which each place is seen, about their mean, and not those of any one photograph.
        """
        return params

    def _shapes(self) -> list[tuple[int, int]]:
        """Channels that each convolution makes and takes."""
        first, *others = self.widths
        taken = [3 + self.length, *(width // 4 for width in self.widths[:-1]), self.widths[-1], self.widths[-1]]
        return list(zip([first, *others, self.widths[-1], 3], taken, strict=True))

    def _layers(self, weights: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Weights (O, I, 3, 3) and bias (O,) of each convolution, from all of them, (S,)."""
        shapes = self._shapes()
        parts = iter(weights.split([count for made, taken in shapes for count in (9 * made * taken, made)]))
        return [(next(parts).view(made, taken, 3, 3), next(parts)) for made, taken in shapes]
