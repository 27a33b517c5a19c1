"""First columns of the margins of joints before two views, by their kinds."""

from projservo_cli.planning import margins

JOINTS, FRONT, VISIBILITY, WIDTH, IMAGE, CLEAR, MARGINS = (
    margins.column(kind, 2)
    for kind in (
        *(margins.JOINTS, margins.FRONT, margins.VISIBILITY, margins.WIDTH, margins.IMAGE, margins.CLEAR),
        margins.CONDITIONING,
    )
)
