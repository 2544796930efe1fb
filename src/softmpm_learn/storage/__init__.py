"""Files of a run that survive a kill at any instant."""
