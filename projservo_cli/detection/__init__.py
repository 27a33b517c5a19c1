"""Markers found in stereo images: ArUco and AprilTag corners to a fraction of a pixel."""

from projservo_cli.detection.observation import Findings, observe
from projservo_cli.detection.pairs import Pair, pair_images

__all__ = ["Findings", "Pair", "observe", "pair_images"]
