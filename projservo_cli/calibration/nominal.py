"""A robot and rig known beforehand, to some accuracy: a start that is tried, and never trusted."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.adjustment import Scene, predict_pixels
from projservo_cli.calibration.epipolar import Epipolar
from projservo_cli.calibration.fit import (
    RAYLEIGH,
    SAME_LEVEL,
    Solution,
    far_px,
    hopeless_px,
    least_squares,
    robust_search,
    typical,
)
from projservo_cli.calibration.optimization import prepare
from projservo_cli.calibration.quality import Expected
from projservo_cli.calibration.readings import Readings
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.records import PRISMATIC, REVOLUTE, FloatArray, InputError, IntArray, Model, WorkFailed


@dataclass(frozen=True, eq=False)
class Nominal:
    """What is believed of robot, rig and markers, in one metric frame.

    Attributes
    ----------
    where : name of its file, for messages.
    P : (2, 3, 4) cameras to pixels.
    H_hat : (n, 4, 4) twists at the reference: unit rotations without pitch, or unit translations.
    q_reference : (n,) rad or m.
    marker : (m,) numbers of the markers.
    M : (m, 4) markers at the reference, last coordinate one.
    """

    where: str
    P: FloatArray
    H_hat: FloatArray
    q_reference: FloatArray
    marker: IntArray
    M: FloatArray

    @property
    def joint_types(self) -> str:
        """One letter a joint, R or P."""
        return "".join("R" if H_hat[:3, :3].any() else "P" for H_hat in self.H_hat)

    def scene(self, readings: Readings, q_reference: FloatArray) -> Scene:
        """Start for the readings, about their reference joints (n,), rad or m.

        Raises
        ------
        InputError
            If the joints are others, or a marker that was seen is not known.
        """
        letters = "".join("P" if slides else "R" for slides in readings.prismatic)
        if self.joint_types != letters:
            raise InputError(
                f"{self.where}: its joints are {self.joint_types}, those of the data {letters}; "
                "give one screw a joint, or leave --init out"
            )
        missing = np.setdiff1d(readings.marker, self.marker)
        if missing.size:
            raise InputError(
                f"{self.where}: marker {missing[0]} of the data is not in it; add the marker (marker_numbers "
                "says which is which), or leave --init out"
            )
        types = np.where(readings.prismatic, PRISMATIC, REVOLUTE).astype(np.int64)
        model = Model(self.P, self.H_hat, types, self.q_reference, np.array([0.0, 0.0, 0.0, 1.0]))
        column = {int(number): j for j, number in enumerate(self.marker)}
        M = self.M[[column[int(number)] for number in readings.marker]]
        M = M @ forward_kinematics(model, q_reference).T
        scene = Scene(self.P, joint_operators(model, q_reference), M)
        # A camera is given up to scale and sign: most points are to lie in front of it.
        _, depth = predict_pixels(scene, readings, readings.q - q_reference)
        sign = np.where(np.median(depth, axis=1) < 0.0, -1.0, 1.0)
        return Scene(self.P * sign[:, None, None], scene.H_hat, scene.M)


def solve_from(
    nominal: Nominal,
    readings: Readings,
    q_reference: FloatArray,
    epipolar: Epipolar,
    expected: Expected,
    search: Callable[[], Solution],
) -> tuple[Solution, str]:
    """The fit that a given start leads to if it leaves the expected noise, else the best of it and a search.

    Parameters
    ----------
    nominal : the start.
    readings : what was seen.
    q_reference : (n,) joint values the model is written about, rad or m.
    epipolar : epipolar geometry of the rig.
    expected : noise to measure fits by.
    search : from the images alone.

    Returns
    -------
    The fit, and advice about the start where it did not lead there, else empty.

    Raises
    ------
    InputError
        If the start is one for other joints or markers.
    WorkFailed
        If neither leads anywhere.
    """
    found = _from(nominal.scene(readings, q_reference), readings, q_reference, epipolar)
    if found is not None and expected.agrees(found.agreement):
        return found, ""
    try:
        searched = search()
    except WorkFailed:
        if found is None or expected.refusal(found.agreement) is not None:
            raise
        return found, ""
    if found is not None and typical(found) <= (1.0 + SAME_LEVEL) * typical(searched):
        return found, ""
    leads = (
        "does not put the markers in front of both cameras"
        if found is None
        else f"leads to residuals of {typical(found):.3g} px instead of {typical(searched):.3g} px"
    )
    return searched, (
        f"{nominal.where} was no start: it {leads}; the search from the images alone was used, "
        "so check whether the file is about this robot and rig"
    )


def _from(scene: Scene, readings: Readings, q_reference: FloatArray, epipolar: Epipolar) -> Solution | None:
    """The fit that a scene leads to, None where its points are not in front of both cameras."""
    problem = prepare(readings, q_reference)
    pixels, depth = predict_pixels(scene, readings, problem.q)
    if not np.isfinite(pixels).all() or not (depth[readings.seen] > 0.0).all():
        return None
    found = robust_search(problem, scene, np.ones(len(readings.q), dtype=np.bool_), far_px(epipolar))
    level = float(np.median(np.linalg.norm(found.residual[readings.seen], axis=1)))
    return least_squares(problem, found.scene, level / RAYLEIGH, hopeless_px(epipolar))
