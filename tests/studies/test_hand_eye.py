"""Hand–eye calibration, which rendered cameras are compared with, against simulated points."""

import numpy as np
import pytest

from tests.configured import truth_of
from tests.known import configured

cv2 = pytest.importorskip("cv2")
if not hasattr(cv2, "calibrateHandEye"):
    pytest.skip("OpenCV 5 has no hand-eye calibration", allow_module_level=True)

from tests.studies import hand_eye  # noqa: E402


def test_every_method_finds_the_cameras_and_the_tool_of_exact_images():
    """Exact images leave less than a thousandth of a pixel, and joints bring the tool where it was shown."""
    truth, rng = truth_of(configured("ur5")), np.random.default_rng(1)
    arm, front = truth.robot, truth.robot.q_reference
    q = front + rng.uniform(-0.4, 0.4, (12, len(front)))
    points = np.linalg.solve(arm.base_tool, truth.M.T).T[:, :3]
    mount = np.eye(4)
    mount[:3, 3] = 0.01, -0.02, 0.03
    hands = np.array([arm.pose(joints) @ np.linalg.inv(mount) for joints in q])
    images = np.array([truth.images(joints, truth.M) for joints in q])
    for view, P in enumerate(truth.P):
        tools = np.array([hand_eye.seen_pose(hand_eye.intrinsics(P), points, s[view]) for s in images])
        found = dict(hand_eye._each_method(hands, tools))
        expected = np.linalg.solve(hand_eye.intrinsics(P), P)
        for name, base in found.items():
            assert base[:3] == pytest.approx(expected, abs=1e-4), name
    views = [hand_eye.calibrated(P, points, hands, images[:, v]) for v, P in enumerate(truth.P)]
    assert max(view.rms_px for view in views) < 1e-3
    assert hand_eye.mount_of(views, points, hands, images) == pytest.approx(mount, abs=1e-5)
    shown = hand_eye.tool_in_base(views, points, images[3])
    joints = hand_eye.joints_for(arm, shown, q[0])
    assert arm.pose(joints) == pytest.approx(arm.pose(q[3]), abs=1e-4)
