"""Whole runs: which stages a scene needs, what each took, and what came of it."""
