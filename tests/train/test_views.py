import torch

from surfkit.train.view_order import ViewContributions, ViewOrder


def test_every_view_is_shown_once_in_each_round_in_an_order_of_the_generator():
    def shown(seed, count=30):
        order, generator = ViewOrder(10), torch.Generator().manual_seed(seed)
        return [order.next(generator) for _ in range(count)]

    rounds = torch.tensor(shown(0)).view(3, 10)
    assert torch.equal(rounds.sort(-1).values, torch.arange(10).expand(3, 10))
    assert not torch.equal(rounds[0], rounds[1])
    assert shown(0) == shown(0) != shown(1)


def test_an_order_goes_on_where_it_was_left():
    whole, generator = ViewOrder(5), torch.Generator().manual_seed(0)
    first = [whole.next(generator) for _ in range(7)]
    copy, state = ViewOrder(whole.count, whole.queue.clone(), whole.at), generator.get_state()
    rest = [whole.next(generator) for _ in range(9)]
    generator.set_state(state)
    assert [copy.next(generator) for _ in range(9)] == rest and len(first) == 7


class Fixed:
    """A rasterizer whose contributions are known."""

    calls = 0

    def contribution(self, splats, camera, near, alpha_power, transmittance_power):
        assert (near, alpha_power, transmittance_power) == (0.005, 0.25, 0.75)
        self.calls += 1
        return torch.tensor([6.0, 0, camera]), torch.tensor([3, 0, 2])


def test_contribution_is_the_mean_over_views_of_means_over_pixels():
    from surfkit.raster.api import Splats
    from surfkit.scene.scene import View

    splats = Splats("surfel", *[None] * 3, torch.ones(3), torch.zeros(3, 1, 3))
    contributions = ViewContributions([View("a", 4.0, None), View("b", 8.0, None)], Fixed(), splats, 0.005)
    tally = contributions.contributions(0.25, 0.75)
    assert tally.mean.tolist() == [2, 0, 3] and tally.peak.tolist() == [2, 0, 4] and len(contributions) == 2
    assert tally.hits.tolist() == [6, 0, 4] and tally.views.tolist() == [2, 0, 2]
    assert contributions.contributions(0.25, 0.75) is tally and contributions.rasterizer.calls == 2, (
        "one pass for all who ask"
    )
    assert [amount.tolist() for amount, _ in contributions.each(0.25, 0.75)] == [[6, 0, 4], [6, 0, 8]]
