"""People answer: one front end on a page and in a notebook, clips of the trajectories, and nobody waits."""
