"""Features and matches of kornia: SIFT against that of pycolmap, networks with random weights from files."""

import json
import re
import sys

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image

from surfkit.apps.sfm import colmap_database as matching
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.kornia_features import ALIKED, DISK, KorniaSIFT
from surfkit.apps.sfm.lightglue import LightGlue
from surfkit.apps.sfm.sift import SIFT
from surfkit.apps.sfm.similarity import umeyama
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.testing import check_feature_extractor, check_feature_matcher

from .pictures import HEIGHT, WIDTH, arc, picture, save

kornia = needs("kornia.feature", "features of kornia")
CPU = torch.device("cpu")
POSES = {f"view {at}.jpg": pose for at, pose in enumerate(arc(5))}
CENTRES = {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in POSES.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("flight") / "photos"
    for name, pose in POSES.items():
        save(root / name, picture(pose))
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Files of random weights, in the shapes and with the names of those that are published."""
    torch.manual_seed(0)
    root = tmp_path_factory.mktemp("weights")
    torch.save({"extractor": kornia.DISK().state_dict(), "optimizer": {}}, root / "disk.pth")
    torch.save(kornia.ALIKED("aliked-n16").state_dict(), root / "aliked.pth")
    for kind in ("disk", "aliked", "sift"):
        network = kornia.LightGlue(None, **{**kornia.LightGlue.features[kind], "weights": None})
        old = {re.sub(r"^transformers\.(\d+)\.(self|cross)_attn", r"\2_attn.\1", name): value
               for name, value in network.state_dict().items()}  # fmt: skip
        assert "self_attn.0.Wqkv.weight" in old
        torch.save(old, root / f"{kind}_lightglue.pth")
    return root


def photo(pixels):
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous()


def test_a_blob_is_found_where_it_is_as_colmap_counts_pixels():
    """A pixel of COLMAP has its middle at a half."""
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    away = (x - 61.3) ** 2 + (y - 40.8) ** 2
    grey = (60 + 150 * np.exp(-away / (2 * 4.0**2))).round().astype(np.uint8)
    found = KorniaSIFT().opened(100, CPU)(photo(np.repeat(grey[..., None], 3, 2)))
    at, scale = found.keypoints[:, :2], found.keypoints[:, 2]
    best = np.linalg.norm(at - (61.3, 40.8), axis=1).argmin()
    assert np.allclose(at[best], (61.3, 40.8), atol=0.1) and scale[best] == pytest.approx(4.0, rel=0.25)


def test_sift_of_kornia_has_places_scales_turns_and_descriptors_of_pycolmap():
    pixels = photo(picture(arc(1)[0]))
    ours, theirs = KorniaSIFT().opened(1500, CPU)(pixels), SIFT().opened(1500, CPU)(pixels)
    away = np.linalg.norm(ours.keypoints[:, None, :2] - theirs.keypoints[None, :, :2], axis=2)
    rows, near = np.arange(len(ours.keypoints)), away.argmin(1)
    ratio = ours.keypoints[:, 2] / theirs.keypoints[near, 2]
    turn = np.angle(np.exp(1j * (ours.keypoints[:, 3] - theirs.keypoints[near, 3])))
    same = (away[rows, near] < 0.5) & (abs(np.log(ratio)) < 0.2) & (abs(turn) < 0.2)
    assert same.sum() > 0.4 * len(theirs.keypoints)
    assert abs(np.median((ours.keypoints - theirs.keypoints[near])[same, :2], axis=0)).max() < 0.05
    assert abs(np.median(turn[same])) < 0.02 and abs(np.median(np.log(ratio[same]))) < 0.02
    one, two = (values.astype(np.float64) for values in (ours.descriptors[same], theirs.descriptors[near][same]))
    likeness = (one * two).sum(1) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
    assert np.median(likeness) > 0.95, "the same order of the same histograms"
    assert ours.descriptors.dtype == np.uint8 and np.linalg.norm(one, axis=1).mean() == pytest.approx(512, rel=0.02)


def test_cameras_are_found_with_it_and_features_stay_when_the_matcher_changes(folder, tmp_path, monkeypatch):
    scene, words = tmp_path / "s", ["prepare", "photos", str(folder), "--max-features", "1000", "--no-gps"]
    words += ["--out", str(scene), "features:kornia-sift", "--device", "cpu"]
    assert main([*words, "matcher:mutual"]) == 0
    report = json.loads((scene / "report.json").read_text())
    assert report["registered"] == len(POSES)
    assert (report["settings"]["features"]["use"], report["settings"]["matcher"]["use"]) == ("kornia-sift", "mutual")
    found = read(Data(scene, test_every=0))
    poses = {view.name: found.frame.input_pose(view.camera.world_to_camera) for view in found.train}
    ours = np.stack([-poses[name][:3, :3].T @ poses[name][:3, 3] for name in POSES])
    truth = np.stack(list(CENTRES.values()))
    best = umeyama(ours, truth, np.ones(len(truth)))
    assert np.linalg.norm(best.points(ours) - truth, axis=1).max() < 0.15, "of cameras 20 m away"

    files = {path.name: path.stat().st_mtime_ns for path in (scene / "prepare/features").iterdir()}
    seen, plain = [], matching._compare
    monkeypatch.setattr(matching, "_compare", lambda *given: seen.append(given[1].pairs) or plain(*given))
    assert main([*words, "matcher:mutual"]) == 0 and seen == []
    assert main([*words, "matcher:pycolmap"]) == 0
    assert {path.name: path.stat().st_mtime_ns for path in (scene / "prepare/features").iterdir()} == files
    assert len(seen) == 1 and len(seen[0]) == 10, "all pairs anew"


@pytest.mark.parametrize("kind", ["disk", "aliked"])
def test_networks_run_from_photographs_to_verified_matches(kind, folder, weights, tmp_path, capsys):
    """With random weights; a mask hides half of a photograph."""
    (tmp_path / "m").mkdir()
    hidden = np.full((HEIGHT, WIDTH), 255, np.uint8)
    hidden[:, : WIDTH // 2] = 0
    Image.fromarray(hidden).save(tmp_path / "m/view 1.png")
    words = ["prepare", "photos", str(folder), "--max-features", "300", "--no-gps", "--out", str(tmp_path / "s")]
    words += ["--masks", str(tmp_path / "m"), f"features:{kind}", "--features.weights", str(weights / f"{kind}.pth")]
    words += ["matcher:lightglue", "--matcher.weights", str(weights / f"{kind}_lightglue.pth"), "--device", "cpu"]
    words += ["--matcher.threshold", "0"] + ["--features.threshold", "0.001"] * (kind == "aliked")
    status = main(words)
    said = capsys.readouterr().err
    assert status in (0, 2) and "Traceback" not in said and (status == 0 or "no cameras could be found" in said)
    opened = load_engine().Database.open(tmp_path / "s/prepare/database.db")
    images = {image.name: image.image_id for image in opened.read_all_images()}
    keypoints = {name: opened.read_keypoints(number) for name, number in images.items()}
    assert all(50 <= len(each) <= 310 for name, each in keypoints.items() if "1" not in name)
    assert keypoints["view%201.jpg"][:, 0].min() >= WIDTH // 2
    numbers = sorted(images.values())
    pairs = [(one, two) for two in numbers for one in numbers if one < two]
    assert len(pairs) == 10
    for pair in pairs:
        assert opened.exists_matches(*pair) and opened.exists_two_view_geometry(*pair)
    opened.close()


def test_what_networks_find_is_of_their_weights_and_the_same_again(weights):
    pixels = photo(picture(arc(1)[0]))
    for part in (DISK(weights=weights / "disk.pth"), ALIKED(weights=weights / "aliked.pth", threshold=0.001)):
        one, two = (part.opened(300, CPU)(pixels) for _ in range(2))
        assert np.array_equal(one.keypoints, two.keypoints) and np.array_equal(one.descriptors, two.descriptors)
        check_feature_extractor(part)
        assert one.descriptors.dtype == np.float16 and one.descriptors.shape[1] == 128
        assert np.allclose(np.linalg.norm(one.descriptors.astype(np.float32), axis=1), 1, atol=1e-2)
        assert (one.keypoints[:, :2] >= 0).all() and (one.keypoints[:, :2] <= (WIDTH, HEIGHT)).all()
    network = DISK(weights=weights / "disk.pth").network()
    saved = torch.load(weights / "disk.pth", weights_only=True)["extractor"]
    assert all(torch.equal(value, saved[name]) for name, value in network.state_dict().items())
    for kind in ("sift", "disk", "aliked"):
        check_feature_matcher(LightGlue(weights=weights / f"{kind}_lightglue.pth", threshold=0.0), kind)
    loaded = LightGlue(weights=weights / "sift_lightglue.pth").network("sift").state_dict()
    saved = torch.load(weights / "sift_lightglue.pth", weights_only=True)
    assert torch.equal(loaded["transformers.3.cross_attn.to_v.weight"], saved["cross_attn.3.to_v.weight"])


@pytest.mark.parametrize(
    ("part", "file", "said"),
    [
        (
            DISK,
            "nowhere.pth",
            r"--features.weights .*nowhere.pth: no such .*features:disk",
        ),
        (DISK, "aliked.pth", "features:disk: .*missing .*https://"),
        (DISK, "text.pth", "torch cannot read weights from it"),
        (LightGlue, "disk.pth", "not the weights of matcher:lightglue for sift"),
        (LightGlue, "disk_lightglue.pth", "not the weights of matcher:lightglue for sift"),
    ],
)
def test_files_of_other_weights_are_refused(part, file, said, weights):
    (weights / "text.pth").write_text("no weights")
    with pytest.raises(BadInput, match=said):
        part(weights=weights / file).refuse_missing(*["sift"] * (part is LightGlue))


def test_weights_that_cannot_be_downloaded_are_one_line(monkeypatch):
    def unreachable(*given, **more):
        raise RuntimeError("no route to host")

    for name, module in list(sys.modules.items()):
        if name.startswith("kornia.") and hasattr(module, "load_state_dict_from_url"):
            monkeypatch.setattr(module, "load_state_dict_from_url", unreachable)
    for part, given in ((DISK(), ()), (ALIKED(), ()), (LightGlue(), ("sift",))):
        with pytest.raises(BadInput, match=r"weights .*https://\S+ .*no route"):
            part.refuse_missing(*given)
