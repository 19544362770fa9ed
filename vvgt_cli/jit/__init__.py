"""Compile kernels in a process of their own, keep their machine code on disk and load it (CONTRIBUTING.md)."""
