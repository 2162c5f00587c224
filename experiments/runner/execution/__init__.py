"""Jobs run: here, in a process apart, off a list, and on Slurm."""
