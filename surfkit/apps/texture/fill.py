"""The pages of an atlas, painted from the photographs."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image
from scipy import ndimage

from surfkit.apps.texture.candidates import NO_PHOTO
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos, by_photograph
from surfkit.apps.texture.seam_levelling import SeamCorrections, levelled
from surfkit.apps.texture.texture_atlas import PATCH_SIDE, Atlas, AtlasPage
from surfkit.mesh.base import Mesh
from surfkit.mesh.shade import draw_faces
from surfkit.scene.one_light import OneLight

Pictures = Literal["jpeg", "png"]
PAGE_JPEG_QUALITY = 92
"""Of JPEG pages; colours are kept at full resolution, as charts end at any texel."""
UNSEEN_GREY = 128
"""Colour of a mesh without colours, where no photograph shows it."""
BATCH_TEXELS = 1 << 20
"""Texels whose colour is computed at once."""


@dataclass(frozen=True)
class PaintInput:
    """What pages are painted with.

    Attributes:
        mesh: The mesh.
        atlas: Where its triangles lie.
        photos: The photographs.
        light: Theirs.
        levels: What is added to these colours.
    """

    mesh: Mesh
    atlas: Atlas
    photos: PrefetchedPhotos
    light: OneLight
    levels: SeamCorrections


def paint(what: PaintInput, page: AtlasPage, faces: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 page with some triangles; every other texel has the colour of the nearest one of these.

    Args:
        what: The atlas and the photographs.
        page: Its size.
        faces: (n,) triangles of the page.
    """
    corners = what.atlas.texels(faces)
    image = np.zeros((page.height, page.width, 3), np.uint8)
    flat = np.concatenate([corners.reshape(-1, 2), np.ones((3 * len(faces), 1), np.float32)], axis=1)
    owner = draw_faces(flat, np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3), page.width, page.height)[1]
    seen = what.atlas.view[faces] != NO_PHOTO
    column, row = np.floor(corners.mean(1)).astype(np.int64).T
    free = np.flatnonzero(seen & (owner[row, column] < 0))  # triangles between the centres of texels
    owner[row[free], column[free]] = free
    owner[(owner >= 0) & ~np.append(seen, False)[owner]] = -1
    views = what.atlas.view[faces]
    texel = np.flatnonzero(owner >= 0)
    for number, rows in by_photograph(views[owner.reshape(-1)[texel]]):
        picture = what.photos(number)
        for at in range(0, len(rows), BATCH_TEXELS):
            some = texel[rows[at : at + BATCH_TEXELS]]
            image.reshape(-1, 3)[some] = _colors(what, number, picture, faces, corners, owner, some)
    _patch(what, image, owner, faces[~seen], corners[~seen])
    if (owner < 0).any() and (owner >= 0).any():
        rows, columns = ndimage.distance_transform_edt(owner < 0, return_distances=False, return_indices=True)
        image = image[rows, columns]
    return image


def _colors(
    what: PaintInput,
    number: int,
    picture: np.ndarray,
    faces: np.ndarray,
    corners: np.ndarray,
    owner: np.ndarray,
    texel: np.ndarray,
) -> np.ndarray:
    """(n, 3) uint8 colours of texels that show one photograph: pixels of it in one light, plus the correction."""
    row, column = np.divmod(texel, owner.shape[1])
    mine = owner.reshape(-1)[texel]
    x, y = (np.stack([column, row], axis=1) - what.atlas.move[what.atlas.chart[faces[mine]]]).T
    x, y = x.clip(0, picture.shape[2] - 1), y.clip(0, picture.shape[1] - 1)
    camera = what.photos.views[number].camera
    shown = what.light.even(picture[:, y, x].T / 255, number, camera, x + 0.5, y + 0.5)
    a, b, c = corners[mine].transpose(1, 0, 2).astype(np.float64)
    p, ahead, across = np.stack([column + 0.5, row + 0.5], axis=1) - a, b - a, c - a
    area = ahead[:, 0] * across[:, 1] - across[:, 0] * ahead[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        second = (p[:, 0] * across[:, 1] - across[:, 0] * p[:, 1]) / area
        third = (ahead[:, 0] * p[:, 1] - p[:, 0] * ahead[:, 1]) / area
        shares = np.stack([1 - second - third, second, third], axis=1)  # not finite for a triangle without an area
    shares = np.where(np.isfinite(shares).all(1, keepdims=True), shares, 1 / 3).clip(0, 1)
    value = what.levels.value[what.levels.corner[faces[mine]]]
    return levelled(shown, (value * shares[:, :, None]).sum(1) / shares.sum(1, keepdims=True))


def _patch(what: PaintInput, image: np.ndarray, owner: np.ndarray, faces: np.ndarray, corners: np.ndarray) -> None:
    """Paint the squares of triangles without a photograph: between the middles of texels, a square has the colours
    of the corners at three of them."""
    if not len(faces):
        return
    if what.mesh.colors is None:
        color = np.full((len(faces), 3, 3), UNSEEN_GREY, np.int64)
    else:
        color = what.mesh.colors[what.mesh.faces[faces]].astype(np.int64)
    left, top = np.floor(corners[:, 0]).astype(np.int64).T - 1
    quad = np.stack([color[:, 0], color[:, 1], color[:, 2], (color[:, 1] + color[:, 2] - color[:, 0]).clip(0, 255)])
    for i in range(PATCH_SIDE):
        for j in range(PATCH_SIDE):
            image[top + i, left + j] = quad[(j >= 2) + 2 * (i >= 2)]
            owner[top + i, left + j] = 0


def encoded(image: np.ndarray, kind: Pictures) -> bytes:
    """A page as a file."""
    with io.BytesIO() as file:
        options = {"quality": PAGE_JPEG_QUALITY, "subsampling": 0} if kind == "jpeg" else {}
        Image.fromarray(image).save(file, kind, **options)
        return file.getvalue()
