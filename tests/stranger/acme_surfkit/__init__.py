"""Parts of a package that surfkit knows nothing of: it imports `surfkit`, torch and numpy, and nothing else."""

from acme_surfkit.balls import Balls
from acme_surfkit.blend import Blend
from acme_surfkit.cards import Cards
from acme_surfkit.charbonnier import Charbonnier
from acme_surfkit.extent import Extent
from acme_surfkit.far import Far
from acme_surfkit.steady import Steady
from acme_surfkit.top_share import TopShare
from surfkit.plugin import Recipe, Row, Stage, Table, hookimpl


@hookimpl
def surfkit_components():
    """The parts, by the names that users type."""
    parts = {"far": Far, "charbonnier": Charbonnier, "top-share": TopShare, "cards": Cards, "balls": Balls}
    return parts | {"blend": Blend, "steady": Steady}


@hookimpl
def surfkit_commands():
    """The command `surfkit extent`."""
    return {"extent": Extent}


@hookimpl
def surfkit_recipes():
    """Balls that stay near the cameras."""
    return {"acme": Recipe("Balls near the cameras", primitive=Balls(), pretrain=Stage(steps=6, prune=(Far(),)))}


@hookimpl
def surfkit_tables():
    """What each of them brings, one after the other."""
    rows = (
        Row("baseline"),
        Row("+ Charbonnier loss", {"pretrain.losses.l1": Charbonnier()}),
        Row("+ top share", {"pretrain.densify": TopShare()}),
        Row("+ far points dropped", {"pretrain.prune": (Far(),)}),
        Row("+ cards", {"mesh": Cards()}),
        Row("+ blend", {"pretrain.signal": Blend()}),
        Row("+ steady", {"pretrain.optimizer": Steady()}),
        Row("recipe of Acme", recipe=surfkit_recipes()["acme"]),
    )
    return {"acme": Table("acme", "What each part of Acme brings.", Recipe(pretrain=Stage(steps=6)), rows)}
