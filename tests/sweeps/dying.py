"""Jobs that end their process, in a module that a new process reads at once."""

import os


def once(job):
    """A job that ends its process the first time it is made."""
    number, marker = job
    if number == 3 and not marker.exists():
        marker.touch()
        os._exit(9)
    return number


def always(job):
    """A job that no process survives."""
    os._exit(9)
