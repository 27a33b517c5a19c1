"""Claims about what the cameras see: self-occlusion, standing still, paths in the images."""

from collections.abc import Iterator

import numpy as np

from projservo_cli.figures import measures
from projservo_cli.figures.images import PLATEAU_WINDOW
from projservo_cli.figures.material import DIRECT, TITLES, Material
from projservo_cli.records import Trace
from projservo_cli.stages.claims.claim import Claim

# What counts as "very small" in an image, as a share of its diagonal.
SMALL_SHARE = 0.01
# The centre moves horizontally where its ordinate varies by less than this share of its abscissa.
LEVEL_SHARE = 0.02


def classical(material: Material) -> Iterator[Claim]:
    """Claims of section 6 about the classical laws that were run."""
    trace = material.traces.get("blockwise")
    if trace is not None:
        yield Claim(
            "The block-wise law does not converge",
            "section 6, Fig. 4",
            f"{trace.verdict} after {trace.steps} steps: {trace.reason}",
            "verdict other than converged",
            trace.verdict != "converged",
        )
        way = measures.center_distance(material, trace) if np.isfinite(trace.goal_pose).all() else None
        grown = (
            ""
            if way is None
            else f"; centre {1e3 * way[-1]:.0f} mm from the goal, {1e3 * way[0]:.0f} at the start"
        )
        yield Claim(
            "The block-wise law diverges towards infinity",
            "section 6",
            trace.verdict + grown,
            "verdict diverged",
            trace.verdict == "diverged",
        )
    for law in ("stacked", "euclidean_points"):
        if law in material.traces:
            yield from _escape(law, material.traces[law])


def _escape(law: str, trace: Trace) -> Iterator[Claim]:
    left, right = trace.self_occluded_steps_left, trace.self_occluded_steps_right
    yield Claim(
        f"{TITLES[law]}: runs through self-occlusion, then converges",
        "section 6, Fig. 4",
        f"{left} and {right} self-occluded steps in the left and right camera; {trace.verdict}",
        "steps in both cameras, verdict converged",
        left > 0 and right > 0 and trace.verdict == "converged",
    )
    stretch = measures.plateau_stretch(trace.image_error, PLATEAU_WINDOW)
    measured = "none"
    if stretch is not None:
        level = float(trace.image_error[stretch[0]])
        measured = f"{stretch[1] - stretch[0]} steps from step {stretch[0]} at {level:.0f} px"
    yield Claim(
        f"{TITLES[law]}: stands still in a local minimum before it converges",
        "section 6, Fig. 4",
        f"{measured}; {trace.verdict}",
        f"image error falls < 1 % in {PLATEAU_WINDOW} steps, verdict converged",
        stretch is not None and trace.verdict == "converged",
    )


def planned(material: Material) -> Iterator[Claim]:
    """Claims of sections 4.3 and 6 about the planned motion."""
    plan = material.plan
    miss = float(np.linalg.norm(plan.s[-1] - plan.s_star, axis=-1).max())
    yield Claim(
        "The planned trajectory avoids self-occlusion",
        "sections 4.3 and 6, Figs. 5 and 6",
        f"least margin {plan.margin.min():.3f} of the start's; ends {miss:.2g} px from the goal images",
        "margin positive in both cameras all along",
        bool(plan.margin.min() > 0),
    )


def direct(material: Material) -> Iterator[Claim]:
    """Claims of sections 4.2 and 6 about what the cameras see under direct control."""
    traces = {law: material.traces[law] for law in DIRECT if law in material.traces}
    if traces:
        counts = [
            f"{TITLES[law]} {trace.self_occluded_steps_left} left, {trace.self_occluded_steps_right} right"
            for law, trace in traces.items()
        ]
        total = sum(t.self_occluded_steps_left + t.self_occluded_steps_right for t in traces.values())
        yield Claim(
            "No self-occlusion under direct control",
            "sections 4.2 and 7",
            f"self-occluded steps: {'; '.join(counts)}",
            "no step in either camera",
            total == 0,
        )
    if len(traces) == len(DIRECT):
        gap = float(measures.path_gap(*(trace.s for trace in traces.values())).max())
        diagonal = float(np.linalg.norm(material.plant.image_size))
        yield Claim(
            "The image paths of directTHREE and directTWO differ very little",
            "section 6, Fig. 7",
            f"largest distance between both paths {gap:.1f} px",
            f"at most {SMALL_SHARE:.0%} of the image diagonal, {SMALL_SHARE * diagonal:.1f} px",
            gap <= SMALL_SHARE * diagonal,
        )
    if DIRECT[0] in traces:
        yield _level(material, traces[DIRECT[0]])


def _level(material: Material, trace: Trace) -> Claim:
    image = measures.center_image(material, trace)
    travel, variation = np.ptp(image, axis=0).T
    return Claim(
        "The centre moves horizontally in the images: its ordinate stays constant",
        "section 6, Fig. 11",
        f"ordinate varies by {variation[0]:.1f} and {variation[1]:.1f} px while the abscissa travels "
        f"{travel[0]:.0f} and {travel[1]:.0f} px (left, right)",
        f"variation at most {LEVEL_SHARE:.0%} of the travel",
        bool((variation <= LEVEL_SHARE * travel).all()),
    )
