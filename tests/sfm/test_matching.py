"""Pairs of photographs on their way through COLMAP's database."""

from surfkit.sfm import matching
from surfkit.sfm.photographs import Photo
from surfkit.sfm.settings import Settings


def test_many_pairs_are_compared_in_few_calls_and_each_once(tmp_path, monkeypatch):
    photos = [Photo(f"{at}.jpg", (0, 0)) for at in range(300)]
    pairs = [(one, two) for two in range(300) for one in range(max(0, two - 40), two)]
    seen = []

    def compare(engine, database, file, settings, token):
        seen.append(file.read_text().splitlines())

    monkeypatch.setattr(matching, "_compare", compare)
    monkeypatch.setattr(matching, "refuse_other", lambda *given: None)
    matching.match(photos, pairs, tmp_path, tmp_path / "database.db", Settings())
    assert [line for lines in seen for line in lines] == [f"{one}.jpg {two}.jpg" for one, two in pairs]
    assert len(seen) <= matching.MOST_BATCHES < len(pairs) / matching.BATCH, "each call reads all images"
    seen.clear()
    matching.match(photos, pairs[:100], tmp_path, tmp_path / "database.db", Settings())
    assert [len(lines) for lines in seen] == [40, 40, 20]
