"""Sweeps: closed-loop runs over a grid of configurations and random draws.

The plan of the package. ``design`` says what run number i is: an ordinary configuration, whose seeds,
task and drawn values depend on the number alone. ``preparation`` makes what many runs share, the
calibrations and the random tasks. ``runs`` makes a part, some thousand runs with consecutive numbers,
and is a function of its argument alone, so that any process on any machine may call it. ``engine``
hands parts to processes here or to a Dask cluster; ``compiling`` sees that the first of them compile
once. ``driver`` ties them together: it stores each part as a file of its own, knows from the files what
is left to do, and assembles them to one table. ``again`` makes one run anew as an ordinary run file.
``statistics`` reads the table.
"""
