"""Rendered cameras: a simulated robot in MuJoCo, whose images are searched for tags."""
