"""Command line: parses, calls, prints; imports numpy only when a command runs."""
