"""Named arrays as one CSV table, which spreadsheets and scripts read alike."""

import csv
import io
from collections.abc import Mapping
from itertools import zip_longest
from typing import Any

import numpy as np
import numpy.typing as npt

Column = tuple[str, list[str]]


def columns(name: str, array: npt.NDArray[Any], down: int | None = None) -> list[Column]:
    """Columns of an array: one axis runs down, by default the longest, the others stand in the heading.

    The heading is the NumPy expression of the column, such as ``images[0,:,1]``; a scalar is a
    column of one entry. Numbers are written so that reading them gives the same numbers.
    """
    if array.ndim == 0:
        return [(name, [_text(array[()])])]
    if array.ndim == 1:
        return [(name, [_text(value) for value in array.tolist()])]
    down = int(np.argmax(array.shape)) if down is None else down
    others = np.delete(array.shape, down)
    flat = np.moveaxis(array, down, 0).reshape(array.shape[down], int(np.prod(others)))
    found = []
    for k, index in enumerate(np.ndindex(*others)):
        place = [str(i) for i in index]
        place.insert(down, ":")
        found.append((f"{name}[{','.join(place)}]", [_text(value) for value in flat[:, k].tolist()]))
    return found


def _text(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    return str(value)


def to_csv(arrays: Mapping[str, npt.NDArray[Any]], down: int | None = None) -> str:
    """All arrays side by side, each from the first row on; cells past the end of an array are empty.

    Parameters
    ----------
    arrays : by name.
    down : axis that runs down; by default the longest of each array.
    """
    found = [column for name, array in arrays.items() for column in columns(name, np.asarray(array), down)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([heading for heading, _ in found])
    writer.writerows(zip_longest(*(values for _, values in found), fillvalue=""))
    return stream.getvalue()
