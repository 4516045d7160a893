"""A primitive with columns of its own: one scale, and no rotation."""

from dataclasses import dataclass

from surfkit.plugin import SIGMOID, Column, Primitive, Splats, harmonics, seeds, standard_columns


@dataclass(frozen=True)
class Balls(Primitive):
    """Gaussians that are equally large in all directions."""

    def columns(self):
        """Without quaternions, and with a single scale."""
        columns = standard_columns(3, self.sh_degree)
        del columns["quats"]
        return columns | {"scales": Column((1,), columns["scales"].rate, columns["scales"].activation)}

    def init(self, cloud, generator):
        """One at each point."""
        return seeds(self.columns(), cloud)

    def activate(self, params, degree):
        """As ellipsoids."""
        means = params["means"]
        return Splats(
            kind="gaussian",
            means=means,
            quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),
            scales=params["scales"].exp().repeat(1, 3),
            opacities=SIGMOID.value(params["opacities"]),
            sh0=params["sh0"],
            sh_rest=harmonics(params, degree),
        )
