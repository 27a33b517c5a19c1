"""Uncalibrated stereo visual servoing in projective space.

The method is that of A. Ruf and R. Horaud, "Vision-based Guidance and Control of Robots in
Projective Space", ECCV 2000, cited below as [RH00].
"""

__version__ = "0.1.0"
