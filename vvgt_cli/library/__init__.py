"""What `import vvgt_cli` offers: the commands as functions on files and on what is in memory (docs/python.md)."""
