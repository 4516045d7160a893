"""What stands on top of surfkit, and nothing below imports: its commands, and the programs behind them."""

from surfkit.core.hooks import LazyCommand, hookimpl


@hookimpl
def surfkit_commands():
    """The commands of surfkit, in the order of `surfkit --help`."""
    return {
        "make": LazyCommand(
            "surfkit.apps.make.command",
            "Go the whole way: from photographs, or a data set, to textured mesh, maps, splats and report.",
            goes_on=True,
            memory_advice="smaller photographs (--longest, --scale) or --quality draft need less",
        ),
        "train": LazyCommand(
            "surfkit.apps.train",
            "Train a model, and make its mesh, from photographs with known cameras.",
            goes_on=True,
            memory_advice="smaller photographs (--longest, --scale) or fewer points need less",
        ),
        "train-block": LazyCommand(
            "surfkit.apps.train_block",
            "Train one block of a large scene, in its own process or on another machine.",
            goes_on=True,
        ),
        "mesh": LazyCommand(
            "surfkit.apps.mesh",
            "Make the mesh of a finished run, or make it again with other settings.",
            memory_advice="mesh:tsdf, a larger --mesh.voxel or a lower --memory need less, "
            "mesh:tetra with a higher --mesh.faint too",
        ),
        "maps": LazyCommand(
            "surfkit.apps.maps.command",
            "Draw maps of a finished run: surface model, orthophoto, contour lines, point cloud, differences.",
            goes_on=True,
            memory_advice="a smaller --tile needs less",
        ),
        "texture": LazyCommand(
            "surfkit.apps.texture.command",
            "Give the mesh of a finished run a texture from the photographs, as OBJ, GLB and 3D Tiles.",
            goes_on=True,
            memory_advice="a lower --memory, a larger --texel or a smaller --size need less",
        ),
        "compress": LazyCommand("surfkit.apps.compress", "Compress the model of a finished run, or a file of splats."),
        "lod": LazyCommand(
            "surfkit.apps.lod",
            "Make levels of detail of a finished run, or make them again with other settings.",
            memory_advice="a lower --memory or --lod.steps 0 need less",
        ),
        "evaluate": LazyCommand(
            "surfkit.apps.evaluate",
            "Measure a finished run on held-out photographs, or its mesh against ground truth.",
            memory_advice="with --gt fewer --samples, a larger --voxel or a smaller --crop need less, "
            "else smaller photographs",
        ),
        "render": LazyCommand(
            "surfkit.apps.render.command",
            "Draw a finished run along a path of the camera, as a video or as pictures.",
            goes_on=True,
            memory_advice="a smaller --size needs less",
        ),
        "view": LazyCommand(
            "surfkit.apps.view.command", "Look at a finished run, or a file of splats, a mesh or points, in a browser."
        ),
        "doctor": LazyCommand(
            "surfkit.apps.doctor.command",
            "Check a data set before training: errors in it, and the memory, disk and time of a run.",
            memory_advice="--probe 0, --quick or smaller photographs (--longest, --scale) need less",
        ),
        "status": LazyCommand("surfkit.apps.status", "Show the progress of a run."),
        "curves": LazyCommand(
            "surfkit.apps.curves", "Draw a chart of the points, the loss or the memory of runs over the steps."
        ),
        "report": LazyCommand(
            "surfkit.apps.report.command", "Write a report of runs or of an ablation table as one HTML file."
        ),
        "quality": LazyCommand(
            "surfkit.apps.quality.command",
            "Write the quality report of a survey, as HTML and PDF: accuracy, overlap, calibration, tie points.",
        ),
        "import": LazyCommand(
            "surfkit.apps.import_splats",
            "Take splats from a file of any program, to measure, mesh or export them like those of a run.",
            memory_advice="smaller photographs (--longest, --scale) or mesh:none need less",
        ),
        "export": LazyCommand(
            "surfkit.apps.export", "Write the splats of a run or of a file in another format, for other programs."
        ),
        "prepare": LazyCommand(
            "surfkit.apps.prepare",
            "Find cameras, points or depth: `prepare photos`, `prepare points`, `prepare depth`.",
            goes_on=True,
            memory_advice="a lower --longest or --estimator.longest needs less",
        ),
        "ablate": LazyCommand(
            "surfkit.apps.ablate", "Train every row of an ablation table, and compare the rows.", goes_on=True
        ),
        "benchmark": LazyCommand(
            "surfkit.apps.benchmark.command",
            "Train and measure recipes on a public benchmark, by a fixed protocol.",
            goes_on=True,
        ),
        "tables": LazyCommand(
            "surfkit.apps.tables", "List the ablation tables that `surfkit ablate` accepts, or the rows of one."
        ),
        "recipes": LazyCommand("surfkit.apps.recipes", "List the recipes that `surfkit train recipe:NAME` accepts."),
        "components": LazyCommand("surfkit.apps.components", "List the components that recipes are made of, by kind."),
        "plugins": LazyCommand(
            "surfkit.apps.plugins", "List the plugins: package, components, and the error if one does not load."
        ),
        "new": LazyCommand(
            "surfkit.apps.new", "Write the files of a new plugin, with a working part and its tests: `new plugin`."
        ),
    }
