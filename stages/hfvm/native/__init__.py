"""The solver of one level: search, propagation, sums, paths, depth edges; in C, and in numba as a reference.

``lanes.h`` and ``level.h`` hold the rules of a pixel, ``level.c`` the loops; ``build`` compiles them when the package
is installed, ``library`` calls them. ``reference`` computes the same integers in numba, and runs where there is no
compiler. ``solver`` chooses.
"""
