"""Sweeps: closed-loop runs over a grid of configurations and random draws.

The plan of the package. ``design`` defines run number i: an ordinary configuration, whose seeds,
random task and drawn values depend on the number alone. ``runs`` makes a part, some hundred runs with
consecutive numbers, and is a function of its argument alone, so that any process on any machine may call
it. ``workers`` hands parts to threads and processes here or to a Dask cluster. ``folder`` knows from the
stores finished runs, has the rest made, and repeats one run as an ordinary run file. ``statistics`` reads
the table, and draws.
"""
