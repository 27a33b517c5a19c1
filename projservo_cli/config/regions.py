"""Regions that the body is kept out of: polygons drawn around an obstacle in one image or in both."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Annotated

from pydantic import Field, StrictBool

from projservo_cli.config.robot import Finding, Section, Vector2

_Polygon = Annotated[tuple[Vector2, ...], Field(min_length=3, max_length=200)]


class KeptOut(Section):
    """What an obstacle covers in the images: simple polygons, convex or not, in pixels."""

    left: _Polygon | None = Field(None, description="corners u and v in the left image; null for none there")
    right: _Polygon | None = Field(None, description="corners u and v in the right image; null for none")
    hides: StrictBool = Field(
        True, description="whether the obstacle may hide markers: those of the face stay beside it in both"
    )

    def contradictions(self) -> Iterator[Finding]:
        """No polygon, or one that is none."""
        if self.left is None and self.right is None:
            yield (), "give left, right or both: the corners of what the obstacle covers there"
        for side, corners in (("left", self.left), ("right", self.right)):
            if corners is not None and (what := _not_simple(corners)):
                yield (side,), what


def _not_simple(corners: Sequence[Vector2]) -> str:
    """Why corners are not those of a polygon that somebody drew; empty where they are."""
    edges = list(zip(corners, (*corners[1:], corners[0]), strict=True))
    for (i, first), (j, second) in combinations(enumerate(edges), 2):
        if 1 < j - i < len(edges) - 1 and _meet(*first, *second):
            return (
                f"the edges from corners {i + 1} and {j + 1} meet: draw an outline that does not cross itself"
            )
    if sum(a[0] * b[1] - b[0] * a[1] for a, b in edges) == 0.0:
        return "the polygon has no area: its corners lie on one line"
    return ""


def _turn(a: Vector2, b: Vector2, c: Vector2) -> float:
    """Twice the area of a triangle, with its sense."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _meet(a: Vector2, b: Vector2, c: Vector2, d: Vector2) -> bool:
    """Whether the segments a–b and c–d have a point in common."""
    boxes_apart = any(max(a[i], b[i]) < min(c[i], d[i]) or max(c[i], d[i]) < min(a[i], b[i]) for i in (0, 1))
    if boxes_apart:
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0
