"""The protocols. What is changed here gets a new version; a test holds each version to its digest."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from surfkit.apps.benchmark.protocol import MEAN, BenchmarkScene, Contender, Protocol
from surfkit.apps.benchmark.truths import DTUTruthFiles, Needed, SurfaceTruth, TanksTruth
from surfkit.core.check import BadInput
from surfkit.core.registry import unknown
from surfkit.depth.depth_anything import DepthAnythingV2
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.evaluate.geometry.presets import PresetName
from surfkit.io.datasets.data import ReadSettings
from surfkit.io.datasets.split import GauUScene

SURFACE_COLUMNS = ("precision", "recall", "f1", "points", "bytes", "seconds", "peak_memory_bytes", "peak_gpu_bytes")
CITY_COLUMNS = ("ssim", "psnr", "lpips", *SURFACE_COLUMNS)
CITY_PAPER = "Liu et al., CityGaussianV2, ICLR 2025 (tab: sota, tab: gauU-geometry, tab: gauU-render)"
CITY_RULES = (
    "Photographs are read with a longest side of 1,600 px (GauU-Scene, MatrixCity aerial) or as they are (streets).",
    "SSIM and PSNR are those of colours as rendered, LPIPS is that of AlexNet; all are means over test photographs.",
    "The truth is thinned to voxels of 0.35 m; tau is 1.5 times the spacing that this leaves.",
    "Precision and recall count in the volume of the truth that as many training views see as the preset says.",
    "CityGaussianV2 has the settings of its paper for each scene; 2DGS has 60,000 steps, twice its own, as there.",
    "Seconds are those of training, without reading, depth maps and mesh.",
)


def scores(psnr: float, precision: float, recall: float, f1: float, **others: float) -> dict[str, float]:
    """Published figures in the order in which the paper prints them."""
    return {"psnr": psnr, "precision": precision, "recall": recall, "f1": f1, **others}


def colmap(folder: str, source: str, photographs: tuple[int, int | None], longest: int) -> tuple[Needed, ...]:
    """What a folder of COLMAP needs: photographs, and the model."""
    folder = "" if folder == "." else f"{folder}/"
    return (
        Needed(f"{folder}images", "photographs", source, pictures=photographs, longest=longest),
        Needed(f"{folder}sparse/0", "COLMAP model: cameras, images and points3D, .bin or .txt", source),
    )


def gauu(name: str, folder: str, scanned: str, preset: PresetName, training: tuple[int, int]) -> BenchmarkScene:
    """A scene of GauU-Scene: 1 unit is 100 m, in the photographs and in the scan."""
    scan = Needed(f"{folder}/{scanned}.ply", "laser scan, in the frame of the model", "scan", points=(10**6, None))
    return BenchmarkScene(
        name,
        folder,
        ReadSettings(layout="colmap", longest=1600, split=GauUScene(), metres_per_unit=100.0),
        colmap(folder, "photographs", (training[0] + 1, None), 1600),
        SurfaceTruth(scan, Comparison(preset=preset, classes=False)),
        training,
    )


GAUU_SCENE = Protocol(
    name="gauu-scene",
    version=1,
    about="GauU-Scene: three university campuses from the air, against laser scans",
    scenes=(
        gauu("residence", "LFLS", "LFLS", "gauu-residence", (958, 958)),
        gauu("russian", "SMBU", "smbu", "gauu-russian", (500, 508)),
        gauu("modern", "CUHK_UPPER_COLMAP", "cuhksz_upper_campus", "gauu-modern", (625, 638)),
    ),
    contenders=(
        Contender(
            "citygs2",
            {name: f"citygs2-{name}" for name in ("residence", "russian", "modern")},
            published={
                MEAN: scores(24.51, 0.576, 0.450, 0.501, ssim=0.765, lpips=0.215),
                "residence": scores(23.57, 0.524, 0.421, 0.467),
                "russian": scores(24.12, 0.560, 0.530, 0.544),
                "modern": scores(25.84, 0.643, 0.398, 0.492),
            },
        ),
        Contender(
            "2dgs",
            "2dgs",
            steps=60_000,
            published={
                MEAN: scores(23.93, 0.553, 0.446, 0.491, ssim=0.756, lpips=0.232),
                "residence": scores(22.24, 0.526, 0.406, 0.458),
                "russian": scores(23.77, 0.544, 0.519, 0.531),
                "modern": scores(25.77, 0.588, 0.413, 0.485),
            },
        ),
        Contender(
            "citygs",
            "citygs",
            by_default=False,
            published={
                MEAN: scores(24.75, 0.522, 0.405, 0.453, ssim=0.789, lpips=0.176),
                "residence": scores(23.59, 0.524, 0.391, 0.448),
                "russian": scores(24.37, 0.459, 0.443, 0.451),
                "modern": scores(26.29, 0.582, 0.381, 0.461),
            },
        ),
        Contender(
            "gof",
            "gof",
            steps=60_000,
            by_default=False,
            published={MEAN: scores(22.33, 0.370, 0.390, 0.374, ssim=0.705, lpips=0.333)},
        ),
        Contender(
            "sugar",
            "sugar",
            by_default=False,
            published={MEAN: scores(23.47, 0.570, 0.292, 0.377, ssim=0.682, lpips=0.390)},
        ),
    ),
    columns=CITY_COLUMNS,
    sources={
        "photographs": "GauU-Scene V2, the COLMAP folders of its page, https://saliteta.github.io/CUHKSZ_SMBU",
        "scan": "GauU-Scene V2, the scans on its page, https://saliteta.github.io/CUHKSZ_SMBU",
    },
    rules=("Test photographs are every k-th in the order of COLMAP's numbers (split:gauu-scene).", *CITY_RULES),
    published_in=CITY_PAPER,
    estimator=DepthAnythingV2(size="large"),
)


def matrixcity(
    name: str, folders: tuple[str, str], cloud: str, training: tuple[int, int], street: bool = False
) -> BenchmarkScene:
    """A part of MatrixCity as CityGaussian prepares it. Streets are in metres, all else in hundreds of metres."""
    train, test = folders
    longest = 1000 if street else 1600
    presets: dict[bool, PresetName] = {False: "matrixcity-aerial", True: "matrixcity-street"}
    return BenchmarkScene(
        name,
        train,
        ReadSettings(layout="colmap", longest=longest, test_data=Path(test), metres_per_unit=1.0 if street else 100.0),
        (
            *colmap(train, "photographs", training, longest),
            *colmap(test, "photographs", (1, None), longest),
        ),
        SurfaceTruth(
            Needed(cloud, "cloud of the city", "cloud", points=(10**6, None)),
            Comparison(preset=presets[street], classes=False),
            per_unit=0.01 if street else 1.0,
        ),
        training,
    )


MATRIXCITY = Protocol(
    name="matrixcity",
    version=1,
    about="MatrixCity, small city: a rendered city from the air and from its streets, against its own cloud",
    scenes=(
        matrixcity(
            "aerial",
            ("aerial/train/block_all", "aerial/test/block_all_test"),
            "point_cloud_ds20/aerial/Block_all.ply",
            (5_621, 5_621),
        ),
        matrixcity(
            "street",
            ("street/train/block_A", "street/test/block_A_test"),
            "point_cloud_ds20/street/Block_A.ply",
            (3_750, 4_285),
            street=True,
        ),
    ),
    contenders=(
        Contender(
            "citygs2",
            {"aerial": "citygs2-aerial", "street": "citygs2-street"},
            published={
                "aerial": scores(27.23, 0.441, 0.752, 0.556, ssim=0.857, lpips=0.169),
                "street": scores(22.24, 0.376, 0.759, 0.503, ssim=0.788, lpips=0.347),
            },
        ),
        Contender(
            "2dgs",
            "2dgs",
            steps=60_000,
            published={
                "aerial": scores(21.35, 0.207, 0.390, 0.270, ssim=0.632, lpips=0.562),
                "street": scores(21.50, 0.334, 0.659, 0.443, ssim=0.723, lpips=0.477),
            },
        ),
        Contender(
            "citygs",
            "citygs",
            by_default=False,
            published={
                "aerial": scores(27.46, 0.362, 0.637, 0.462, ssim=0.865, lpips=0.204),
                "street": scores(22.98, 0.283, 0.689, 0.401, ssim=0.808, lpips=0.301),
            },
        ),
        Contender(
            "gof",
            "gof",
            steps=60_000,
            by_default=False,
            published={"street": scores(20.32, 0.219, 0.473, 0.300, ssim=0.703, lpips=0.440)},
        ),
    ),
    columns=CITY_COLUMNS,
    sources={
        "photographs": "MatrixCity, small city, with the COLMAP models that CityGaussian hands out, "
        "https://city-super.github.io/matrixcity/ and https://github.com/Linketic/CityGaussian",
        "cloud": "MatrixCity, clouds of the small city, https://city-super.github.io/matrixcity/",
    },
    rules=(
        "Test photographs are those of the test folders.",
        *CITY_RULES,
        "The paper has other figures of CityGaussianV2 in its appendix: F1 0.531 (aerial) and 0.524 (street).",
    ),
    published_in=CITY_PAPER,
    estimator=DepthAnythingV2(size="large"),
)


def tanks(scene: str, photographs: int, tau: float) -> BenchmarkScene:
    """A scene of the training set of Tanks and Temples; its unit is that of the COLMAP model, which is arbitrary."""
    return BenchmarkScene(
        scene.lower(),
        scene,
        ReadSettings(layout="colmap", longest=960, test_every=0),
        colmap(scene, "photographs", (photographs, photographs), 960),
        TanksTruth(scene, scene, tau, photographs),
        (photographs, photographs),
    )


TANKS_AND_TEMPLES = Protocol(
    name="tanks-and-temples",
    version=1,
    about="Tanks and Temples, training set: six scenes from a video, against laser scans",
    scenes=(
        tanks("Barn", 410, 0.01),
        tanks("Caterpillar", 383, 0.005),
        tanks("Courthouse", 1106, 0.025),
        tanks("Ignatius", 263, 0.003),
        tanks("Meetingroom", 371, 0.01),
        tanks("Truck", 251, 0.005),
    ),
    contenders=(
        Contender(
            "2dgs",
            "2dgs",
            published={
                MEAN: {"f1": 0.32},
                "barn": {"f1": 0.41},
                "caterpillar": {"f1": 0.23},
                "courthouse": {"f1": 0.15},
                "ignatius": {"f1": 0.51},
                "meetingroom": {"f1": 0.17},
                "truck": {"f1": 0.45},
            },
        ),
        Contender("surface", "surface"),
        Contender("gof", "gof", by_default=False, published={MEAN: {"f1": 0.46}}),
        Contender("sugar", "sugar", by_default=False, published={MEAN: {"f1": 0.19}}),
        Contender("pgsr", "pgsr", by_default=False, published={MEAN: {"f1": 0.50}}),
        Contender("radegs", "radegs", by_default=False, published={MEAN: {"f1": 0.40}}),
        Contender("trim2dgs", "trim2dgs", by_default=False, published={MEAN: {"f1": 0.36}}),
        Contender("neuralangelo", "neuralangelo", by_default=False, published={MEAN: {"f1": 0.50}}),
    ),
    columns=SURFACE_COLUMNS,
    sources={
        "photographs": "Tanks and Temples, image sets, https://www.tanksandtemples.org/download/, with a COLMAP model "
        "(`surfkit prepare photos`, or those that authors of methods hand out); keep the names of the photographs",
        "truth": "Tanks and Temples, ground truth of the training set, https://www.tanksandtemples.org/download/",
    },
    rules=(
        "All photographs are trained on, with a longest side of 960 px, half of theirs; none is held out.",
        "Cameras are matched by the order of the names of photographs.",
        "Meshes are sampled evenly on their surface, not at vertices and centres of faces, so large false faces count.",
        "Steps are those of each recipe; published figures are those that authors print or repeat.",
    ),
    published_in="papers and repositories of the methods, as they state them",
)

DTU_SCANS = {
    **dict.fromkeys((24, 37, 40, 55, 63, 65, 69), 49),
    **dict.fromkeys((83, 97, 105, 106, 110, 114, 118, 122), 64),
}
"""Photographs of each of the 15 scans that surface methods are compared on."""


def dtu(number: int, photographs: int) -> BenchmarkScene:
    """A scan of DTU, its cameras in a normalised frame."""
    count = (photographs, photographs)
    return BenchmarkScene(
        f"scan{number}",
        f"scan{number}",
        ReadSettings(layout="colmap", longest=800, test_every=0),
        colmap(f"scan{number}", "photographs", count, 800),
        DTUTruthFiles(number, photographs),
        count,
    )


DTU = Protocol(
    name="dtu",
    version=1,
    about="DTU: 15 objects on a table, against structured light, chamfer distance in millimetres",
    scenes=tuple(dtu(*each) for each in DTU_SCANS.items()),
    contenders=(
        Contender("2dgs", "2dgs", published={MEAN: {"chamfer": 0.80}}),
        Contender("surface", "surface"),
        Contender("gof", "gof", by_default=False, published={MEAN: {"chamfer": 0.74}}),
        Contender("sugar", "sugar", by_default=False, published={MEAN: {"chamfer": 1.33}}),
        Contender("pgsr", "pgsr", by_default=False, published={MEAN: {"chamfer": 0.53}}),
        Contender("trim2dgs", "trim2dgs", by_default=False, published={MEAN: {"chamfer": 0.72}}),
        Contender("gs2mesh", "gs2mesh", by_default=False, published={MEAN: {"chamfer": 0.68}}),
        Contender("neus", "neus", by_default=False, published={MEAN: {"chamfer": 0.84}}),
        Contender("neuralangelo", "neuralangelo", by_default=False, published={MEAN: {"chamfer": 0.61}}),
    ),
    columns=("accuracy", "completeness", "chamfer", *SURFACE_COLUMNS[3:]),
    sources={
        "photographs": "the 15 scans with silhouettes and cameras.npz as NeuS and 2DGS hand them out, with a COLMAP "
        "model in the frame of cameras.npz, https://surfsplatting.github.io/",
        "points": "DTU MVS data set, Points.zip, https://roboimagedata.compute.dtu.dk/?page_id=36",
        "sample": "DTU MVS data set, SampleSet.zip, https://roboimagedata.compute.dtu.dk/?page_id=36",
    },
    rules=(
        "All photographs are trained on, with a longest side of 800 px, half of theirs, without masks; none is held "
        "out.",
        "Faces outside the silhouettes in any view, widened by 24 px, are dropped before the mesh is measured.",
        "Silhouettes belong to photographs by the order of the names of both.",
        "Steps are those of each recipe.",
    ),
    published_in="papers of the methods, as they state them",
)

SHIBUYA = Protocol(
    name="shibuya",
    version=1,
    about="Shibuya: a rendered quarter with an exact mesh, small enough for any CPU",
    scenes=(
        BenchmarkScene(
            "shibuya",
            ".",
            ReadSettings(layout="colmap", scale=4.0, test_every=8, metres_per_unit=1.0),
            colmap(".", "pack", (100, 100), 640),
            SurfaceTruth(
                Needed("gt/mesh.ply", "exact mesh", "pack", faces=(54_282, 54_282)),
                Comparison(align="none", classes=False),
                tau=0.5,
            ),
            (87, 87),
        ),
    ),
    contenders=(
        Contender("surface", "surface"),
        Contender("stereo", "stereo"),
        Contender("2dgs", "2dgs"),
        Contender("3dgs", "3dgs"),
    ),
    columns=("ssim", "psnr", *SURFACE_COLUMNS[:6], "cpu_seconds", "peak_memory_bytes"),
    sources={
        "pack": "shibuya-synth, the pack of data that is handed out with surfkit (CC BY 4.0; its buildings are of "
        "Project PLATEAU, https://www.mlit.go.jp/plateau/)"
    },
    rules=(
        "Photographs are read at a quarter of their size, 160 px wide; every 8th is held out.",
        "All recipes that make optimisation steps make 2,000, with their schedules scaled; those with blocks make "
        "these before the blocks, and tune blocks for as large a share of their own steps.",
        "Nothing is aligned, as all poses are exact.",
        "Nobody has published figures. The same machine and versions give the same figures again on a CPU; others may "
        "differ in last digits, and so a little in figures.",
    ),
    published_in="",
    steps=2_000,
)

PROTOCOLS: Mapping[str, Protocol] = {
    each.name: each for each in (GAUU_SCENE, MATRIXCITY, TANKS_AND_TEMPLES, DTU, SHIBUYA)
}
"""By name."""


def protocol_of(name: str) -> Protocol:
    """The protocol of a name, as typed.

    Raises:
        BadInput: There is none.
    """
    if name not in PROTOCOLS:
        raise BadInput(unknown("benchmark", name, PROTOCOLS))
    return PROTOCOLS[name]
