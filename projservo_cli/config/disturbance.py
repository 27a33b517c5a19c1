"""What befalls a simulated run beside noise; steps count from 0, the first images."""

from typing import Annotated

from pydantic import Field, Strict

from projservo_cli.config.fields import Count, Number, Section, Whole


class LostMarkers(Section):
    """Markers that neither camera sees for a while; all of them where none is named."""

    from_step: Whole
    steps: Count | None = None  # None: for ever
    markers: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = None


class Bump(Section):
    """A joint knocked aside; ``read: false`` for a joint that slips on its encoder."""

    at_step: Count
    joint: Count
    by_deg: Number | None = None
    by_m: Number | None = None
    read: Annotated[bool, Strict()] = True


class FrozenJoint(Section):
    """A joint whose reading stands still while it moves."""

    joint: Count
    from_step: Whole
    steps: Count | None = None  # None: for ever


class Disturbance(Section):
    """Everything that befalls the simulated robot and its images."""

    lost_markers: LostMarkers | None = None
    bump: Bump | None = None
    frozen_joint: FrozenJoint | None = None
    delay_periods: Annotated[int, Strict(), Field(ge=0, le=1000)] = 0
