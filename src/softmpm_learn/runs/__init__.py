"""One run and its parts, and several runs side by side in one simulation; how a run is saved, resumed and loaded."""
