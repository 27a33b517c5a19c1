"""Uncalibrated stereo visual servoing in projective space.

The method is that of A. Ruf and R. Horaud, "Vision-based Guidance and Control of Robots in
Projective Space", ECCV 2000, cited below as [RH00].
"""

from typing import TYPE_CHECKING

from projservo_cli.provenance import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import ArrayLike

    from projservo_cli.records import Plan
    from projservo_cli.results import Experiment

__all__ = ["__version__", "guide", "load"]


def load(run: "Path | str") -> "Experiment":
    """Open a run: its configuration, observation, calibration, plan and traces.

    Parameters
    ----------
    run : folder of a run, or its ``run.h5``.

    Returns
    -------
    Experiment
        ``calibration.predict(q)``, ``calibration.jacobian(q)`` and ``calibration.project(points)`` are
        about images; ``plan`` and ``traces`` (by law) hold named arrays.

    Raises
    ------
    projservo_cli.records.InputError
        When there is none, it is cut short, or another version made it.
    """
    from projservo_cli.results import Experiment  # so that importing the package stays light
    from projservo_cli.store import load as stored

    found = stored(run)
    return Experiment(found.path, found.configuration, found.results)


def guide(
    run: "Experiment",
    q_start: "ArrayLike",
    goal: "ArrayLike",
    *,
    limits: "ArrayLike | None" = None,
    speed: "ArrayLike | None" = None,
) -> "Plan":
    """Find a way from joints to a face in the images, by the calibration of a run alone.

    Parameters
    ----------
    run : a run with a calibration, from ``load``.
    q_start : (n,) joint readings at the start, rad or m.
    goal : (2, m, 2) pixels of the markers of ``markers.face`` in the left and the right image, in that order.
    limits : (n, 2) lowest and highest reading of each joint, rad or m; by default those of the configuration.
    speed : (n,) most motion of each joint per second, rad/s or m/s; likewise.

    Returns
    -------
    Plan
        ``time`` (k,), s, and ``q`` (k, n), rad or m, even in time, from rest to rest; ``s`` the images.
        What else it keeps to is set in ``trajectory`` and ``control`` of the configuration of the run.

    Raises
    ------
    projservo_cli.records.InputError
        When an array has another shape, the start is beyond a limit, or a joint has no speed limit.
    projservo_cli.records.WorkFailed
        When no way was found; the message says what was in the way.
    """
    from projservo_cli.stages.plan import plan_between  # so that importing the package stays light

    return plan_between(run, q_start, goal, limits, speed)
