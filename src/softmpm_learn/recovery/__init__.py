"""Returns to better motions: the best ones of a run, when it goes back to them, and when it begins anew."""
