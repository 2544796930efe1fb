"""Maps of the physical extremes: cells, the judges of what comes back, and the pictures."""
