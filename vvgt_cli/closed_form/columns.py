"""Columns of a row of moments: integrals over a cell of the extinction tau times what each is named after."""

from __future__ import annotations

MASS = 0
X, Y, Z = 1, 2, 3
XX, XY, XZ, YY, YZ, ZZ = 4, 5, 6, 7, 8, 9
RED, GREEN, BLUE = 10, 11, 12
MOMENTS = 13  # columns of base cells
SEEN, SEEN_RED, SEEN_GREEN, SEEN_BLUE = 13, 14, 15, 16  # mass and colour times the mean transmittance over the views
SQUARE = 17  # squared colour, of all three bands, by what is seen of it
COLUMNS = 18  # of a pyramid's cells

FIRST, SECOND = slice(X, Z + 1), slice(XX, ZZ + 1)
COLOR, SEEN_COLOR = slice(RED, BLUE + 1), slice(SEEN_RED, SEEN_BLUE + 1)
