"""The signed distance field of a scene with its colours, and the field of what lies outside the scene box.

Positions are those of the scene box (`surfkit_neus.box.SceneBox`): the box reaches from -1 to 1 along its longest
axis, and directions are unit vectors. Letters: P positions, C geometry features.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from surfkit.plugin import require_within
from surfkit_neus.hashgrid import Grid, HashGrid

Shape = Literal["plane", "sphere"]
"""What the surface is before the first step."""
SHARPNESS = 100.0
"""Of the softplus in the network of the distance: smooth, as its gradient is learned on, and nearly a ReLU."""
SCALE = 10.0
"""s = exp(10 v) of the learned v, as published, so that s can change by magnitudes at the rates of a network."""
SHARPEST = 1e6
"""The largest s: beyond it, float32 cannot tell sections of a ray apart."""
FREQUENCIES = 4
"""Of view directions: sine and cosine of 1, 2, 4, 8 times their coordinates."""


@dataclass(frozen=True)
class Networks:
    """Sizes of the networks behind the hash grid."""

    width: int = 64
    """Neurons in a hidden layer."""

    distance_layers: int = 1
    """Hidden layers of the network of the signed distance."""

    color_layers: int = 2
    """Hidden layers of the network of the colour."""

    features: int = 15
    """Numbers that the network of the distance hands on to that of the colour."""

    def __post_init__(self) -> None:
        require_within({"width": (1, 4096), "distance_layers": (1, 16), "color_layers": (1, 16)}, self)
        require_within({"features": (0, 4096)}, self)


class SurfaceField(nn.Module):
    """Signed distances, above 0 where the cameras are, and colours.

    The distance is that of the initial shape, plus what the networks make of position and hash features. Their last
    layer begins at 0 for the distance, so that training begins with the exact shape.

    Args:
        grid: Of positions.
        networks: Behind it.
        shape: Before the first step.
        level: Height of the plane along the third axis; or minus the radius of the sphere.
        sharpness: The first s of the logistic density.
        draw: Of all initial values.
    """

    def __init__(
        self, grid: Grid, networks: Networks, shape: Shape, level: float, sharpness: float, draw: torch.Generator
    ) -> None:
        super().__init__()
        self.shape, self.level = shape, level
        self.encoding = HashGrid(grid, 1.0, draw)
        wide = networks.width
        hidden = [wide] * networks.distance_layers
        self.distance = _network([3 + self.encoding.width, *hidden, 1 + networks.features], draw, SHARPNESS)
        last: Any = self.distance[-1]
        with torch.no_grad():
            last.weight[0] = 0
            last.bias[0] = 0
        seen = 3 + 3 + directions(torch.zeros(1, 3)).shape[1] + networks.features
        self.shade = _network([seen, *[wide] * networks.color_layers, 3], draw)
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(sharpness) / SCALE))

    @property
    def sharpness(self) -> Tensor:
        """s of the logistic density; 1 / s is its spread, in lengths of the scene box."""
        return (SCALE * self.log_sharpness).clamp_max(math.log(SHARPEST)).exp()

    def forward(self, x: Tensor, levels: int | None = None) -> tuple[Tensor, Tensor]:
        """(P,) signed distances and (P, C) features of (P, 3) positions, from the first `levels` of the grid."""
        made = self.distance(torch.cat([x, self.encoding(x, levels)], 1))
        begun = x[:, 2] - self.level if self.shape == "plane" else x.norm(dim=1) + self.level
        return begun + made[:, 0], made[:, 1:]

    def color(self, x: Tensor, normal: Tensor, view: Tensor, features: Tensor) -> Tensor:
        """(P, 3) colours in [0, 1] at (P, 3) positions with unit normals, seen along (P, 3) unit directions."""
        return self.shade(torch.cat([x, normal, directions(view), features], 1)).sigmoid()


class BackgroundField(nn.Module):
    """Density and colour of what lies outside the box, all of space contracted to a cube (Mip-NeRF 360 with the largest
    coordinate in the place of the length, as the box has corners).

    Args:
        grid: Of contracted positions.
        networks: Behind it.
        draw: Of all initial values.
    """

    def __init__(self, grid: Grid, networks: Networks, draw: torch.Generator) -> None:
        super().__init__()
        self.encoding = HashGrid(grid, 2.0, draw)
        self.density = _network([self.encoding.width, networks.width, 1 + networks.features], draw)
        seen = directions(torch.zeros(1, 3)).shape[1] + networks.features
        self.shade = _network([seen, networks.width, 3], draw)
        self.beyond = nn.Parameter(torch.zeros(3))

    def forward(self, x: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        """(P,) densities per length of the scene box and (P, 3) colours of (P, 3) positions outside the box."""
        made = self.density(self.encoding(contracted(x)))
        color = self.shade(torch.cat([directions(view), made[:, 1:]], 1)).sigmoid()
        return nn.functional.softplus(made[:, 0] - 1), color

    @property
    def last(self) -> Tensor:
        """(3,) colour of what no sample has stopped."""
        return self.beyond.sigmoid()


def contracted(x: Tensor) -> Tensor:
    """(P, 3) within [-2, 2] of any (P, 3): the cube of [-1, 1] stays, infinity comes to the sides of the larger one."""
    far = x.abs().amax(1, keepdim=True).clamp_min(1)
    return (2 - 1 / far) * x / far


def directions(view: Tensor) -> Tensor:
    """(P, 27) of (P, 3) unit directions: themselves, and sines and cosines of their multiples."""
    turned = [view * 2.0**k for k in range(FREQUENCIES)]
    return torch.cat([view, *(part for angle in turned for part in (angle.sin(), angle.cos()))], 1)


def _network(widths: list[int], draw: torch.Generator, sharpness: float | None = None) -> nn.Sequential:
    """A perceptron with ReLU, or softplus, between its layers."""
    layers: list[nn.Module] = []
    for inputs, outputs in zip(widths, widths[1:], strict=False):
        linear = nn.utils.skip_init(nn.Linear, inputs, outputs)
        with torch.no_grad():  # drawn from our own generator, so that a seed decides
            linear.weight.copy_(torch.randn(outputs, inputs, generator=draw) * math.sqrt(2 / inputs))
            linear.bias.zero_()
        layers += [linear, nn.ReLU() if sharpness is None else nn.Softplus(sharpness)]
    return nn.Sequential(*layers[:-1])
