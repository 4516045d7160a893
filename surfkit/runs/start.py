"""The initial points of pretraining."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance
from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthAlignment, alignment, prior_bytes, prior_files, read_priors
from surfkit.io.datasets.panoramas import points_remedy
from surfkit.io.datasets.read import observations
from surfkit.runs.folder import Run
from surfkit.runs.photo_light import light_of
from surfkit.scene.scene import Scene, View
from surfkit.start.base import InitialModel, StartInput
from surfkit.train.data_cache import TrainingData, needs_normals, needs_priors, scale_band

PRIORS_AHEAD = 4
"""Depth maps in memory while points are made of them: each is needed once."""


@dataclass(frozen=True)
class InitialPointBuilder:
    """Makes the initial points of a run.

    Attributes:
        run: The run.
        scene: Its data.
        given: Its photographs and masks.
        known: How the depth priors are aligned, if the start needs any.
    """

    run: Run
    scene: Scene
    given: TrainingData
    known: DepthAlignment | None

    def __call__(self, generator: torch.Generator) -> InitialModel:
        """The points; the generator is that of the stage."""
        start, scene, given = self.run.recipe.start, self.scene, self.given
        priors = None
        if start.needs_prior:
            largest = max(view.camera.width * view.camera.height for view in scene.train)
            priors = read_priors(
                self.run.data, scene, PRIORS_AHEAD * prior_bytes(True) * largest, self.known, normals=True
            )
        own = torch.Generator().manual_seed(self.run.recipe.seed)
        try:
            known = StartInput(scene, self.photos(), given.masks, priors, own)
            return start.model(self.run.recipe.primitive, known, generator)
        finally:
            if priors is not None:
                priors.close()

    def photos(self) -> Sequence[Tensor]:
        """(3, H, W) uint8 photographs, in the light of the scene if the appearance of the first stage tells it."""
        model = self.run.recipe.pretrain.appearance
        if model is None or not model.needs_light or (light := light_of(self.run, self.scene.train)) is None:
            return self.given.photos
        return PhotosInOneLight(self.given.photos, self.scene.train, model, model.begin_with(light))


@dataclass(frozen=True)
class PhotosInOneLight(Sequence[Tensor]):
    """Photographs in the light of the scene, each when it is looked at; as they are, if the model cannot tell.

    Attributes:
        given: (3, H, W) uint8 each.
        views: Their views.
        model: What their numbers mean.
        numbers: (V, ...) of each.
    """

    given: Sequence[Tensor]
    views: Sequence[View]
    model: Appearance
    numbers: Tensor

    def __len__(self) -> int:
        return len(self.given)

    def __getitem__(self, at: Any) -> Any:
        photo = self.given[at]
        found = self.model.of_scene(self.numbers[at], photo / 255, self.views[at].camera)
        return photo if found is None else (255 * found[0]).round().to(torch.uint8)


def align_priors(run: Run, scene: Scene, begun: bool) -> DepthAlignment | None:
    """The alignment of the depth priors of a run with its scene, if pretraining needs any.

    Raises:
        BadInput: The run is still to begin, at depth maps, and there are none that can be used.
    """
    needed, losses = run.recipe.start.needs_prior and not begun, run.recipe.pretrain.losses
    if not needed and not needs_priors(losses):
        return None
    known = alignment(run.data, scene, needs_normals(losses), scale_band(losses))
    if needed and not known.fits:
        raise BadInput(
            f"{run.data.path}: the start of the recipe needs depth maps, and there are none that can be used; "
            f"{remedy(run, scene)}, or choose start:sparse"
        )
    return known


def remedy(run: Run, scene: Scene) -> str:
    """How to get depth maps that can be used, after those that there are cannot."""
    if run.data.priors is not None:
        return "see whether photographs and cameras belong together, and which points they share"
    if prior_files(run.data, scene):
        return f"make others with `surfkit prepare depth {shlex.quote(str(run.data.path))} --again`"
    if observations(run.data, scene).is_empty:
        return f"stereo needs sparse points: {points_remedy(run.data.path, (view.name for view in scene.train))}"
    let = "let the run make them, without --no-prepare and with depth:patch-match"
    return f"make some with `surfkit prepare depth {shlex.quote(str(run.data.path))}`, {let}"
