"""Adapters for the programs in which people hold their volumes (docs/programs.md).

The modules ``vtk_*`` and ``command`` import VTK and numpy at most, and run in Python 3.9: so they also work in the
Python of a program that cannot import vvgt.
"""
