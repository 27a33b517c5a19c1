"""What befalls a simulated run beside noise; steps count from 0, the first images."""

from typing import Annotated

from pydantic import Field, Strict

from projservo_cli.config.fields import Count, Number, Section, Whole


class LostMarkers(Section):
    """Markers that neither camera sees for a while; all of them where none is named."""

    from_step: Whole = Field(description="first step at which they are unseen")
    steps: Count | None = Field(None, description="for how many steps; null for ever")
    markers: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = Field(
        None, description="their numbers; null for all markers"
    )


class Bump(Section):
    """A joint knocked aside; ``read: false`` for a joint that slips on its encoder."""

    at_step: Count = Field(description="step at which it is knocked")
    joint: Count = Field(description="the joint, counted from 1")
    by_deg: Number | None = Field(None, description="how far, a revolute joint")
    by_m: Number | None = Field(None, description="how far, a prismatic joint")
    read: Annotated[bool, Strict()] = Field(True, description="whether its reading follows")


class FrozenJoint(Section):
    """A joint whose reading stands still while it moves."""

    joint: Count = Field(description="the joint, counted from 1")
    from_step: Whole = Field(description="first step at which its reading stands still")
    steps: Count | None = Field(None, description="for how many steps; null for ever")


class Disturbance(Section):
    """Everything that befalls the simulated robot and its images."""

    lost_markers: LostMarkers | None = None
    bump: Bump | None = None
    frozen_joint: FrozenJoint | None = None
    delay_periods: Annotated[int, Strict(), Field(ge=0, le=1000)] = Field(
        0, description="by how many periods images are late"
    )
