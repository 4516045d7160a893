"""A mesher that looks at the splats alone, and has much to tell of what it did."""

from dataclasses import dataclass

import numpy as np
import torch

from surfkit.plugin import BadInput, Mesh, Mesher


@dataclass(frozen=True)
class Cards(Mesher):
    """One small square for each splat, which faces the nearest camera."""

    size: float = 0.01
    """Half of the side of a square, as a share of the scene extent."""

    def mesh(self, subject):
        """Squares around the means."""
        means = subject.splats.means.detach().double().numpy()
        if not len(means):
            raise BadInput("nothing to mesh: there are no splats")
        eyes = torch.stack([view.camera.centre for view in subject.views]).numpy()
        nearest = ((means[:, None] - eyes) ** 2).sum(2).argmin(1)
        towards = eyes[nearest] - means
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        side = np.cross(towards, np.where(np.abs(towards[:, 2:]) < 0.9, [0, 0, 1.0], [0, 1.0, 0]))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        up = np.cross(towards, side)
        corners = [means + self.size * (a * side + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        first = 4 * np.arange(len(means))[:, None]
        faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]]).astype(np.int32)
        facts = {
            "cards": len(means),
            "facing": "the nearest camera",
            "cameras": {"used": sorted(set(nearest.tolist())), "of": len(eyes)},
            "texture": None,
            "closed": False,
            "size": (self.size, self.size / subject.frame.scale),
        }
        return Mesh(np.stack(corners, 1).reshape(-1, 3).astype(np.float32), faces, None, facts)
