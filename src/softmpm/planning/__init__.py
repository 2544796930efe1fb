"""Chunks, checkpoints and memory of a call: integers only."""
