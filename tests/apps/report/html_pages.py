"""Run folders without a training, and a reader of pages, for the tests of reports."""

import json
from html.parser import HTMLParser

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 24, 16
COLORS = {"photograph": (200, 30, 30), "render": (30, 200, 30), "depth": (30, 30, 200), "normals": (220, 220, 30)}
VOID = {"br", "hr", "img", "input", "link", "meta"}


class Reader(HTMLParser):
    """Reads a page, and refuses one whose elements are not closed in order."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.attributes, self.texts = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names)), f"{tag} has an attribute twice: {names}"

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else None, data))

    def text(self):
        """All that is read, without style and script."""
        return " ".join(data for tag, data in self.texts if tag not in ("style", "script"))

    def values(self, attribute, tag=None):
        return [value for on, name, value in self.attributes if name == attribute and tag in (None, on)]


def panel(path, parts=tuple(COLORS), shade=0):
    """A picture as the evaluation writes it, each part of a colour of its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = [np.full((HEIGHT, WIDTH, 3), np.array(COLORS[part]) + shade, np.uint8) for part in parts]
    Image.fromarray(np.concatenate(columns, 1)).save(path)


def write(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def steps(count, points=100, losses=("l1", "ssim")):
    """Lines of a journal."""
    lines = [{"event": "StageBegan", "time": 0.0, "stage": "pretrain", "steps": count, "points": points, "first": 1}]
    for index in range(1, count + 1):
        values = {name: 0.5 / index for name in losses}
        facts = {"index": index, "steps": count, "losses": values, "points": points + index, "peak_memory_bytes": 10**9}
        lines.append({"event": "StepDone", "time": 10.0 + index, **facts})
    return [*lines, {"event": "StageEnded", "time": 99.0, "stage": "pretrain", "steps": count, "seconds": 40.0}]


def journal(path, lines):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def plain_run(out, photos=("a.jpg", "b.jpg", "c.jpg"), psnr=20.0, **recipe):
    """A finished run with pictures."""
    write(out / "recipe.json", {"about": "a recipe", "pretrain": {"steps": 9}, **recipe})
    write(out / "run.json", {"versions": {"torch": "9.9"}, "plugins": ["surfkit.core (surfkit 0)"], "notes": []})
    per_image = {name: {"psnr": psnr + at, "ssim": 0.5} for at, name in enumerate(photos)}
    images = {"psnr": psnr, "ssim": 0.5, "per_image": per_image}
    write(out / "metrics.json", {"images": images, "points": 100, "steps": 9, "seconds": 40.0, "cpu_seconds": 30.0})
    write(out / "cameras.json", [{"img_name": name, "width": WIDTH, "height": HEIGHT} for name in photos])
    journal(out / "events.jsonl", steps(9))
    for at, name in enumerate(photos):
        panel(out / "pictures" / f"{name}.png", shade=at)
    return out


def full_run(out, text="plain"):
    """A run with everything that a report can show, and one text in every place that has some."""
    photo = f"{text}.jpg".replace("/", "-")
    plain_run(out, (photo, "b.jpg"), **{text: text, "losses": [{text: text}]})
    write(out / "recipe.json", {"about": text, text: text, "pretrain": {text: [text]}, "losses": [{text: text}]})
    record = {"versions": {text: text}, "plugins": [text], "device": text, "data": {"path": text, text: text}}
    write(out / "run.json", record | {"notes": [text], "skipped": [text], "memory_bytes": {"peak": 9, text: 4}})
    metrics = json.loads((out / "metrics.json").read_text())
    metrics["images"] |= {"lpips_not_measured": text, "seams": {"near": {"psnr": 20.0}}}
    scores = {"precision": 0.5, "recall": 0.5, "f1": 0.5}
    metrics["geometry"] = scores | {"truth": text, "align": text, "tau": 0.5, "classes": {text: {text: scores}}}
    metrics["geometry"]["curve"] = {"tau": [0, 1, 2], "precision": [0, 0.5, 1], "recall": [0, 0.4, 0.8]}
    metrics["geometry"]["normals"] = {"median": 12.3, "p90": 45.6}
    metrics["geometry"]["roughness"] = {"on_truth_planes": 0.078}
    rough, crossing = {"on_planes": 0.034, "planes": 0.5, "radius": 1.0}, {"share": 0.0125, "measured": 7}
    metrics["mesh"] = {"unit": text, "triangles": 7, "boundary_share": 0.25, "components": 2, "file": text}
    metrics["mesh"] |= {"crossing": crossing, "roughness": rough, "non_manifold_edges": 3, "triangles_per_area": 9.5}
    metrics["compressed"] = {"images": {"psnr": 19.0, "ssim": 0.4}, "fps_before_and_after": [9.0, 10.0]}
    write(out / "metrics.json", metrics)
    write(
        out / "mesh.json", {"mesher": {"use": text}, "cleaning": {"triangles": 7}, "facts": {text: text}, "seconds": 1}
    )
    write(out / "compressed" / "compressed.json", {"compressor": {"use": text}, "bytes": 10, "ply_bytes": 40})
    write(out / "blocks" / "plan.json", {"plan": {"blocks": [{"views": [text, text]}, {"views": []}]}})
    state = {"status": text, "step": 5, "error": text, "reduced": [text], "attempts": 2}
    write(out / "blocks" / "000" / "state.json", state)
    lines = steps(5, losses=(text, "ssim"))
    warned = [{"event": "Warned", "time": 5.0, "text": text}]
    skipped = {"event": "PhotoSkipped", "time": 6.0, "name": text, "reason": text}
    journal(out / "events.jsonl", [*lines, *warned, skipped, {"event": text, "time": 7.0}])
    journal(out / "blocks" / "000" / "events.jsonl", lines)
    for path in ("blocks/plan", *(f"geometry/{name}" for name in ("plan", "view0")), "mesh_pictures/above"):
        panel(out / f"{path}.png", ("photograph", "render"))
    panel(out / "mesh_pictures" / "view-1.png", ("photograph", "render"))
    return out


def table(folder, labels, text="plain"):
    """A table whose rows have a run each but the last, which failed."""
    rows = []
    for at, label in enumerate(labels):
        has_run = at < len(labels) - 1
        if has_run:
            plain_run(folder / "runs" / str(at), psnr=20.0 + at)
        step = {"mean": 1.0, "standard_error": 0.1, "seeds": 2, "base": 19.0 + at}
        rows.append(
            {
                "number": at + 1,
                "label": label,
                "built_on": labels[at - 1] if at else None,
                "kept": at != 1,
                "given_up": at == 1,
                "own_recipe": at == 2,
                "change": {text: text},
                "mean": {"psnr": 20.0 + at, text: 3.0} if has_run else {},
                "sd": {"psnr": 0.05} if has_run else {},
                "difference": {"psnr": step} if at and has_run else {},
                "paper": {"psnr": 24.0 + at},
                "paper_difference": {"psnr": 1.0} if at else {},
                "runs": [{"seed": 0, "folder": f"runs/{at}"}] if has_run else [],
                "failed": None if has_run else text,
            }
        )
    facts = {"table": text, "about": text, "steps": 9, "seeds": 2}
    write(folder / "ablation.json", facts | {"data_sets": [{"data": {"path": text}, "truth": None, "rows": rows}]})
    return folder
