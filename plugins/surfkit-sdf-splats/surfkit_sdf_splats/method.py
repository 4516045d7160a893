"""What NeuSG and GSDF have in common as methods."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from surfkit_neus.box import scene_box
from surfkit_neus.method import NeuralSurface, NeuS

from surfkit.plugin import BadInput, Method, MethodInput, Reconstruction, SplatModel, Stage, refuse_unfit_stage
from surfkit_sdf_splats.branches import Link, Surface, train


@dataclass(frozen=True)
class SplatsWithDistance(Method):
    """Splats and a neural signed distance function that are optimised together, step by step."""

    uses: ClassVar[tuple[str, ...]] = ("primitive", "start")

    splats: Stage = field(default_factory=Stage)
    """Optimisation of the splats. Its steps are those of the whole run."""

    surface: NeuralSurface = NeuS()
    """The signed distance. Its steps are the last ones of the run; before them, the splats are optimised alone."""

    def __post_init__(self) -> None:
        if self.surface.steps > self.splats.steps:
            raise BadInput(
                f"surface.steps is {self.surface.steps}, more than the {self.splats.steps} of splats.steps, which is "
                "the whole run; lower it"
            )

    @property
    def needs_prior(self) -> bool:  # type: ignore[override]
        """See `Method.needs_prior`."""
        return self.surface.needs_prior or any(loss.needs_prior for loss in self.splats.losses.values())

    def length(self) -> int:
        """See `Method.length`."""
        return self.splats.steps

    def refuse_unfit(self, given: MethodInput) -> None:
        """See `Method.refuse_unfit`."""
        primitive, start = given.used["primitive"], given.used["start"]
        refuse_unfit_stage("method.splats", self.splats, primitive)
        if start.needs_prior:
            raise BadInput("start: it needs depth maps, which this method does not give it; choose start:sparse")
        if (appearance := self.splats.appearance) is not None and appearance.needs_light:
            raise BadInput(
                "method.splats.appearance: it begins with the light of the photographs, which this method does not "
                "look for; choose exposure, or none"
            )
        start.refuse_unfit(primitive, given.scene)
        self.surface.refuse_unfit(given)

    def link(self, surface: Surface) -> Link:
        """What ties the splats to a surface; of the form."""
        raise NotImplementedError

    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """See `Method.reconstruct`: the mesh is that of the distance, and pictures are drawn with the splats."""
        box = scene_box(given.scene, self.surface.margin)
        splats, state = train(self, given, box)
        model = SplatModel(given.used["primitive"], self.splats.finished(splats), splats.sh_degree, self.splats.near)
        return Reconstruction(
            mesh=self.surface.mesh(given, box, state),
            splats=model,
            facts={"initial_shape": box.shape, "sharpness": state.field.sharpness.item(), "points": len(model)},
            steps=self.splats.steps,
        )
