"""Many files of one run: sets of views and series, by manifest and in parts."""
