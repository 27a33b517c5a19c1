"""Cameras that projservo itself reads, for an arm whose class reads joints alone."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import Field, Strict, StrictInt, StrictStr, StringConstraints

from projservo_cli.settings.sections import ByView, Count, Note, NotNegative, Positive, Section


class Source(Section):
    """A camera: a device, a film, or a stream."""

    source: Annotated[StrictInt, Field(ge=0)] | Annotated[StrictStr, Field(min_length=1)] = Field(
        description="index of a device, its path (/dev/v4l/by-path/... stays the same), a film, or a URL"
    )
    size_px: tuple[Count, Count] | None = Field(None, description="width and height; null for its own")
    rate_hz: Positive | None = Field(None, description="frames per second; null for its default")
    fourcc: Annotated[str, StringConstraints(min_length=4, max_length=4, to_upper=True)] = Field(
        "MJPG", description="format in which a device sends frames; YUYV fills a USB 2 hub with one camera"
    )
    exposure_ms: Annotated[float, Strict(), Field(ge=0.1, le=1000)] | None = Field(
        None, description="of a device; null leaves it to the camera"
    )
    focus: NotNegative | None = Field(
        None, description="of a device, in units of its driver; null leaves it as it is; no autofocus"
    )

    def contradictions(self) -> Iterator[Note]:
        """An index that is text would be taken for a film of that name."""
        if isinstance(self.source, str) and self.source.isdecimal():
            yield ("source",), f"is text: an index has no quotes: source: {int(self.source)}"


def device_of(source: int | str) -> Path | None:
    """Device node of V4L2 that a source is, such as ``/dev/video0``; None for others."""
    if not sys.platform.startswith("linux"):
        return None
    path = Path(f"/dev/video{source}") if isinstance(source, int) else Path(source)
    if not str(path).startswith("/dev/"):
        return None
    return path.resolve() if re.fullmatch(r"video\d+", path.resolve().name) else path


class Cameras(ByView):
    """Cameras by name, of an arm whose class has joints() in place of read(); projservo finds the tags.

    A pair is ``left`` and ``right``; any number of others have other names, such as ``top``.
    """

    __pydantic_extra__: dict[str, Source]
    left: Source | None = Field(None, description="the left camera; others have their names in its place")
    right: Source | None = Field(None, description="the right camera")
    max_age_s: Positive = Field(0.3, description="how old a frame may be, from its stamp")
    reconnect_s: Positive = Field(
        1.5, description="within which a lost camera must give frames again; the arm holds meanwhile"
    )

    def contradictions(self) -> Iterator[Note]:
        """No camera, one twice, a name that is none, or no time to reconnect."""
        yield from super().contradictions()
        if not self.sources:
            yield (), "name one camera or more, such as left and right, each with its source"
        names: dict[int | str | Path, str] = {}
        for name, one in self.sources.items():
            where = device_of(one.source) or one.source
            if (other := names.setdefault(where, name)) != name:
                what = f"is {where}, also the device of the {other} camera: name another one"
                yield (name, "source"), what
        if self.reconnect_s < self.max_age_s:
            yield ("reconnect_s",), f"must not be below max_age_s, {self.max_age_s:g}"

    @property
    def sources(self) -> dict[str, Source]:
        """Return the cameras by their names."""
        return self.by_view
