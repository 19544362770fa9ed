"""Scores of Gaussians, records of runs, and their tables, charts and page."""
