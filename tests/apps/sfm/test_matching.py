"""Pairs of photographs on their way through COLMAP's database."""

import numpy as np
import pytest
import torch
from flight import HEIGHT, NOISE_PX, WIDTH, fly

from surfkit.apps.sfm import colmap_database as matching
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.feature_cache import feature_file
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.kornia_features import DISK
from surfkit.apps.sfm.mapping import map_photographs
from surfkit.apps.sfm.mutual import Mutual
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.similarity import umeyama
from surfkit.core.codec import dump

CPU = torch.device("cpu")


def test_many_pairs_are_compared_in_few_calls_and_each_once(tmp_path, monkeypatch):
    photos = [Photo(f"{at}.jpg", (0, 0)) for at in range(300)]
    pairs = [(one, two) for two in range(300) for one in range(max(0, two - 40), two)]
    seen = []

    def compare(engine, given, settings):
        lines = given.listed.read_text().splitlines()
        assert lines == [f"{one} {two}" for one, two in given.pairs]
        seen.append(lines)

    monkeypatch.setattr(matching, "_compare", compare)
    monkeypatch.setattr(matching, "_not_compared", lambda database, named: named)
    monkeypatch.setattr(matching, "refuse_other", lambda *given: None)
    monkeypatch.setattr(matching, "reduced", lambda *given: (0, 0))
    matching.match(photos, pairs, tmp_path, tmp_path / "database.db", Settings(), CPU)
    assert [line for lines in seen for line in lines] == [f"{one}.jpg {two}.jpg" for one, two in pairs]
    assert len(seen) <= matching.MAX_PROGRESS_BATCHES < len(pairs) / matching.MIN_BATCH_PAIRS, (
        "each call reads all images"
    )
    seen.clear()
    matching.match(photos, pairs[:100], tmp_path, tmp_path / "database.db", Settings(), CPU)
    assert [len(lines) for lines in seen] == [40, 40, 20]


SETTINGS = Settings(features=DISK(), matcher=Mutual())


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A flight, and a folder of features of its first two strips: each ground point has a descriptor of its own."""
    flight, folder, rng = fly(tilt_deg=5), tmp_path_factory.mktemp("flight"), np.random.default_rng(0)
    codes = rng.normal(0, 1, (len(flight.points), 64))
    photos = [Photo(name, (0, 0), digest=name, size=(WIDTH, HEIGHT)) for name in flight.names[:12]]
    for photo, (rows, pixels) in zip(photos, flight.seen, strict=False):
        keypoints = np.column_stack([pixels, np.ones(len(rows)), np.zeros(len(rows))]).astype(np.float32)
        seen = (codes[rows] + rng.normal(0, 0.1, (len(rows), 64))).astype(np.float16)
        np.savez(feature_file(folder, photo, SETTINGS), keypoints=keypoints, descriptors=seen)
    return flight, folder, photos


def test_features_and_matches_of_any_kind_are_what_cameras_are_found_from(flown, tmp_path):
    flight, folder, photos = flown
    database, pairs = tmp_path / "database.db", [(one, two) for two in range(12) for one in range(two)]
    matching.match(photos, pairs, folder, database, SETTINGS, CPU)
    opened = load_engine().Database.open(database)
    numbers = {image.name: image.image_id for image in opened.read_all_images()}
    assert opened.num_descriptors() == 0, "pycolmap is not to compare them"
    for one, two in pairs:
        first, second = (flight.seen[at][0] for at in (one, two))
        found = opened.read_matches(numbers[photos[one].name], numbers[photos[two].name])
        assert (first[found[:, 0]] == second[found[:, 1]]).all()
        common = len(np.intersect1d(first, second))
        assert len(found) >= 0.95 * common or common < 20, "COLMAP empties those of pairs with too few"
    opened.close()
    assert min(matching.matched(database).values()) >= 4, "the neighbours of a photograph, which see the same ground"
    [model] = map_photographs(database, tmp_path / "models", 12, SETTINGS)
    model = load_engine().Reconstruction(model)
    assert model.num_reg_images() == 12 and model.compute_mean_reprojection_error() < 2 * NOISE_PX
    found = {image.name: image.projection_center() for image in model.images.values()}
    ours = np.stack([found[name] for name in flight.names[:12]])
    best = umeyama(ours, flight.centres[:12], np.ones(12))
    assert np.linalg.norm(best.points(ours) - flight.centres[:12], axis=1).max() < 1.0, "of 60 m above the ground"


def test_pairs_that_were_compared_are_not_again_unless_the_matcher_is_another(flown, tmp_path, monkeypatch):
    _, folder, photos = flown
    database, asked, plain = tmp_path / "database.db", [], Mutual.match

    def match(self, given):
        for names, found in zip(given.pairs, plain(self, given), strict=True):
            asked.append(names)
            if len(asked) == 3:
                raise KeyboardInterrupt
            yield found

    monkeypatch.setattr(Mutual, "match", match)
    pairs = [(0, 1), (0, 2), (1, 2), (2, 3)]
    with pytest.raises(KeyboardInterrupt):
        matching.match(photos, pairs, folder, database, SETTINGS, CPU)
    matching.match(photos, pairs, folder, database, SETTINGS, CPU)
    names = [(photos[one].name, photos[two].name) for one, two in pairs]
    assert asked == [*names[:3], *names[2:]]
    asked.append("")
    matching.match(photos, pairs, folder, database, SETTINGS, CPU)
    assert len(asked) == 6, "all are there"
    other = Settings(features=DISK(), matcher=Mutual(ratio=0.7))
    assert matching.contents(photos, folder, other) != matching.contents(photos, folder, SETTINGS)
    matching.match(photos, pairs, folder, database, other, CPU)
    assert asked[6:] == names
    assert dump(other.matcher)["ratio"] == 0.7
