"""What is built holds all files that the code reads: templates, styles, scripts, and packages within packages."""

import fnmatch
import re
import subprocess
from pathlib import Path

import pytest
import tomllib

import surfkit

PACKAGE = Path(surfkit.__file__).parent
ROOT = PACKAGE.parent
BUILT = ".cpp"
"""Files that are only read when native code is built; headers are also read when kernels for GPUs are compiled."""


def project(folder):
    return tomllib.loads((folder / "pyproject.toml").read_text())["tool"]


def files(folder):
    """All files below a folder, but what Python and compilers write there."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and "__pycache__" not in path.parts)
    return [path for path in found if path.suffix not in {".so", ".pyd"}]


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="surfkit is installed, and is not a checkout")
def test_the_wheel_leaves_out_native_sources_alone():
    """scikit-build-core takes every file of the packages that neither it nor .gitignore excludes."""
    wheel = project(ROOT)["scikit-build"]["wheel"]
    assert wheel["packages"] == ["surfkit"]
    there = {path.relative_to(ROOT).as_posix() for path in files(PACKAGE)}
    left_out = {name for each in wheel["exclude"] for name in fnmatch.filter(there, each.replace("**/", "*"))}
    assert left_out == {name for name in there if name.endswith(BUILT)}
    asked = "\n".join(sorted(there)).encode()
    try:
        command = ["git", "check-ignore", "--no-index", "--stdin"]
        ignored = subprocess.run(command, cwd=ROOT, input=asked, capture_output=True)
    except FileNotFoundError:
        pytest.skip("git is not installed, which tells what .gitignore excludes")
    if ignored.returncode > 1:
        pytest.skip(f"no git checkout: {ignored.stderr.decode().strip()}")
    assert not ignored.stdout.decode().split()
    assert any("templates" in name and not name.endswith(".py") for name in there), "there are some to look at"


@pytest.mark.parametrize("folder", sorted((ROOT / "plugins").glob("surfkit-*")), ids=lambda folder: folder.name)
def test_packages_of_this_repository_are_built_whole(folder):
    settings, module = project(folder)["setuptools"], folder / folder.name.replace("-", "_")
    data = {path for name in settings.get("package-data", {}).values() for each in name for path in module.glob(each)}
    there = [path for path in files(module) if path not in data]
    assert not [path for path in there if path.suffix != ".py"], "setuptools leaves out what package-data does not name"
    packages = {".".join(path.relative_to(folder).parent.parts) for path in there}
    assert packages == set(settings["packages"])


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="surfkit is installed, and is not a checkout")
def test_the_lowest_versions_are_those_that_were_tried():
    """The file of constraints with which tests were run; `pip` takes whatever is allowed and there."""
    said = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [said["dependencies"], *said["optional-dependencies"].values()]
    lowest = {}
    for name, version in (re.match(r"([\w-]+)>=([\d.]+)", each).groups() for group in groups for each in group):
        lowest.setdefault(name, set()).add(version)
    lines = (ROOT / "constraints-lowest.txt").read_text().splitlines()
    tried = dict(line.split("==") for line in lines if not line.startswith("#"))
    core = {re.match(r"[\w-]+", each)[0] for each in said["dependencies"]}
    assert core - set(tried) == {"torch"}
    for name, version in tried.items():
        assert any(f"{version}.".startswith(f"{least}.") for least in lowest[name]), (name, version, lowest[name])


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="surfkit is installed, and is not a checkout")
def test_the_version_to_cite_is_this_one():
    said = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = (ROOT / "CITATION.cff").read_text().splitlines()
    assert f"version: {said['version']}" in lines and f"license: {said['license']}" in lines
