"""Test that sentences are short, and that terms of the field lead to the files that define them."""

import ast
import re
import statistics

import pytest

from docs.generate import REGION
from tests.documentation.blocks import DOCS, ROOT

MEDIAN, LONG, SHARE = 16, 30, 0.95  # words, words, share of sentences that are no longer
PROSE = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted(DOCS.rglob("*.md")),
]


def sentences(text):
    """Sentences of a page, without headings, tables, code, formulas and generated regions."""
    text = REGION.sub("", text)
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^\s*```.*?^\s*```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"\$\$.*?\$\$(?: \([\d, ]+\))?", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "code", text)
    text = re.sub(r"^(#|\||\(|\[).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n\n", text, flags=re.MULTILINE)
    for paragraph in re.split(r"\n\s*\n", text):
        for sentence in re.split(r"(?<=[.!?])\s+(?=[^a-z]|code|projservo)", " ".join(paragraph.split())):
            words = re.findall(r"[\w'’°%/-]*\w[\w'’°%/-]*", sentence)
            if len(words) > 1:
                yield len(words), sentence


@pytest.mark.parametrize("page", PROSE, ids=lambda page: f"{page.parent.name}/{page.stem}")
def test_sentences_are_short(page):
    found = list(sentences(page.read_text(encoding="utf-8")))
    if not found:
        return
    long = sorted((one for one in found if one[0] > LONG), reverse=True)
    assert statistics.median(count for count, _ in found) <= MEDIAN
    assert len(long) <= max((1 - SHARE) * len(found), 1), long


# What a maintainer searches for, and the file below the package that defines it.
TERMS = {
    "April ?tag": "detection/finders",
    "backlash": "simulation/robot_with_faults",
    "bundle adjustment": "calibration/bundle_adjustment",
    "checks?um|HDF5": "store/run_file",
    "cluster|Dask": "sweeps/workers",
    "covariance": "calibration/prediction",
    "cross-validation": "calibration/checks/validation",
    "entry point|plug-?in": "plugins",
    "epipolar": "calibration/initial/epipolar",
    "errors in variables": "calibration/joint_noise",
    "exit code": "cli/program",
    "fault detection": "monitoring/__init__",
    "forward kinematics": "geometry/kinematics",
    "goal configuration": "planning/goal_configurations",
    "gravity sag": "simulation/robot_with_faults",
    "ground truth": "simulation/ground_truth",
    "hypothes": "monitoring/hypotheses",
    "image-based": "control/classical",
    "innovation": "monitoring/innovation_tests",
    "inverse kinematics": "planning/goal_configurations",
    "Jacobian": "geometry/kinematics",
    "JIT": "geometry/jit",
    "joint limit": "planning/joint_constraints",
    "JSON Schema": "config/schema",
    "latency": "robots/latency_estimation",
    "lens distortion": "geometry/lens",
    "locks?": "store/files_and_locks",
    "metrics": "loop/run_metrics",
    "MuJoCo": "simulation/__init__",
    "null space": "geometry/null_space",
    "observability": "calibration/checks/observability_and_verdict",
    "obstacle": "planning/keep_out",
    "outlier": "calibration/checks/outliers",
    "pose selection": "planning/pose_selection",
    "replanning": "loop/replanning",
    "RRT": "planning/rrt_connect",
    "self-occlusion": "task/visibility",
    "settling|stall": "loop/stall_monitor",
    "time offset": "calibration/time_offset",
    "time parameterization": "planning/time_parameterization",
    "triangulation": "calibration/initial/triangulation",
    "URDF": "simulation/urdf",
    "waypoint": "planning/time_parameterization",
    "Wilson": "sweeps/statistics",
}
FEW = 12  # files that a search may find


def opening(path):
    """Name of a module and the first line of its docstring."""
    doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    name = str(path.relative_to(ROOT / "projservo_cli").with_suffix(""))
    return f"{name} {name.replace('_', ' ')} {doc.splitlines()[0] if doc else ''}"


@pytest.fixture(scope="module")
def openings():
    package = ROOT / "projservo_cli"
    paths = sorted(package.rglob("*.py"))
    return {str(path.relative_to(package).with_suffix("")): opening(path) for path in paths}


@pytest.mark.parametrize("term", TERMS)
def test_a_search_for_a_term_of_the_field_finds_its_file(openings, term):
    found = [name for name, text in openings.items() if re.search(rf"\b{term}", text, flags=re.IGNORECASE)]
    assert TERMS[term] in found
    assert len(found) <= FEW
