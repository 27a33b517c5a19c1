"""Detection of tags or a board in all images of a series."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from projservo_cli import messages
from projservo_cli.detection.finders import Corners, Finder
from projservo_cli.detection.images import ImageSeries
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.records import FloatArray, InputError, Observation


@dataclass
class _Findings:
    """Detected tags of all images."""

    # pixels and their deviation (4 or 1, 3) of each tag, by pose, view and number of the tag
    images: dict[tuple[int, int, int], FloatArray] = field(default_factory=dict)
    ambiguous: int = 0  # number of tags rejected because they occur more than once in an image
    unrefined: int = 0  # number of corners (or centres) of tags with an edge that is not clean
    empty: int = 0  # number of images without a tag

    @property
    def tags(self) -> list[int]:
        """Numbers of all tags, sorted."""
        return sorted({tag for _, _, tag in self.images})


def observe_tags(
    series: ImageSeries,
    finder: Finder,
    points: str,
    progress: Callable[[str, int, int], None],
) -> tuple[Observation, _Findings]:
    """Find tags in the images of poses.

    finder : of the tags, or of the board, which is tag 0.
    points : ``corners``: corner k of tag t is marker 4 t + k; ``centers``: tag t is marker t.
    progress : called after each pose.
    Raises InputError if an image cannot be read, or has another size than earlier ones of the same camera;
    WorkFailed if there is no tag in any image, or none that two views saw at a pose.
    """
    findings = _Findings()
    shapes: dict[int, tuple[int, ...]] = {}
    for k, shown in enumerate(series.images):
        for view, stored in enumerate(shown):
            if stored is None:
                continue
            image = stored.grey()
            if shapes.setdefault(view, image.shape) != image.shape:
                height, width = shapes[view]
                raise InputError(
                    f"{stored}: {image.shape[1]}×{image.shape[0]} pixels, the images before it "
                    f"{width}×{height}; one camera takes images of one size"
                )
            tags, ambiguous = finder.find(image)
            findings.ambiguous += len(ambiguous)
            findings.empty += not tags
            for number, tag in tags.items():
                in_corners = points == "corners"
                findings.unrefined += int((~tag.clean).sum()) if in_corners else int(not tag.clean.all())
                findings.images[k, view, number] = np.column_stack(tag[:2]) if in_corners else _center(tag)
        progress("detect", k + 1, len(series.images))
    files = [
        [stored for shown in series.images if (stored := shown[view])] for view in range(len(series.view))
    ]
    for view in sorted({*range(len(files))} - {view for _, view, _ in findings.images}):
        if count := finder.mirrored(files[view]):
            where = Subject(views=(series.view[view],))
            raise messages.failed(
                [Finding("mirrored_files", REFUSES, where, count, limit=len(files[view]), unit="1")]
            )
    if not findings.images and findings.ambiguous:
        raise messages.failed([Finding("all_repeated", REFUSES, amount=findings.ambiguous, unit="1")])
    if not findings.images:
        raise messages.failed([finder.absent([stored for side in files for stored in side])])
    numbers, each = findings.tags, finder.corners if points == "corners" else 1
    values = np.full((len(series.images), len(series.view), len(numbers), each, 3), np.nan)
    for (k, view, number), pixels in findings.images.items():
        values[k, view, numbers.index(number)] = pixels
    marker = (each * np.array(numbers, dtype=np.int64)[:, None] + np.arange(each)).ravel()
    joints = series.joints
    values = values.reshape(len(joints.pose), len(series.view), len(marker), 3)
    images, sigma = values[..., :2], values[..., 2]
    observation = Observation(
        joints.pose,
        marker,
        joints.q,
        images,
        sigma=sigma,
        view=series.view,
        flange_chart=joints.flange_chart,
        moving=series.moving,
        t_q=series.t_q,
        t_view=series.t_view,
    )
    if not np.isfinite(images).any():
        raise messages.failed([Finding("rejected_markers", REFUSES, amount=images[..., 0].size, unit="1")])
    if len(series.view) > 1 and (np.isfinite(images[..., 0]).sum(axis=1) < 2).all():
        raise messages.failed([Finding("unpaired_images", REFUSES)], Setup(view=series.view))
    return observation, findings


def _center(tag: Corners) -> FloatArray:
    """Crossing of the diagonals of a tag, the image of its centre, and its deviation: (1, 3) px."""

    def crossing(pixels: FloatArray) -> FloatArray:
        """Crossing (…, 2) of the diagonals of quadrilaterals (…, 4, 2)."""
        a, b, c, d = np.moveaxis(np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1), -2, 0)
        p = np.cross(np.cross(a, c), np.cross(b, d))
        return np.asarray(p[..., :2] / p[..., 2:])

    moved = tag.pixels + np.eye(8).reshape(8, 4, 2) * tag.sigma[:, None]
    change = crossing(moved) - crossing(tag.pixels)
    return np.append(crossing(tag.pixels), np.sqrt(0.5 * (change**2).sum()))[None]
