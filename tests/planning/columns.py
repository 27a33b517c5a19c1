"""First columns of the margins of joints before two views, by their kinds."""

from projservo_cli.planning import motion_margins

JOINTS, FRONT, VISIBILITY, WIDTH, IMAGE, CLEAR, MARGINS = (
    motion_margins.column(kind, 2)
    for kind in (
        *(
            motion_margins.JOINTS,
            motion_margins.FRONT,
            motion_margins.VISIBILITY,
            motion_margins.WIDTH,
            motion_margins.IMAGE,
            motion_margins.CLEAR,
        ),
        motion_margins.CONDITIONING,
    )
)
