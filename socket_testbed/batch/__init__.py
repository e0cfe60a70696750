"""Many trials: found in a folder, worked on in parallel, done once, in one summary table."""
