"""What every run shares: source, record, outputs, places, files of Gaussians, scores."""
