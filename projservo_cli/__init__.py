"""Uncalibrated stereo visual servoing in projective space.

The method is that of A. Ruf and R. Horaud, "Vision-based Guidance and Control of Robots in
Projective Space", ECCV 2000, cited below as [RH00].
"""

from typing import TYPE_CHECKING

from projservo_cli.provenance import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from projservo_cli.results import Experiment

__all__ = ["__version__", "load"]


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
