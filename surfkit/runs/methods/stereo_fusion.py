"""Plain stereo, without a model: the baseline that any optimised surface has to beat."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from surfkit.core.check import BadInput
from surfkit.mesh.base import MeshInput
from surfkit.mesh.fusion import forget_spooled
from surfkit.mesh.stereo import Stereo, points
from surfkit.primitives.model import DEFAULT_NEAR
from surfkit.raster.api import Maps
from surfkit.runs.methods.base import Method, MethodInput, Reconstruction


@dataclass(frozen=True)
class StereoFusion(Method):
    """Fuse the depth maps of the photographs into a mesh; nothing is optimised."""

    draws: ClassVar[bool] = False
    needs_prior: ClassVar[bool] = True

    mesher: Stereo = field(default_factory=Stereo)
    """How they are fused."""

    def refuse_unfit(self, given: MethodInput) -> None:
        """See `Method.refuse_unfit`."""
        if given.priors is None:
            raise BadInput(
                "method:stereo fuses depth maps, and there are none that can be used; let the run make them with "
                "depth:patch-match and without --no-prepare, or make some with `surfkit prepare depth DATA`"
            )

    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """See `Method.reconstruct`."""

        def draw(view: object) -> Maps:
            return Maps()  # the mesher puts the depth maps in its place

        forget_spooled(given.folder)
        subject = MeshInput(
            splats=points((), draw),
            views=given.scene.train,
            draw=draw,
            rasterizer=given.rasterizer,
            near=DEFAULT_NEAR,
            frame=given.scene.frame,
            budget_bytes=given.budget_bytes,
            generator=given.generator,
            scratch=given.folder,
            keep=given.mask,
            priors=given.priors,
            photo=given.photo,
        )
        return Reconstruction(mesh=self.mesher.mesh(subject))
