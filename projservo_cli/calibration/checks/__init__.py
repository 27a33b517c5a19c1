"""Checks of the data, of a fit and of its predictions.

``screening``, ``image_contradictions`` and ``board_corner_numbering`` come before a fit. ``outliers``
explains rejected images, ``unusable_fit`` tells whether the fit describes the data, ``model_errors`` tests
for deviations of arm and rig from the model, and ``joint_order`` for questions that the poses leave open.
``observability_and_verdict`` gives the verdict; ``validation`` compares with poses that
no fit has seen.
"""
