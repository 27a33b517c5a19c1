"""Checks of the data, of a fit and of its predictions.

``screening`` and ``numbering`` come before a fit. ``outliers`` explains rejected images, ``refusal`` tells
whether the fit describes the data, ``model_error`` tests for deviations of arm and rig from the model, and
``undecided`` for what the poses leave open. ``quality`` gives the verdict; ``validation`` compares with poses
that no fit has seen.
"""
