import torch

from surfkit.scene.vectors import unit


def test_as_the_normalisation_of_torch_along_any_axis() -> None:
    vectors = torch.randn(3, 5, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for dim in (0, 1, -1):
        torch.testing.assert_close(unit(vectors, dim), torch.nn.functional.normalize(vectors, dim=dim))


def test_nothing_stays_nothing() -> None:
    assert torch.equal(unit(torch.zeros(3, 2, 2)), torch.zeros(3, 2, 2))
