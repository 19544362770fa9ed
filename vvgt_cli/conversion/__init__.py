"""Volume to Gaussians: stages, the plan of them, and what comes of it."""
