"""Defaults that the commands, the library and the network share."""

MAX_GAUSSIANS = 100_000
SIZE = 1080  # pixels along the edge of the screen that a file is made for
STEPS = 152  # of gradient descent (docs/optimize.md, "The plan"; `most_steps` in conversion/stages/refinement.py)
EARLY = 56  # where nobody sees a difference after these
MAX_STEPS = 400  # where a target or a time budget decides when to end
FEWEST_STEPS = 8  # fewer are not worth rendering views for
WARM_STEPS = 50  # of a round from the previous frame, or from the previous look
REPORT_STEPS = (25, EARLY, STEPS, MAX_STEPS)  # of 'vvgt report'
INIT, METHOD, RULE = "moments", "axes", "inria"
