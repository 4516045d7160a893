"""Splats of files as raw parameters: exact for the same kind, the same shape in space for another."""

from dataclasses import replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.splats.splat_table import THINNESS, SplatTable
from surfkit.primitives import Flat3D, Gaussian3D, Surfel2D
from surfkit.primitives.columns import IDENTITY, Column
from surfkit.primitives.raw import cloud_of, product, raw_columns


def table(kind="gaussian", count=40, degree=2):
    draw = torch.Generator().manual_seed(3)
    return SplatTable(
        kind,
        means=torch.randn(count, 3, generator=draw),
        quats=torch.randn(count, 4, generator=draw),
        log_scales=torch.randn(count, 3 if kind == "gaussian" else 2, generator=draw) - 2,
        opacity_logits=torch.randn(count, generator=draw),
        sh0=torch.randn(count, 3, generator=draw),
        sh_rest=torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=draw),
    )


def begun(primitive, splats):
    return primitive.from_table(splats, torch.Generator().manual_seed(0))


def rotations(quats):
    """(N, 3, 3), by the textbook's formula."""
    w, x, y, z = torch.nn.functional.normalize(quats.double(), dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


@pytest.mark.parametrize(
    ("primitive", "kind"), [(Surfel2D(sh_degree=2), "surfel"), (Gaussian3D(sh_degree=2), "gaussian")]
)
def test_the_same_kind_keeps_every_bit(primitive, kind):
    splats = table(kind)
    params = begun(primitive, splats)
    given = {"scales": splats.log_scales, "opacities": splats.opacity_logits, "sh0": splats.sh0[:, None]}
    for name in primitive.columns():
        assert torch.equal(params[name], given[name] if name in given else getattr(splats, name)), name


@pytest.mark.parametrize("primitive", [Surfel2D(), Flat3D()])
def test_ellipsoids_lose_their_thinnest_axis_and_no_other(primitive):
    splats = table()
    assert set(splats.log_scales.argmin(1).tolist()) == {0, 1, 2}
    params = begun(primitive, splats)
    assert params["scales"].shape == (40, 2)
    axes, scales = rotations(splats.quats), splats.log_scales.double().exp()
    thin = scales.argmin(1)
    kept = scales.scatter(1, thin[:, None], 0.0)
    wanted = axes @ torch.diag_embed(kept**2) @ axes.mT
    turned, two = rotations(params["quats"]), params["scales"].double().exp()
    flat = torch.cat([two, torch.zeros(40, 1)], 1)
    torch.testing.assert_close(turned @ torch.diag_embed(flat**2) @ turned.mT, wanted, rtol=1e-5, atol=1e-7)
    normals = axes.gather(2, thin[:, None, None].expand(-1, 3, 1))[..., 0]
    assert ((turned[:, :, 2] * normals).sum(1).abs() > 1 - 1e-6).all(), "the thinnest axis is the normal"


def test_discs_get_a_thin_third_axis():
    splats = table("surfel")
    params = begun(Gaussian3D(), splats)
    assert torch.equal(params["scales"][:, :2], splats.log_scales) and torch.equal(params["quats"], splats.quats)
    third = params["scales"][:, 2].exp() / splats.log_scales.exp().amin(1)
    torch.testing.assert_close(third, torch.full((40,), THINNESS))


def test_harmonics_are_cut_or_filled_with_zeros():
    splats = table(degree=2)
    assert torch.equal(begun(Gaussian3D(sh_degree=1), splats)["sh_rest"], splats.sh_rest[:, :3])
    more = begun(Gaussian3D(sh_degree=3), splats)["sh_rest"]
    assert torch.equal(more[:, :8], splats.sh_rest) and not more[:, 8:].any() and more.shape[1] == 15
    assert begun(Gaussian3D(sh_degree=0), splats)["sh_rest"].shape == (40, 0, 3)


def test_other_activations_and_columns():
    splats = table("surfel", degree=0)
    columns = Surfel2D().columns()
    plain = columns | {"opacities": replace(columns["opacities"], activation=IDENTITY)}
    found = raw_columns("mine", plain, splats)["opacities"]
    torch.testing.assert_close(found, splats.opacity_logits.sigmoid())
    for name in ("scales", "quats", "opacities", "sh0"):
        with pytest.raises(BadInput, match=f"mine .*no column '{name}'"):
            raw_columns("mine", {key: value for key, value in columns.items() if key != name}, splats)
    with pytest.raises(BadInput, match="no column 'scales' of"):
        raw_columns("mine", columns | {"scales": replace(columns["scales"], shape=(1,))}, splats)


def test_columns_that_files_do_not_have_begin_as_usual():
    class Tagged(Surfel2D):
        """Discs with a number of their own."""

        def columns(self):
            return Surfel2D.columns(self) | {"tag": Column((2,), Surfel2D.columns(self)["quats"].rate)}

        def init(self, cloud, generator):
            return Surfel2D.init(self, cloud, generator) | {"tag": torch.ones(len(cloud.xyz), 2)}

    params = begun(Tagged(sh_degree=2), table("surfel"))
    assert torch.equal(params["tag"], torch.ones(40, 2))
    assert torch.equal(params["quats"], table("surfel").quats)


def test_products_of_turns_are_products_of_matrices():
    first, second = torch.randn(9, 4, generator=torch.Generator().manual_seed(1)), torch.tensor([0.5, -0.5, -0.5, -0.5])
    torch.testing.assert_close(rotations(product(first, second)), rotations(first) @ rotations(second[None])[0])


def test_points_of_splats():
    cloud = cloud_of(table("surfel"))
    splats = table("surfel")
    assert torch.equal(cloud.xyz, splats.means)
    torch.testing.assert_close(cloud.opacity, splats.opacity_logits.sigmoid())
    assert ((cloud.size.log() >= splats.log_scales.amin(1)) & (cloud.size.log() <= splats.log_scales.amax(1))).all()
