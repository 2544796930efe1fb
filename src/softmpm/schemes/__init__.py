"""Buffers, launches and graphs: how substeps run."""
