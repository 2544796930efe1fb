"""Maps of the physical extremes: cells, judges of the returned states, and pictures."""
