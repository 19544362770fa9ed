"""The Python API: the commands as functions on files and on data in memory (docs/python.md)."""
