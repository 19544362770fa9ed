"""Defaults that the commands, the library and the network share."""

MAX_GAUSSIANS = 100_000
SIZE = 1080  # pixels along the edge of the screen that a file is made for
STEPS = 152  # of gradient descent (docs/optimize.md, "The plan")
MOST_STEPS = 400  # where a target or a time limit decides when to end
REPORT_STEPS = (25, STEPS, 200, 400)  # of 'vvgt report'
INIT, RULE = "vbm", "inria"
