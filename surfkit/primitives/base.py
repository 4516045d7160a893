"""What a primitive decides: its trainable columns, the splats they stand for, how they split and how they are drawn."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect_kind, expect_tensor
from surfkit.core.registry import Component, kebab, name_of
from surfkit.io.splats.splat_table import SplatTable
from surfkit.primitives.columns import SIGMOID, Activation, Column
from surfkit.primitives.draws import normals
from surfkit.primitives.points import Columns
from surfkit.primitives.raw import cloud_of, raw_columns
from surfkit.raster.api import PRIMITIVE_KINDS, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints

SHRINK = 1.6
"""A child of a split is smaller than its parent by this factor."""


@dataclass(frozen=True)
class Primitive(Component):
    """A kind of splat. Its raw parameters are columns of `Points`: one is "means", (N, 3) positions in local units.

    The methods that are not abstract suit splats whose columns "scales" and "opacities", where they have such, hold one
    number for each scale and opacity of `activate`; others replace them.
    """

    in_ply: ClassVar[bool] = True
    """Whether its splats can be written as PLY files of splats; without them a run has no point_cloud.ply."""

    has_absolute_gradients: ClassVar[bool] = True
    """Whether its `render` can give absolute pixel gradients, for signals that want them (AbsGS); `AutogradRender`
    cannot."""

    has_free_points: ClassVar[bool] = True
    """Whether points can be moved, copied and split; those that are bound to something cannot, and stages that densify
    them are refused."""

    divides: ClassVar[bool] = False
    """Whether several processes may train it together, each with some of the points: no method looks at other points
    than those it is given, but for `observed`, and the rasterizer draws it. A class says so itself, as another that is
    derived from it may do otherwise."""

    sh_degree: int = 3
    """Highest degree of the spherical harmonics of a colour, 0 to 3; 0 is one colour for all directions."""

    def __post_init__(self) -> None:
        if self.sh_degree not in range(4):
            raise BadInput(f"primitive.sh_degree is {self.sh_degree}; it must be 0, 1, 2 or 3")

    @abstractmethod
    def columns(self) -> Mapping[str, Column]:
        """The trainable parameters by name; `standard_columns` gives those of 3DGS."""

    @abstractmethod
    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """Raw parameters of a point for each of a cloud, and the shared ones; `init.seeds` gives the standard ones."""

    @abstractmethod
    def activate(self, params: Columns, degree: int) -> Splats:
        """The splats that raw parameters stand for, with the autograd graph to `params`.

        Args:
            params: Raw columns of N points, and the shared ones.
            degree: Use spherical harmonics up to this degree.
        """

    def split(self, params: Columns, generator: torch.Generator) -> Columns:
        """Raw parameters of the children of M points: 2 M rows, the first children of all, then the second.

        By default two children for each point, at places drawn from the point's own Gaussian, smaller by SHRINK. The
        draws come from `generator` on the CPU, so that the device does not change them.
        """
        twin = {name: torch.cat([value, value]) for name, value in self.per_point(params).items()}
        return self.scaled(self.moved(twin, self._drawn(params, 2, generator)), 1 / SHRINK)

    def scattered(self, params: Columns, generator: torch.Generator) -> Columns:
        """Raw parameters of the points, each moved to a place drawn from its own Gaussian; draws as for `split`."""
        return self.moved(self.per_point(params), self._drawn(params, 1, generator))

    def moved(self, params: Columns, shift: Tensor) -> Columns:
        """Raw parameters of the points moved by (N, 3) local units."""
        return params | {"means": params["means"] + shift}

    def scaled(self, params: Columns, factor: Tensor | float) -> Columns:
        """Raw parameters of the points with all scales `factor` times as large; one for all, or (N,)."""
        raw = params["scales"]
        each = factor.view(-1, *[1] * (raw.dim() - 1)).to(raw) if isinstance(factor, Tensor) else factor
        return params | {"scales": self._activation("scales").times(raw, each)}

    def with_opacities(self, params: Columns, opacities: Tensor) -> Columns:
        """Raw parameters of the points with (N,) opacities between 0 and 1; NaN leaves a point's as it is."""
        raw = params["opacities"]
        wanted = self._activation("opacities").inverse(opacities.double()).to(raw)
        return params | {"opacities": torch.where(opacities.isnan(), raw, wanted.view_as(raw))}

    def dependent(self, params: Columns) -> Columns:
        """The columns that other parameters determine, such as the positions of points that are bound to a mesh.

        A trainer asks for them before the first step, after each edit and after each step, so that they always fit.
        Their learning rate is 0. None by default.

        Args:
            params: Raw columns of N points, and the shared ones.
        """
        return {}

    def observed(self, params: Columns, cameras: Sequence[Camera], near: float) -> Columns:
        """The columns that follow from the training cameras, not from gradients, such as sampling intervals.

        A trainer asks for them before the first step, after each edit and every 100 steps. Their learning rate is 0.
        None by default.

        Args:
            params: Raw columns of N points, and the shared ones.
            cameras: Of the training views; of a block, of those that it is tuned on.
            near: Nothing nearer to a camera is drawn; local units.
        """
        return {}

    def render(
        self,
        splats: Splats,
        camera: Camera,
        rasterizer: Rasterizer,
        near: float,
        geometry: bool = True,
        distortion: bool = True,
    ) -> Render:
        """Draw splats that `activate` gave, as `Rasterizer.render` does; by default `rasterizer` does it.

        A primitive that no rasterizer knows draws itself here (`raster.autograd` has what helps), and so does one that
        needs the camera, such as levels of detail.
        """
        return rasterizer.render(splats, camera, near, geometry, distortion)

    def contribution(
        self,
        splats: Splats,
        camera: Camera,
        rasterizer: Rasterizer,
        near: float,
        alpha_power: float,
        transmittance_power: float,
    ) -> tuple[Tensor, Tensor]:
        """See `Rasterizer.contribution`; for a primitive with a `render` of its own that is to be trimmed or cut."""
        return rasterizer.contribution(splats, camera, near, alpha_power, transmittance_power)

    @property
    def tells_leading(self) -> bool:
        """Whether `leading` is known: by default not for a `contribution` of its own, of others than the points."""
        own = type(self)
        return own.leading is not Primitive.leading or own.contribution is Primitive.contribution

    def leading(self, splats: Splats, camera: Camera, rasterizer: Rasterizer, near: float) -> Tensor:
        """See `Rasterizer.leading`; for a primitive with a `render` of its own, for densifiers that ask for it.

        Raises:
            BadInput: By default, where it is not known (`tells_leading`).
        """
        if not self.tells_leading:
            raise BadInput(
                f"primitive {kebab(type(self).__name__)} draws itself and does not tell which points lead in a pixel, "
                "which the densifier asks for; choose another densifier, or give the primitive a `leading`"
            )
        return rasterizer.leading(splats, camera, near)

    def opacity_before(
        self, splats: Splats, camera: Camera, rasterizer: Rasterizer, near: float, points: Tensor
    ) -> Tensor:
        """See `Rasterizer.opacity_before`; for a primitive with a `render` of its own and mesh:tetra."""
        return rasterizer.opacity_before(splats, camera, near, points)

    def table(self, params: Columns) -> SplatTable:
        """The points as PLY files of splats hold them, local frame; BadInput where `in_ply` is not set."""
        with torch.no_grad():
            splats = self.activate(params, self.sh_degree)
            if not self.in_ply or splats.kind not in PRIMITIVE_KINDS:
                raise BadInput(
                    f"primitive {kebab(type(self).__name__)}: PLY files of splats have no place for it, only for "
                    f"{'s and '.join(PRIMITIVE_KINDS)}s; the checkpoint in the run folder holds the model"
                )
            kind: Any = splats.kind  # one of these
            exact = "opacities" in params and torch.equal(SIGMOID.value(params["opacities"]), splats.opacities)
            return SplatTable(
                kind=kind,
                means=splats.means,
                quats=splats.quats,
                log_scales=splats.scales.log(),
                opacity_logits=params["opacities"] if exact else logits(splats.opacities),
                sh0=splats.sh0[:, 0],
                sh_rest=splats.sh_rest,
                antialias=splats.antialias,
            )

    def from_table(self, table: SplatTable, generator: torch.Generator) -> Columns:
        """Raw parameters of splats in the local frame, and the shared ones: `table` the other way round.

        By default those of `raw.raw_columns` for splats of any kind and degree; other columns begin as in `init`.

        Raises:
            BadInput: The primitive lacks a standard column.
        """
        columns, name = self.columns(), kebab(type(self).__name__)
        params = raw_columns(f"primitive {name}", columns, table)
        if params.keys() == columns.keys():
            return params
        return self.init(cloud_of(table), generator) | params

    def per_point(self, params: Columns) -> Columns:
        """The parameters that belong to points."""
        shared = self.shared()
        return {name: value for name, value in params.items() if name not in shared}

    def shared(self) -> frozenset[str]:
        """Names of the parameters that belong to no point."""
        return frozenset(name for name, column in self.columns().items() if column.shared)

    def _drawn(self, params: Columns, times: int, generator: torch.Generator) -> Tensor:
        """(times x M, 3) offsets of places drawn from the Gaussians of M points: one of each, then the next of each."""
        splats = self.activate(params, 0)
        scales = torch.nn.functional.pad(splats.scales, (0, 3 - splats.scales.shape[1]))
        draw = normals(times, len(scales), generator).to(scales)
        return rotated(draw * scales.repeat(times, 1), splats.quats.repeat(times, 1))

    def _activation(self, name: str) -> Activation:
        found = self.columns().get(name)
        if found is None:
            raise BadInput(
                f"primitive {kebab(type(self).__name__)} has no column {name!r}: it needs `scaled`, `with_opacities`, "
                "`split` and `table` of its own"
            )
        return found.activation


