"""The command line: parses, calls, prints. Nothing here imports numpy before a command runs."""
