"""How kernels are compiled: by a process of their own, and then loaded from disk (CONTRIBUTING.md, "Kernels").

`decorators` marks kernels, `cache` keeps their machine code, `compile` has it made, `worker` makes it, `ahead` lists
what commands will need. Importing this package loads none of them.
"""