def refuse_other_params(primitive: Primitive, params: Any, where: str = "its points") -> None:
    """BadInput unless raw parameters are those that `columns` declares, float32, with as many rows as there are
    positions.

    Args:
        primitive: What the points are.
        params: Raw columns of N points, and the shared ones.
        where: What gives them, in messages.
    """
    expect_kind(where, params, dict)
    declared = primitive.columns()
    if set(params) != set(declared):
        raise BadInput(
            f"primitive {name_of(primitive)} declares the columns {', '.join(sorted(declared))}, and {where} have "
            f"{', '.join(sorted(params))}"
        )
    sizes = expect_tensor(f"{where}: means", params["means"], ("float32",), ("N", 3))
    for name, column in declared.items():
        rows = () if column.shared else ("N",)
        any_or_known = tuple(f"any {axis}" if size is None else size for axis, size in enumerate(column.shape))
        expect_tensor(f"{where}: {name}", params[name], ("float32",), (*rows, *any_or_known), sizes)


def harmonics(params: Columns, degree: int) -> Tensor:
    """(N, (degree + 1)^2 - 1, 3) coefficients in use of the degrees above 0; the column itself where all are."""
    rest, used = params["sh_rest"], (degree + 1) ** 2 - 1
    return rest if rest.shape[1] == used else rest[:, :used]


def logits(opacities: Tensor) -> Tensor:
    """(N,) finite logits of opacities from 0 to 1, in their own type."""
    return torch.logit(opacities.double().clamp(1e-9, 1 - 1e-9)).to(opacities)


def rotated(vectors: Tensor, quats: Tensor) -> Tensor:
    """(N, 3) vectors turned by (N, 4) quaternions wxyz of any length."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = quats[:, :1], quats[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)
