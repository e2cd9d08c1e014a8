"""People answer: one front end on a page and in a notebook, clips, and computation ahead of the answers."""
